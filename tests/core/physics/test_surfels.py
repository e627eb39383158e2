"""The steps of computing signed distances, each with cases computed by hand."""

import math

import pytest
import torch

from stages.core.geometry.neighbours import neighbour_index
from stages.core.physics import signed_distance
from stages.core.physics.signed_distance import DIRECTIONS, DistanceGrid, Surfels, mass_properties

INSIDE = -torch.ones(1, dtype=torch.float64)  # sign of a position inside the body, as determined by its rays


def grid_of(distance, low, cell, resolution=32):
    empty = DistanceGrid(torch.zeros((resolution,) * 3), torch.tensor(low), torch.tensor(cell))
    return DistanceGrid(distance(empty.nodes()), empty.low, empty.cell)


def test_nodes_are_cells_apart_along_each_axis():
    nodes = DistanceGrid(torch.zeros(4, 4, 4), torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.1, 0.2, 0.3])).nodes()
    assert nodes.shape == (4, 4, 4, 3)
    torch.testing.assert_close(nodes[1, 2, 3], torch.tensor([1.1, 2.4, 3.9]))


def test_mass_of_a_ball_whose_distances_are_exact():
    """The cells have different lengths along each axis, and the centre is not the origin; the error is second order."""
    centre = torch.tensor([1.0, -2.0, 0.5])
    grid = grid_of(lambda x: (x - centre).norm(dim=-1) - 0.8, [0.0, -3.0, -0.5], [0.066, 0.064, 0.062])
    volume, com, inertia = mass_properties(grid)
    assert volume == pytest.approx(4 / 3 * math.pi * 0.8**3, rel=0.01)
    torch.testing.assert_close(com, centre, rtol=0, atol=1e-3)
    torch.testing.assert_close(inertia, 0.4 * 0.8**2 * torch.eye(3), rtol=0.01, atol=1e-3)


def test_inertia_of_a_leaning_rod_is_that_of_its_direction():
    along = torch.tensor([0.6, 0.8, 0.0])
    length, radius = 1.0, 0.15

    def capsule(x):
        return (x - (x @ along).clamp(-length / 2, length / 2)[..., None] * along).norm(dim=-1) - radius

    _, com, inertia = mass_properties(grid_of(capsule, [-0.8] * 3, [0.025] * 3, 64))
    assert com.abs().max() < 1e-3
    values, axes = torch.linalg.eigh(inertia)
    assert float((axes[:, 0] @ along).abs()) == pytest.approx(1, abs=1e-3)
    torch.testing.assert_close(values[1], values[2], rtol=0.01, atol=0)
    cylinder, ball = length * radius**2, 4 / 3 * radius**3  # volumes divided by pi
    about = (cylinder * radius**2 / 2 + ball * 0.4 * radius**2) / (cylinder + ball)
    assert float(values[0]) == pytest.approx(about, rel=0.03)
    across = cylinder * (radius**2 / 4 + length**2 / 12)
    across += ball * (0.4 * radius**2 + length**2 / 4 + 3 / 8 * length * radius)  # half balls at both ends
    assert float(values[2]) == pytest.approx(across / (cylinder + ball), rel=0.02)


def test_an_empty_grid_has_no_mass():
    volume, com, inertia = mass_properties(grid_of(lambda x: 0 * x[..., 0] + 9, [0.0] * 3, [0.1] * 3, 8))
    assert volume == 0 and com.isfinite().all() and inertia.isfinite().all()


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -1, 0), (1, -1, 1)])
def test_masks_are_shifted_along_a_direction(direction):
    mask = torch.rand(6, 6, 6, generator=torch.Generator().manual_seed(0)) > 0.5
    shifted = signed_distance._shifted(mask, direction, 2)
    for i in torch.cartesian_prod(*[torch.arange(6)] * 3):
        there = i + 2 * torch.tensor(direction)
        inside = bool(((there >= 0) & (there < 6)).all())
        assert shifted[tuple(i)] == (inside and bool(mask[tuple(there.clamp(0, 5))]))


def test_openness_is_the_fraction_of_rays_that_leave():
    surface = torch.zeros(9, 9, 9, dtype=torch.bool)
    assert (signed_distance._openness(surface) == 1).all() and len(DIRECTIONS) == 26
    surface[:, :, 4] = True
    open_ = signed_distance._openness(surface)
    assert float(open_[4, 4, 2]) == pytest.approx(17 / 26)  # 9 of the 26 rays go up
    assert float(open_[0, 4, 3]) == pytest.approx(20 / 26)  # 3 of these leave at the side before
    box = torch.ones(9, 9, 9, dtype=torch.bool)
    box[1:-1, 1:-1, 1:-1] = False
    assert float(signed_distance._openness(box)[4, 4, 4]) == 0
    box[:, 4, 4] = False
    assert float(signed_distance._openness(box)[4, 4, 4]) == pytest.approx(2 / 26)
    far = torch.zeros(9, 9, 9, dtype=torch.bool)
    far[8, 0, 0] = True
    assert float(signed_distance._openness(far)[0, 0, 0]) == pytest.approx(25 / 26)  # the surface is 8 nodes away


def plane(step=0.1, count=9):
    """Points of a square grid in the plane z = 0."""
    line = step * (torch.arange(count, dtype=torch.float64) - count // 2)
    return torch.cat([torch.cartesian_prod(line, line), torch.zeros(count**2, 1, dtype=torch.float64)], 1)


def test_discs_lie_in_the_plane_of_their_neighbours():
    turned = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))[0]
    points = plane() @ turned.T
    discs = signed_distance._unoriented(points, neighbour_index(points))
    torch.testing.assert_close((discs.normal @ turned[:, 2]).abs(), torch.ones(81, dtype=torch.float64))
    middle = discs.radius.reshape(9, 9)[1:-1, 1:-1]
    torch.testing.assert_close(middle, torch.full_like(middle, 0.1))  # distance of the fourth neighbour
    assert discs.radius.reshape(9, 9)[0, 0] == pytest.approx(0.2) and not discs.half_thickness.any()
    assert len(signed_distance._unoriented(points[:2], neighbour_index(points[:2])).radius) == 2


def disc(radius=0.2, half_thickness=0.0):
    def row(*values):
        return torch.tensor([values], dtype=torch.float64)

    return Surfels(row(0, 0, 0), row(0, 0, 1), row(radius)[0], row(half_thickness)[0])


@pytest.mark.parametrize(("x", "expected"), [
    ((0, 0, 0.3), 0.3), ((0.1, 0, -0.3), -0.3), ((0.4, 0, 0.2), 0.2), ((0.4 + 0.3, 0, 0.4), 0.5),
    ((0, -0.7, -0.4), -0.5),
])  # fmt: skip
def test_distance_to_a_disc_and_to_its_edge(x, expected):
    """Discs extend to OVERLAP = 2 times their radius of 0.2."""
    x = torch.tensor([x], dtype=torch.float64)
    nearest = (x.norm(dim=1, keepdim=True), torch.zeros(1, 1, dtype=torch.int64))
    assert float(signed_distance._distance(disc(), x, nearest, INSIDE)) == pytest.approx(expected)
    sheet = signed_distance._distance(disc(half_thickness=0.05), x, nearest, INSIDE)
    assert float(sheet) == pytest.approx(abs(expected) - 0.05)


def test_the_rays_decide_in_the_plane_of_a_disc():
    x = torch.tensor([[0.7, 0.0, -1e-12]], dtype=torch.float64)
    nearest = (x.norm(dim=1, keepdim=True), torch.zeros(1, 1, dtype=torch.int64))
    for side in (INSIDE, -INSIDE):
        assert float(signed_distance._distance(disc(), x, nearest, side)) == pytest.approx(0.3 * float(side))


def test_distances_to_discs_are_averaged_by_their_nearness_but_not_across_an_edge():
    two = Surfels(*(torch.tensor(v, dtype=torch.float64) for v in (
        [[0, 0, 0], [0, 0, -0.1]], [[0, 0, 1], [0, 0, 1]], [0.2, 0.2], [0, 0])))  # fmt: skip
    x = torch.tensor([[0, 0, 0.3]], dtype=torch.float64)
    nearest = torch.tensor([[0.3, 0.4]], dtype=torch.float64), torch.tensor([[0, 1]])
    weight = math.exp((0.3**2 - 0.4**2) / 0.2**2)
    found = float(signed_distance._distance(two, x, nearest, INSIDE))
    assert found == pytest.approx((0.3 + weight * 0.4) / (1 + weight))
    two.normal[1] = torch.tensor([0, 0.9, math.sqrt(0.19)])  # its cosine with the first normal is 0.44
    assert float(signed_distance._distance(two, x, nearest, INSIDE)) == pytest.approx(0.3)
    two.normal[1] = torch.tensor([0, math.sqrt(1 - 0.6**2), 0.6])
    assert float(signed_distance._distance(two, x, nearest, INSIDE)) != pytest.approx(0.3)


@pytest.mark.parametrize(("node", "on"), [
    ((0, 0, 0.14), True), ((0, 0, -0.16), False), ((0.34, 0, 0.1), True), ((0.36, 0, 0.1), False),
])  # fmt: skip
def test_nodes_on_a_disc_are_three_quarters_of_a_cell_away_at_most(node, on):
    cell = torch.tensor([0.5, 0.5, 0.2], dtype=torch.float64)  # 3/4 of a cell along the normal: 0.15
    node, index = torch.tensor([node], dtype=torch.float64), torch.zeros(1, 1, dtype=torch.int64)
    assert bool(signed_distance._on_surface(disc(), node, index, cell)) == on


@pytest.mark.parametrize(("above", "below", "outward", "thickness"), [
    (0.9, 0.0, 1, 0.0), (0.0, 0.9, -1, 0.0), (0.9, 0.5, 1, 0.02), (0.3, 0.4, -1, 0.02), (0.9, 0.05, 1, 0.0),
    (0.9, 0.07, 1, 0.02),
])  # fmt: skip
def test_the_more_open_side_is_outside_and_sheets_are_open_at_both(above, below, outward, thickness):
    points = plane()
    normals = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).repeat(81, 1)
    normals[::3] *= -1
    discs = Surfels(points, normals, torch.full((81,), 0.1).double(), torch.zeros(81).double())
    openness = torch.full((20, 20, 20), above)
    openness[:, :, :10] = below
    low, cell = torch.full((3,), -0.95).double(), torch.full((3,), 0.1).double()
    found = signed_distance._oriented(discs, neighbour_index(points), openness, low, cell, 0.04)
    torch.testing.assert_close(found.normal, outward * torch.tensor([[0.0, 0.0, 1.0]]).double().repeat(81, 1))
    torch.testing.assert_close(found.half_thickness, torch.full((81,), thickness).double())


@pytest.mark.parametrize("openness", [0.0, 0.5])
@pytest.mark.parametrize("height", [-0.3, 0.3])
def test_equal_sides_face_away_from_the_middle(height, openness):
    points = plane() + torch.tensor([0.0, 0.0, height], dtype=torch.float64)
    normals = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).repeat(81, 1)
    discs = Surfels(points, normals, torch.full((81,), 0.1).double(), torch.zeros(81).double())
    low, cell = torch.full((3,), -0.95).double(), torch.full((3,), 0.1).double()
    around = torch.full((20, 20, 20), openness)
    found = signed_distance._oriented(discs, neighbour_index(points), around, low, cell, 0.04)
    assert (found.normal[:, 2] == math.copysign(1, height)).all()
    assert (found.half_thickness == (0.02 if openness else 0.0)).all()
