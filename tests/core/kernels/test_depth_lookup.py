"""Lookup in signed-distance grids: kernels compared with NumPy, and analytic distances of a ball."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.core.kernels.depth_lookup import (
    CompiledDepthLookup,
    DepthLookup,
    Samples,
    depth_lookup,
    interpolated,
    slope,
)
from stages.core.kernels.interop import compiles_for_cpu

kernels = pytest.mark.skipif(not compiles_for_cpu(), reason="Warp has no compiler for the CPU here")


def scene(count: int):
    """Grids and samples of three bodies with random poses, and samples of body a that are looked up in body b.

    Samples have zero to three faces, some of which oppose those of others.
    """
    rng = np.random.default_rng(count)
    shapes = [(5, 6, 7), (4, 3, 9), (8, 8, 2)]
    grids = [rng.normal(size=shape) for shape in shapes], rng.uniform(-0.6, -0.2, (3, 3)), np.array([0.1, 0.15, 0.12])
    poses = Rotation.random(3, random_state=count).as_matrix(), rng.normal(size=(3, 3)) * 0.1
    poses[0][2] = poses[0][1]
    axes = np.concatenate([np.eye(3), -np.eye(3), np.zeros((2, 3))])
    faces = axes[rng.integers(0, 8, (900, 3))] @ Rotation.from_rotvec(0.1 * rng.normal(size=(900, 3))).as_matrix()
    normals = rng.normal(size=(900, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    flatness = np.where(rng.random(900) < 0.4, 0.0, rng.uniform(0.97, 1.0, 900))
    nearest = rng.integers(-1, 900, sum(g.size for g in grids[0]))
    samples = Samples(0.3 * rng.normal(size=(900, 3)), normals, flatness, faces, nearest)
    a, b = rng.integers(0, 3, (2, count))
    return (*grids, samples), poses, rng.integers(0, 900, count), a, b


@kernels
@pytest.mark.parametrize("counts", [(0, 7), (300, 5000, 40)])  # buffers grow and are not cleared in between
def test_kernels_agree_with_numpy(counts):
    grids, *_ = scene(1)
    compiled, numpy = CompiledDepthLookup(*grids), DepthLookup(*grids)
    for count in counts:
        _, poses, sample, a, b = scene(count)
        points = grids[-1].points[sample]
        distance = numpy.distances(points, a, b, *poses)
        np.testing.assert_allclose(compiled.distances(points, a, b, *poses), distance, atol=1e-12)
        found, wanted = (x.inside(sample, a, b, *poses) for x in (compiled, numpy))
        assert len(wanted.row) >= count // 50  # some points are inside
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-10)
        if count == 5000:  # every rule has determined some normals
            own = np.einsum("kij,kj->ki", poses[0][a], grids[-1].normals[sample])[wanted.row]
            of_sample, on_face = np.isclose(wanted.normal, -own).all(1), grids[-1].flatness[sample[wanted.row]] > 0
            assert min(of_sample.sum(), (on_face & ~of_sample).sum(), (~on_face).sum()) > 10


def test_the_normal_is_that_of_the_flatter_of_parallel_faces_else_of_the_sample_on_a_face():
    """A sample on top of one body is 0.02 inside the underside of another, whose nearest sample is the second one."""
    line = np.arange(-0.2, 0.21, 0.1)
    height = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1)[..., 2]
    up, aslant = np.array([0.0, 0, 1]), np.array([0.0, 0.28, 0.96])

    def normal(flat: tuple[float, float], faces: tuple) -> tuple:
        both = np.zeros((2, 3, 3))
        both[:, 0] = faces
        samples = Samples(np.array([[0.0, 0, 0.02], [0, 0, 0]]), np.array([up, -up]), np.array(flat), both,
                          np.ones(2 * height.size, np.int64))  # fmt: skip
        for make in (DepthLookup, CompiledDepthLookup) if compiles_for_cpu() else (DepthLookup,):
            one = np.array([0]), np.array([0]), np.array([1])
            lookup = make([height, height], np.full((2, 3), -0.2), np.full(2, 0.1), samples)
            found = lookup.inside(*one, np.broadcast_to(np.eye(3), (2, 3, 3)), np.zeros((2, 3)))
            assert found.depth == pytest.approx([0.02]) and found.x == pytest.approx(np.array([[0, 0, 0.02]]))
            yield found.normal[0].round(9).tolist(), float(found.facing[0])

    for found, facing in normal((0.98, 1.0), (up, -aslant)):  # nearly parallel: the normal of the flatter face is used
        assert found == (-aslant).tolist() and facing == pytest.approx(0.96)
    for found, _ in normal((1.0, 0.98), (up, -aslant)):
        assert found == (-up).tolist()
    for found, facing in normal((0.98, 1.0), (up, [0, -0.8, -0.6])):  # not parallel: the normal of the sample is used
        assert found == (-up).tolist() and facing == pytest.approx(0.6)
    for found, facing in normal((0.0, 1.0), ([0, 0, 0], -up)):  # at an edge: the negative gradient of the depth is used
        assert found == (-up).tolist() and facing == pytest.approx(1.0)


@pytest.mark.parametrize("make", [DepthLookup, pytest.param(CompiledDepthLookup, marks=kernels)])
def test_distances_and_contacts_of_a_ball(make):
    """A ball of radius 1 at (2, 0, 0), and points of a body that is rotated by 90 degrees about z."""
    line = np.arange(-1.2, 1.21, 0.05)
    x = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1)
    ball = 1 - np.linalg.norm(x, axis=-1)
    at_edges = np.zeros((3, 3, 3)), np.full(2 * ball.size, -1)
    points = np.array([[0.0, -1.1, 0], [0, -0.5, 0], [0, 5, 0]])  # x = 1.1, 0.5 and -5 in world coordinates
    samples = Samples(points, np.array([[0.0, -1, 0]] * 3), np.zeros(3), *at_edges)
    lookup = make([ball, ball], np.full((2, 3), -1.2), np.full(2, 0.05), samples)
    turn = np.stack([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], np.eye(3)])
    at = np.array([[0.0, 0, 0], [2, 0, 0]])
    zeros, ones = np.zeros(3, np.int64), np.ones(3, np.int64)
    distance = lookup.distances(points, zeros, ones, turn, at)
    assert distance[0] == pytest.approx(-0.1, abs=2e-3)
    assert 0.3 < distance[1] <= 0.5 and 5.7 < distance[2] <= 6  # bounds for points outside the grid
    found = lookup.inside(np.arange(3), zeros, ones, turn, at)
    assert found.row.tolist() == [0] and found.depth == pytest.approx([0.1], abs=2e-3)
    np.testing.assert_allclose(found.x, [[1.1, 0, 0]], atol=1e-12)
    # half a cell over the radius, for a point on a node
    np.testing.assert_allclose(found.normal, [[-1, 0, 0]], atol=0.03)
    assert found.facing == pytest.approx([1.0], abs=0.01)  # from the normal of the sample, which has no faces
    near = lookup.near(np.arange(3), zeros, ones, turn, at - np.array([[0, 0, 0], [0.15, 0, 0]]), 0.06)
    assert near.row.tolist() == [0]


def test_gradient_of_the_interpolation():
    rng = np.random.default_rng(0)
    value, f, step = rng.normal(size=(50, 8)), rng.uniform(0.1, 0.9, (50, 3)), 1e-5
    numeric = [(interpolated(value, f + step * e) - interpolated(value, f - step * e)) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(slope(value, f), np.stack(numeric, 1), atol=1e-8)


def test_the_kernels_are_taken_where_they_can_be_compiled():
    grids, *_ = scene(1)
    assert type(depth_lookup(*grids)) is (CompiledDepthLookup if compiles_for_cpu() else DepthLookup)
