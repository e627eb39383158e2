"""Random samples of thin convex bodies, whose holes are wider than the bodies are thick."""

import math

import numpy as np
import pytest
import torch

from stages.core.physics.covered_hull import covered_hull, hull_voxels
from stages.core.physics.particles import sample_bodies
from stages.core.physics.rigid_shapes import rigid_shapes
from tests.core.physics.test_particles import scene, splats


def box_samples(sides, n: int, seed: int = 0, faces=range(6)) -> np.ndarray:
    """Points (n, 3) at random on the faces of a box around the origin."""
    rng, sides = np.random.default_rng(seed), np.asarray(sides, float)
    faces = list(faces)
    area = np.array([sides.prod() / sides[f % 3] for f in faces])
    face = rng.choice(faces, n, p=area / area.sum())
    x = rng.random((n, 3)) - 0.5
    x[np.arange(n), face % 3] = np.where(face < 3, 0.5, -0.5)
    return x * sides


def ball_samples(n: int, seed: int = 0) -> np.ndarray:
    x = np.random.default_rng(seed).normal(size=(n, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def spacing(area: float, n: int) -> float:
    return 1.09 * (area / n) ** 0.5


@pytest.mark.parametrize("seed", range(5))
def test_bodies_whose_surface_is_their_hull(seed):
    assert covered_hull(box_samples((0.4, 0.4, 0.05), 1000, seed), spacing(0.4, 1000)) is not None
    assert covered_hull(ball_samples(4000, seed), spacing(4 * math.pi, 4000)) is not None


def test_open_and_concave_bodies_are_not_their_hull():
    no_top = box_samples((0.4, 0.3, 0.2), 4000, faces=[0, 1, 3, 4, 5])
    assert covered_hull(no_top, spacing(0.4, 4000)) is None
    ball = ball_samples(8000)
    half = ball[ball[:, 2] < 0]
    assert covered_hull(half, spacing(2 * math.pi, len(half))) is None  # without a lid
    shell = np.concatenate([half, 0.9 * half, np.column_stack([ball[:, :2], np.zeros(len(ball))])[:500]])
    assert covered_hull(shell, spacing(4 * math.pi, len(shell))) is None
    assert covered_hull(np.column_stack([box_samples((1, 1, 1), 500)[:, :2], np.zeros(500)]), 0.05) is None  # a sheet
    assert covered_hull(np.zeros((3, 3)), 1.0) is None


def test_voxels_of_a_hull_are_those_with_centres_inside():
    planes = covered_hull(ball_samples(4000), spacing(4 * math.pi, 4000))
    low, h, shape = np.array([-13, -12, -12]), 0.1, np.array([26, 24, 25])
    mask = hull_voxels(planes, low, h, shape)
    centres = h * (np.stack(np.meshgrid(*(low[a] + np.arange(shape[a]) for a in range(3)), indexing="ij"), -1) + 0.5)
    inside = (centres @ planes[:, :3].T + planes[:, 3] <= 0).all(-1)
    assert (mask == inside).all() and 0.95 < mask.sum() * h**3 / (4 / 3 * math.pi) < 1.05


@pytest.mark.parametrize(
    ("sides", "n"), [((0.4, 0.4, 0.05), 2000), ((0.4, 0.4, 0.05), 6000), ((0.5, 0.02, 0.02), 2000)]
)
def test_thin_bodies_have_their_volume(sides, n):
    """Also where holes between the points are wider than the body is thick."""
    area = 2 * (sides[0] * sides[1] + sides[1] * sides[2] + sides[2] * sides[0])
    points = torch.from_numpy(box_samples(sides, n)) + torch.tensor([0.0, 0.0, 2.0])
    thing = scene(splats(points, scale=0.4 * (area / n) ** 0.5), floor=0.0)
    volume = float(np.prod(sides))
    assert rigid_shapes(thing, 0, 0.0)[0].volume == pytest.approx(volume, rel=0.1)


@pytest.mark.parametrize("count", [3000, 20_000])
def test_volumes_are_those_of_the_particles_also_where_their_number_is_not_reached(count):
    """The number of voxels of a leaky plate jumps with their size, so that the search for it does not converge."""
    points = torch.from_numpy(box_samples((0.4, 0.4, 0.05), 6000, 1)) + torch.tensor([0.0, 0.0, 2.0])
    bodies = sample_bodies(scene(splats(points, scale=0.005), floor=0.0), count)
    assert 0.8 < float(bodies.volume.sum()) / 0.008 < 1.25
