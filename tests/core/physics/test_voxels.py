"""The steps from surface points to voxels and from voxels to convex hulls, each with cases computed by hand."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage

from stages.core.physics import body_filling, particles, rigid_shapes
from stages.core.physics.particles import MIN_PARTICLE_OPACITY, MIN_PARTICLES, scene_size, surface_points, usable
from stages.core.scene.gaussians import concatenate
from tests.core.physics.test_particles import scene, splats


def block(*sides, low=(0, 0, 0)):
    """Indices of the voxels of a box."""
    return np.array(list(itertools.product(*(range(a, a + n) for a, n in zip(low, sides, strict=True)))))


def filled(shape, *blocks):
    out = np.zeros(shape, bool)
    for cells in blocks:
        out[tuple(cells.T)] = True
    return out


def grid(*sides, step):
    return torch.from_numpy(block(*sides) * float(step)).float()


def test_spacing_is_the_median_distance_to_the_nearest_other():
    line = torch.tensor([0.0, 1.0, 3.0, 7.0, 15.0])[:, None] * torch.tensor([[0.6, 0.8, 0.0]])
    assert particles._spacing(line) == pytest.approx(2.0)  # distances are 1, 1, 2, 4, 8
    assert particles._spacing(grid(20, 20, 20, step=0.3)) == pytest.approx(0.3)  # more points than are sampled
    assert particles._spacing(torch.ones(1, 3)) == 0.0


def test_gap_is_nine_tenths_of_the_distances_to_the_third_neighbour():
    line = np.arange(2000.0)[:, None] * np.array([[0.0, 0.0, 0.5]])
    assert particles._gap(line) == pytest.approx(1.0)  # distances to neighbours within a line are 0.5, 0.5 and 1
    cluster = np.concatenate([line[:1700], 5000 * (1 + np.arange(300))[:, None] * np.ones((1, 3))])
    assert particles._gap(cluster) > 1000  # 15 % of the points are isolated


def test_size_of_a_scene_leaves_out_one_percent_at_each_end_and_the_background():
    x = torch.linspace(0, 10, 1001)
    means = torch.stack([x, 0.1 * x, 0 * x + 50], 1)
    whole = scene(splats(means), splats(torch.full((5, 3), 4.0)))
    far = splats(torch.full((3, 3), 900.0), id=0)
    assert scene_size(whole) == pytest.approx(9.8, rel=0.01)
    both = replace(whole, gaussians=concatenate([whole.gaussians, far]))
    assert scene_size(both) == pytest.approx(9.8, rel=0.01)
    assert scene_size(replace(whole, gaussians=far)) == 1.0
    assert scene_size(scene(splats(torch.ones(3, 3)))) == 1e-6


def test_usable_gaussians_are_finite_of_positive_size_turned_and_opaque():
    g = splats(torch.zeros(9, 3))
    g.means[1, 2], g.scales[2, 0], g.quats[3, 1] = math.nan, math.inf, math.nan
    g.scales[4, 1], g.scales[5, 2], g.quats[6] = 0.0, -1.0, 0.0
    g.opacities[7], g.opacities[8] = MIN_PARTICLE_OPACITY, MIN_PARTICLE_OPACITY + 1e-6
    assert usable(g).tolist() == [True, *[False] * 7, True]


def test_points_of_a_surface_fill_ellipsoids_of_seven_tenths_of_the_gaussians():
    """Points are uniform in the ball of radius 0.7, so a coordinate's mean square is 0.7^2 / 5 of a variance."""
    quat = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])  # rotation by 90 degrees about z, so local x becomes y
    g = splats(grid(12, 12, 1, step=1.0))
    g = replace(g, quats=quat.repeat(144, 1), scales=torch.tensor([2.0, 1.0, 0.01]).repeat(144, 1))
    points = surface_points(scene(g), 1, seed=0)
    each = 8  # 4 x the product of the two larger standard deviations, for a spacing of 1
    assert len(points) == 144 * (1 + each)
    away = points[144:].reshape(144, each, 3) - g.means.numpy()[:, None]
    local = away[..., [1, 0, 2]] / np.array([2.0, 1.0, 0.01])
    assert np.linalg.norm(local, axis=-1).max() < 0.7 and np.linalg.norm(local, axis=-1).max() > 0.69
    np.testing.assert_allclose((local**2).mean((0, 1)), 0.7**2 / 5, rtol=0.15)
    np.testing.assert_allclose(local.mean((0, 1)), 0, atol=0.04)
    assert (surface_points(scene(g), 1, seed=0) == points).all()
    assert not (surface_points(scene(g), 1, seed=1) == points).all()


def test_small_gaussians_are_sampled_once():
    points = surface_points(scene(splats(grid(12, 12, 1, step=1.0), scale=0.1)), 1, seed=0)
    assert len(points) == 2 * 144


def test_the_skin_of_a_cube_of_nine_voxels():
    """The outer layer of each face, without voxels more than 3 steps from the central 5 voxels."""
    cube = filled((13, 13, 13), block(9, 9, 9, low=(2, 2, 2)))
    skin = body_filling.thick_skin(cube)
    assert skin.sum() == 6 * (5 * 5 + 2 * 2 * 5) and not skin[3:10, 3:10, 3:10].any()
    # it is too thin for a skin
    assert not body_filling.thick_skin(filled((13, 13, 13), block(9, 9, 4, low=(2, 2, 2)))).any()


def test_trimming_removes_the_skin_whose_points_are_inside_the_centres_of_its_voxels():
    cube = filled((15, 15, 15), block(11, 11, 11, low=(2, 2, 2)))
    outer = np.argwhere(cube & ~ndimage.binary_erosion(cube)) + 0.5
    towards = np.sign(7.5 - outer) * (np.abs(outer - 7.5) == 5)
    at = np.ravel_multi_index(tuple(np.floor(outer).astype(np.int64).T), cube.shape)
    assert body_filling._trim(cube, 0.3 * towards, at).sum() == cube.sum() - body_filling.thick_skin(cube).sum()
    assert (body_filling._trim(cube, -0.3 * towards, at) == cube).all()


def test_components_smaller_than_a_fiftieth_of_the_largest_are_removed():
    large, small, smaller = block(10, 10, 1), block(2, 1, 1, low=(0, 0, 5)), block(1, 1, 1, low=(9, 9, 9))
    touching = np.array([[9, 10, 1]])  # touches a corner of the large block
    body = filled((12, 12, 12), large, small, smaller, touching)
    assert (body_filling._largest(body) == filled(body.shape, large, touching)).all()  # 101 / 50 > 2
    body[9, 10, 1] = False
    assert (body_filling._largest(body) == filled(body.shape, large, small)).all()
    assert (body_filling._largest(filled(body.shape, smaller)) == filled(body.shape, smaller)).all()


def test_what_is_outside_is_connected_with_a_face_of_the_grid():
    free = ~filled((7, 7, 7), block(5, 5, 5, low=(1, 1, 1)))
    free[3, 3, 3] = True
    outside = body_filling._outside(free)
    assert outside.sum() == 7**3 - 5**3 and not outside[3, 3, 3]
    free[3, 3, 4] = free[3, 3, 5] = True
    assert body_filling._outside(free)[3, 3, 3]


def test_voxels_of_two_bodies_go_to_the_smaller_one():
    a, b = block(6, 6, 6, low=(-3, 2, 5)), block(4, 4, 4, low=(1, 3, 9))
    shared = set(map(tuple, a)) & set(map(tuple, b))
    assert len(shared) == 2 * 4 * 2
    kept_a, kept_b = particles._without_overlap([a, b])
    assert set(map(tuple, kept_b)) == set(map(tuple, b)) and set(map(tuple, kept_a)) == set(map(tuple, a)) - shared
    inner = block(4, 4, 3, low=(0, 0, 0))
    # both keep all, because one would otherwise have less than MIN_PARTICLES
    same = particles._without_overlap([inner, inner])
    assert len(inner) >= MIN_PARTICLES and [len(x) for x in same] == [48, 48]
    left = particles._without_overlap([block(5, 8, 2), block(3, 8, 2)])
    assert [len(x) for x in left] == [80, 48]  # 32 voxels would remain


def test_corners_of_voxels():
    found = rigid_shapes._corners(np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]), 0.2)
    expected = {tuple(np.round(c + 0.1 * np.array(s), 6)) for c in ([1, 2, 3], [0, 0, 0])
                for s in itertools.product((-1, 1), repeat=3)}  # fmt: skip
    assert len(found) == 16 and {tuple(np.round(c, 6)) for c in found} == expected


def test_moments_of_the_hull_of_a_box_and_of_a_tetrahedron():
    box = np.array(list(itertools.product((0.0, 2.0), (1.0, 4.0), (-1.0, 3.0))))
    volume, com, inertia = rigid_shapes._solid_moments(rigid_shapes._hull(box))
    assert volume == pytest.approx(24) and com.tolist() == pytest.approx([1, 2.5, 1])
    np.testing.assert_allclose(inertia, 24 / 12 * np.diag([9 + 16, 4 + 16, 4 + 9]), rtol=1e-5, atol=1e-5)
    corner = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    volume, com, inertia = rigid_shapes._solid_moments(rigid_shapes._hull(corner))
    assert volume == pytest.approx(1 / 6) and com.tolist() == pytest.approx([0.25] * 3)
    np.testing.assert_allclose(np.diag(inertia), 2 * (1 / 60 - 1 / 96), rtol=1e-5)  # the integral of x^2 is 1 / 60
    np.testing.assert_allclose(inertia[0, 1], -(1 / 120 - 1 / 96), rtol=1e-5)  # the integral of x y is 1 / 120


def test_no_hull_of_points_in_a_plane():
    assert rigid_shapes._hull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])) is None
    assert rigid_shapes._hull(np.zeros((2, 3))) is None
