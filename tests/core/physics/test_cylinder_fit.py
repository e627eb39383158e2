"""Cylinders recognised by their surface, compared with nearly cylindrical shapes; Gaussians at random points."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from stages.core.physics.cylinder_fit import Cylinder, fitted_cylinder
from stages.core.physics.rigid_shapes import rigid_shapes
from tests.core.physics.test_particles import scene, splats
from tests.core.physics.test_random_surfaces import ball_samples, box_samples

TURN = Rotation.from_rotvec([0.5, 0.7, -0.3])
CENTRE = np.array([1.0, -2.0, 3.0])


def lathe(*profile: tuple[float, float], n: int = 4000) -> np.ndarray:
    """Random points (n, 3) on a surface of revolution about z with an outline of (radius, height) points."""
    rng = np.random.default_rng(0)
    p = np.array(profile)
    step = np.diff(p, axis=0)
    area = np.linalg.norm(step, axis=1) * (p[:-1, 0] + p[1:, 0])
    row = rng.choice(len(step), 4 * n, p=area / area.sum())
    at = p[row] + rng.random((4 * n, 1)) * step[row]
    widest = np.maximum(p[row, 0], p[row + 1, 0])
    at = at[rng.random(4 * n) * widest < at[:, 0]][:n]  # fewer points where the radius is small
    turn = rng.uniform(0, 2 * np.pi, len(at))
    return np.column_stack([at[:, 0] * np.cos(turn), at[:, 0] * np.sin(turn), at[:, 1]])


def cylinder(height: float, n: int = 4000) -> np.ndarray:
    """Points on a cylinder of radius 1 about z."""
    return lathe((0, -height / 2), (1, -height / 2), (1, height / 2), (0, height / 2), n=n)


def prism(sides: int) -> np.ndarray:
    """Points on a regular prism that circumscribes the cylinder of height 2."""
    x = cylinder(2.0)
    turn = 2 * np.pi * np.arange(sides) / sides
    out = x[:, :2] / np.maximum(np.linalg.norm(x[:, :2], axis=1, keepdims=True), 1e-12)
    return x * [1, 1, 0] / (out @ np.stack([np.cos(turn), np.sin(turn)])).max(1)[:, None] + x * [0, 0, 1]


def fit(points: np.ndarray) -> Cylinder | None:
    points = TURN.apply(points) + CENTRE
    return fitted_cylinder(points, ConvexHull(points))


@pytest.mark.parametrize("height", [0.1, 1.0, 1.66, 3**0.5, 2.0, 3.0, 10.0])
@pytest.mark.parametrize(("n", "noise"), [(1000, 0.0), (4000, 0.01)])
def test_cylinders_of_all_heights(height, n, noise):
    """Includes the heights for which the solid (√3), the surface or the normals (2) have no unique principal axes."""
    points = cylinder(height, n)
    found = fit(points + noise * min(height, 1.0) * np.random.default_rng(1).standard_normal(points.shape))
    np.testing.assert_allclose(found.centre, CENTRE, rtol=0, atol=4e-3)
    assert found.radius == pytest.approx(1, abs=4e-3) and found.height == pytest.approx(height, abs=8e-3)
    assert abs(found.axis @ TURN.apply([0, 0, 1])) == pytest.approx(1, abs=1e-5)


OTHERS = {
    "cube": box_samples((2, 2, 2), 4000),
    "box": box_samples((2, 2, 3), 4000),
    "plank": box_samples((40, 7, 1), 4000),
    "rod": box_samples((100, 1, 1), 4000),
    "half a disc": cylinder(0.04, 8000)[cylinder(0.04, 8000)[:, 0] > 0],
    "prism of 6": prism(6),
    "prism of 8": prism(8),
    "ball": ball_samples(4000),
    "elliptic 1:1.05": cylinder(2.0) * [1.05, 1, 1],
    "cone": lathe((0, -1), (1, -1), (0, 1)),
    "frustum 1:.95": lathe((0, -1), (1, -1), (0.95, 1), (0, 1)),
    "barrel 1:1.05": lathe((0, -1), *((1.05 - 0.05 * z * z, z) for z in np.linspace(-1, 1, 20)), (0, 1)),
    "capsule": np.concatenate([ball_samples(2000) * [1, 1, s] + [0, 0, s] for s in (-1, 1)]),
    "rounded end": lathe((0, -1), (1, -1), *((math.cos(a), 0.5 * math.sin(a)) for a in np.linspace(0, 1.57, 20))),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_shapes_are_no_cylinders(name):
    assert fit(OTHERS[name]) is None


def test_a_cylinder_has_its_moments_and_its_edges():
    """The moments are m r^2 / 2 about the axis and m (r^2 / 4 + h^2 / 12) about a perpendicular one."""
    r, h = 0.1, 0.25
    points = torch.from_numpy(TURN.apply(r * cylinder(h / r))) + torch.tensor([0.0, 0.0, 2.0])
    shape = rigid_shapes(scene(splats(points, scale=0.002), floor=0.0))[0]
    assert shape.cylinder is not None and shape.ball is None and shape.convex
    assert shape.volume == pytest.approx(math.pi * r**2 * h, rel=0.005)
    across = r**2 / 4 + h**2 / 12
    R = TURN.as_matrix()
    expected = torch.from_numpy(R @ np.diag([across, across, r**2 / 2]) @ R.T).float()
    torch.testing.assert_close(shape.inertia / shape.volume, expected, rtol=0.01, atol=1e-5)
    rim = TURN.inv().apply(shape.hull.double().numpy() - [0, 0, 2])
    np.testing.assert_allclose(np.linalg.norm(rim[:, :2], axis=1), r, rtol=0.005)
    np.testing.assert_allclose(np.abs(rim[:, 2]), h / 2, rtol=0.005)
