"""Signed distance and mass properties of boxes, balls and sheets, whose values are known."""

import pytest
import torch

from stages.core.physics.signed_distance import DistanceGrid, distance_grid, mass_properties


def box_surface(sides: tuple, count: int, seed: int = 0) -> torch.Tensor:
    """Random points on the surface of a box about the origin."""
    rng, s = torch.Generator().manual_seed(seed), torch.tensor(sides)
    face = torch.multinomial(torch.stack([s[1] * s[2], s[0] * s[2], s[0] * s[1]]).repeat(2), count, True, generator=rng)
    x = torch.rand(count, 3, generator=rng) - 0.5
    x[torch.arange(count), face % 3] = torch.where(face < 3, -0.5, 0.5)
    return x * s


def on_the_cpu(grid: DistanceGrid) -> DistanceGrid:
    return DistanceGrid(grid.values.cpu(), grid.low.cpu(), grid.cell.cpu())


def box_distance(x: torch.Tensor, sides: tuple) -> torch.Tensor:
    q = x.abs() - torch.tensor(sides) / 2
    return q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0)


@pytest.mark.parametrize("sides", [(1.0, 1.0, 1.0), (1.0, 0.6, 0.1)])
def test_distance_and_inertia_of_a_box(sides, device):
    """Above faces the distance is exact up to gaps between random points; at edges it deviates by a part of a gap."""
    grid = on_the_cpu(distance_grid(box_surface(sides, 3000).to(device), 0.02))
    x = grid.nodes()
    error = (grid.values - box_distance(x, sides)).abs()
    # the points' distance from edges is at least three times that from the surface
    above = (0.5 * torch.tensor(sides) - x.abs() > 0.15).sum(-1) == 2
    near = box_distance(x, sides).abs() < 0.04
    assert error[above & near].quantile(0.98) < 1e-3 and error[above & near].max() < 0.01
    assert error[near].square().mean().sqrt() < 0.01
    volume, centre, inertia = mass_properties(grid)
    squared = torch.tensor(sides).square()
    assert volume == pytest.approx(sides[0] * sides[1] * sides[2], rel=0.05)
    assert centre.abs().max() < 5e-3
    torch.testing.assert_close(inertia, torch.diag((squared.sum() - squared) / 12), rtol=0.07, atol=2e-3)


def test_inertia_of_a_ball(device):
    points = torch.nn.functional.normalize(torch.randn(1000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    volume, _, inertia = mass_properties(on_the_cpu(distance_grid(points.to(device), 0.05)))
    assert volume == pytest.approx(4 / 3 * torch.pi, rel=0.03)
    torch.testing.assert_close(inertia, 0.4 * torch.eye(3), rtol=0.05, atol=5e-3)


def test_an_open_shell_has_no_inside(device):
    """A sheet is solid only within its thickness; the same holds for a hemisphere, whose inside can be reached."""
    rng = torch.Generator().manual_seed(0)
    flat = torch.rand(2000, 3, generator=rng) * torch.tensor([1.0, 1.0, 0.0])
    grid = on_the_cpu(distance_grid(flat.to(device), 0.04))
    x = grid.nodes()
    over = ((x[..., :2] - 0.5).abs() < 0.4).all(-1) & (x[..., 2].abs() < 0.1)
    torch.testing.assert_close(grid.values[over], x[over][:, 2].abs() - 0.02, rtol=0, atol=2e-3)
    half = torch.nn.functional.normalize(torch.randn(4000, 3, generator=rng), dim=1)
    half[:, 2] = -half[:, 2].abs()  # open above
    grid = on_the_cpu(distance_grid(half.to(device), 0.04))
    inner = grid.nodes().norm(dim=-1) < 0.7
    assert (grid.values[inner] > 0).float().mean() > 0.9  # the exceptions are near the rim


def test_missing_points_do_not_open_a_body(device):
    """A box without the lower tenth of its surface, like objects on a table in photos."""
    points = box_surface((1.0, 1.0, 1.0), 4000)
    points = points[points[:, 2] > -0.49]
    grid = on_the_cpu(distance_grid(points.to(device), 0.02))
    x = grid.nodes()
    beside = (x[..., 2] - 0.1).abs() < 0.3
    error = (grid.values - box_distance(x, (1.0, 1.0, 1.0))).abs()
    assert error[beside & (box_distance(x, (1.0, 1.0, 1.0)).abs() < 0.04)].square().mean().sqrt() < 0.01


def test_exchanged_axes_exchange_the_distances(device):
    """Points inside a body have equal sides; the choice of the outer one must not depend on an eigenvector's sign."""
    inner = 0.3 * (torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) - 0.5)
    points = torch.cat([box_surface((1.0, 0.6, 0.5), 4000), inner]).double().to(device)
    values = distance_grid(points, 0.02).values
    exchanged = distance_grid(points[:, [1, 0, 2]], 0.02).values.transpose(0, 1)
    assert (values.abs() - exchanged.abs()).abs().max() < 1e-6
    different = (values - exchanged).abs() > 1e-4  # nodes in the plane of a disc beside it can have either sign
    assert different.float().mean() < 1e-4
    assert (values.abs() * different).max() < 0.1 * 0.02


def test_rounding_changes_no_distance(device):
    """Faces lie on nodes of the grid; the distance of nodes beside the body must not depend on rounding errors."""
    points = box_surface((1.0, 0.6, 0.5), 2000).double()
    noise = 1e-12 * torch.randn(points.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    one, other = (distance_grid(p.to(device), 0.02).values for p in (points, points + noise))
    torch.testing.assert_close(one, other, rtol=0, atol=1e-6)
