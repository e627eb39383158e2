"""Detection of the faces that meet at points of a surface."""

import numpy as np
import pytest

from stages.core.geometry.surface_faces import nearest_points, surface_faces

SIDES = np.array([1.0, 0.8, 0.6])


def box_points(spacing: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Lattice points (n, 3) on a box around the origin, with normals averaged over the faces at edges and corners."""
    axes = [np.linspace(-0.5, 0.5, round(s / spacing) + 1) * s for s in SIDES]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    outward = np.where(np.isclose(np.abs(x), SIDES / 2), np.sign(x), 0.0)
    on = outward.any(1)
    return x[on], outward[on] / np.linalg.norm(outward[on], axis=1, keepdims=True)


def test_faces_of_a_box_at_its_faces_edges_and_corners():
    points, normals = box_points()
    flatness, faces = surface_faces(points, normals)
    meeting = np.isclose(np.abs(points), SIDES / 2)  # whether each point is on each of the three faces
    count = meeting.sum(1)
    inner = (np.abs(points) < SIDES / 2 - 0.11).sum(1) == 2  # points in the interior of a face
    assert inner.sum() > 500 and (flatness[inner] == pytest.approx(1)) and not flatness[count > 1].any()
    assert np.array_equal(faces[inner, 0], normals[inner]) and not faces[inner, 1:].any()
    clear = ((np.abs(points) < SIDES / 2 - 0.16) | meeting).all(1)  # points away from all other edges and corners
    for k in (2, 3):
        mine = clear & (count == k)
        found = faces[mine]
        assert mine.sum() == {2: 4 * (13 + 9 + 5), 3: 8}[k]
        assert ((np.linalg.norm(found, axis=2) > 0).sum(1) == k).all()
        there = np.where(meeting, np.sign(points), 0.0)[mine]
        assert np.abs(found).max(1) == pytest.approx(np.abs(there))  # each axis occurs once
        assert found.sum(1) == pytest.approx(there)  # the sign must be right too


def test_points_of_a_sheet_are_on_the_face_of_their_side():
    x, y = np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21))
    side = np.repeat([1.0, -1.0], x.size)
    points = np.column_stack([np.tile(x.ravel(), 2), np.tile(y.ravel(), 2), 0.001 * side])
    normals = side[:, None] * [0.0, 0, 1]
    flatness, faces = surface_faces(points, normals)
    assert flatness == pytest.approx(1)
    assert np.array_equal(faces[:, 0], normals) and not faces[:, 1:].any()


def test_the_end_of_a_thin_rod_is_a_face():
    """Only the middle one of the three points along a side is recognised as on a face from its neighbours."""
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
    end = np.column_stack([x.ravel(), y.ravel(), np.zeros(9)])
    k, z = np.meshgrid([-1.0, 0.0, 1.0], np.arange(0.5, 12))
    sides = [np.stack(np.broadcast_arrays(*axes), -1).reshape(-1, 3) for axes in
             ((1.5, k, z), (-1.5, k, z), (k, 1.5, z), (k, -1.5, z))]  # fmt: skip
    outward = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    points = np.concatenate([end, *sides])
    normals = np.concatenate([np.tile([0.0, 0, -1], (9, 1)), np.repeat(outward, k.size, 0)])
    flatness, faces = surface_faces(points, normals)
    assert not np.delete(flatness[:9], 4).any()
    assert (faces[:9] == [0, 0, -1]).all(2).any(1).all()


def test_a_point_known_to_be_at_an_edge_far_from_every_face_has_none():
    """At the tip of a long thin cone: the point's own normal, along the axis, belongs to no face."""
    tip, far = np.zeros((30, 3)), 10 + np.random.default_rng(0).normal(size=(30, 3))
    points, normals = np.concatenate([tip, far]), np.tile([0.0, 0, 1], (60, 1))
    at_edge = np.arange(60) < 30
    flatness, faces = surface_faces(points, normals, at_edge)
    assert not faces[:30].any() and not flatness[:30].any() and faces[30:, 0].any(1).all()


def test_a_ball_is_nearly_flat_and_less_so_than_a_plane():
    i = np.arange(2000) + 0.5
    z, turn = 1 - 2 * i / 2000, np.pi * (1 + 5**0.5) * i
    points = np.column_stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    flatness, faces = surface_faces(points, points)
    assert flatness.min() > 0.99 and flatness.max() < 0.9995
    assert np.array_equal(faces[:, 0], points)


def test_nodes_near_the_surface_know_the_nearest_point():
    points = np.array([[0.31, 0.5, 0.5], [0.69, 0.5, 0.5]])
    x = np.indices((11, 11, 11)).transpose(1, 2, 3, 0) * 0.1
    depth = 0.2 - np.linalg.norm(x - 0.5, axis=-1)
    found = nearest_points(points, depth, np.zeros(3), 0.1)
    near = np.abs(depth) < 0.4
    assert (found[~near] == -1).all() and near.sum() < near.size
    distance = np.linalg.norm(x[..., None, :] - points, axis=-1)
    assert np.take_along_axis(distance, found[..., None].clip(0), -1)[..., 0][near] == pytest.approx(
        distance.min(-1)[near]
    )
    assert (nearest_points(np.zeros((0, 3)), depth, np.zeros(3), 0.1) == -1).all()
