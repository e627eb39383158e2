"""Plane fits to noisy points with outliers."""

import math

import pytest
import torch

from stages.core.geometry.planes import Plane, fit_plane, planes_through, ransac


def angle(a, b) -> float:
    """Angle between two directions, ignoring their signs [deg]."""
    return math.degrees(math.acos(min(1.0, abs(float(a @ b)))))


def points_on(normal, offset: float, n: int, noise: float, seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    normal = torch.tensor(normal) / torch.tensor(normal).norm()
    points = 2 * torch.rand(n, 3, generator=generator) - 1
    points -= (points @ normal)[:, None] * normal
    return points + normal * (offset + noise * torch.randn(n, 1, generator=generator)), normal


def test_plane_through_three_points():
    normals, offsets = planes_through(torch.tensor([[[0.0, 0, 2], [1, 0, 2], [0, 1, 2]]]))
    torch.testing.assert_close(normals, torch.tensor([[0.0, 0, 1]]))
    torch.testing.assert_close(offsets, torch.tensor([2.0]))


def test_heights_are_signed():
    plane = Plane(torch.tensor([0.0, 0, 1]), 1.0)
    torch.testing.assert_close(plane.heights(torch.tensor([[5.0, 5, 3], [0, 0, 0]])), torch.tensor([2.0, -1.0]))


def test_least_squares_on_a_noisy_plane():
    # The slope error of a fit over a square of half side 1: noise / sqrt(n / 3), here 0.03 degrees.
    points, normal = points_on([1.0, 2, 3], 0.7, 1000, 0.01)
    plane = fit_plane(points)
    assert angle(plane.normal, normal) < 0.15
    assert abs(abs(plane.offset) - 0.7) < 0.002


def test_weighted_fit():
    low, _ = points_on([0.0, 0, 1], 0.0, 200, 0.0)
    high, _ = points_on([0.0, 0, 1], 1.0, 200, 0.0)
    weights = torch.cat([torch.ones(200), torch.full((200,), 1e-6)])
    assert abs(fit_plane(torch.cat([low, high]), weights).offset) < 1e-4


def test_ransac_with_half_outliers():
    points, normal = points_on([1.0, -1, 4], -0.2, 1000, 0.005)
    outliers = 4 * torch.rand(1000, 3, generator=torch.Generator().manual_seed(1)) - 2
    plane, inside = ransac(torch.cat([points, outliers]), 0.02, allowed=lambda n: n[:, 2] > 0)
    assert angle(plane.normal, normal) < 0.3
    assert plane.normal[2] > 0 and abs(plane.offset + 0.2) < 0.003
    assert inside[:1000].float().mean() > 0.99
    assert inside[1000:].float().mean() < 0.05  # a slab of thickness 0.04 through a cube of side 4


def test_larger_plane_with_forbidden_normal_is_rejected():
    wall, _ = points_on([1.0, 0, 0], 0.0, 2000, 0.0)
    floor, up = points_on([0.0, 0, 1], -1.0, 300, 0.0)
    plane, _ = ransac(torch.cat([wall, floor]), 0.01, allowed=lambda n: n[:, 2] > 0.9)
    assert angle(plane.normal, up) < 0.1


def test_the_same_seed_gives_the_same_plane():
    points, _ = points_on([1.0, 2, 3], 0.1, 500, 0.05)
    first, second = (ransac(points, 0.03, seed=3)[0] for _ in range(2))
    assert torch.equal(first.normal, second.normal) and first.offset == second.offset


@pytest.mark.parametrize("points", [torch.zeros(2, 3), torch.zeros(50, 3)], ids=["two points", "one place"])
def test_no_plane_for_too_few_points(points):
    assert ransac(points, 0.01) is None


def test_ransac_takes_the_plane_of_the_largest_weight():
    low, high = (points_on([0.0, 0, 1], z, n, 0.0)[0] for z, n in ((0.0, 300), (1.0, 100)))
    points = torch.cat([low, high])
    for weight, expected in ((1.0, 0.0), (6.0, 1.0)):
        plane, inside = ransac(points, 0.01, torch.cat([torch.ones(300), torch.full((100,), weight)]))
        assert abs(plane.heights(torch.tensor([0.0, 0, expected]))) < 1e-4
        assert torch.equal(inside, (points[:, 2] - expected).abs() < 0.01)


def test_refined_plane_is_the_fit_to_its_inliers():
    points, _ = points_on([1.0, -1, 4], -0.2, 300, 0.01)
    plane, inside = ransac(points, 0.02, allowed=lambda n: n[:, 2] < 0, trials=500)
    assert plane.normal[2] < 0
    again = fit_plane(points[inside])
    assert angle(plane.normal, again.normal) < 0.1 and abs(abs(again.offset) - abs(plane.offset)) < 1e-3
    torch.testing.assert_close(plane.normal.norm(), torch.tensor(1.0))


def test_no_plane_where_no_normal_is_allowed():
    points, _ = points_on([0.0, 0, 1], 0.0, 100, 0.0)
    assert ransac(points, 0.01, allowed=lambda n: n[:, 2] > 2) is None
