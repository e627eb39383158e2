"""Up direction, floor and scale of point sets in a known frame."""

import math

import pytest
import torch

from stages.core.geometry.cameras import centres, look_at, orbit
from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.reconstruct import world_frame
from stages.reconstruct.options import UP_SIDES


def tabletop(seed: int = 0) -> torch.Tensor:
    """A table of half side 0.5 at z = 0 with noise of 1 mm, a box on it, and a floor far below."""
    generator = torch.Generator().manual_seed(seed)
    rand = lambda n: torch.rand(n, 3, generator=generator) - 0.5  # noqa: E731
    table = rand(4000) * torch.tensor([1.0, 1, 0])
    table[:, 2] += 0.001 * torch.randn(4000, generator=generator)
    box = rand(3000) * torch.tensor([0.3, 0.1, 0.3]) + torch.tensor([0.0, 0.1, 0.15])
    floor = rand(8000) * torch.tensor([4.0, 4, 0]) - torch.tensor([0, 0, 0.7])
    return torch.cat([table, box, floor])


def one_sided() -> torch.Tensor:
    """Five cameras on one side, pitched down by 30 degrees, so that their mean up axis is tilted by as much."""
    return orbit(5, torch.tensor([0.0, 0, 0.1]), 1.0, elevation=30.0, azimuth=10.0, sweep=50.0)


def full_ring() -> torch.Tensor:
    return orbit(8, torch.tensor([0.0, 0, 0.1]), 1.0, elevation=30.0)


def displaced(points, viewmats, seed: int):
    """The same scene in an arbitrary frame at half the size, as from structure from motion; and the similarity."""
    generator = torch.Generator().manual_seed(seed)
    R = matrix(torch.randn(4, generator=generator))
    move = Similarity(0.5, R, torch.randn(3, generator=generator))
    return move(points), move.viewmats(viewmats), move


@pytest.mark.parametrize("cameras", [one_sided(), full_ring()], ids=["side", "ring"])
@pytest.mark.parametrize("seed", [0, 1])
def test_table_is_horizontal_at_zero(cameras, seed):
    points, viewmats, move = displaced(tabletop(), cameras, seed)
    focus = move(torch.tensor([0.0, 0, 0.1]))
    ground = world_frame.refine_ground(world_frame.find_ground(points, viewmats, focus, seed), points, seed)
    world = world_frame.to_world(ground, points, viewmats, metric=False)
    tilt = math.degrees(math.acos(min(1.0, float((world.rotation @ move.rotation)[2, 2]))))
    assert tilt < 0.5
    table = world(points)[:4000]
    assert table[:, 2].abs().median() < 0.002
    assert abs(float(table[:, 2].mean())) < 0.002


def test_textured_objects_do_not_tilt_the_plane():
    # A keyboard and a book, 15 and 35 mm high, have ten times as many points as the table under them.
    generator = torch.Generator().manual_seed(0)
    rand = lambda n: torch.rand(n, 3, generator=generator) - 0.5  # noqa: E731
    table = rand(900) * torch.tensor([1.2, 0.8, 0.0])
    keyboard = rand(5000) * torch.tensor([0.15, 0.45, 0]) + torch.tensor([-0.25, 0, 0.015])
    book = rand(4000) * torch.tensor([0.2, 0.25, 0]) + torch.tensor([0.3, 0.1, 0.035])
    points = torch.cat([table, keyboard, book])
    points += 0.001 * torch.randn(points.shape, generator=generator)
    first = world_frame.find_ground(points, full_ring(), torch.zeros(3))
    ground = world_frame.refine_ground(first, points)
    tilt = lambda up: math.degrees(math.acos(min(1.0, float(up[2]))))  # noqa: E731
    assert tilt(first.up) > 2
    assert tilt(ground.up) < 0.3 and abs(float(ground.plane.heights(torch.zeros(3)))) < 0.002


@pytest.mark.parametrize("cameras", [full_ring, one_sided])
@pytest.mark.parametrize("side", UP_SIDES)
def test_up_is_found_in_turned_photos(cameras, side):
    points, viewmats, move = displaced(tabletop(), cameras(), 4)
    opposite = {"right": "left", "left": "right"}.get(side, side)
    ground = world_frame.find_ground(points, world_frame.turned(viewmats, opposite), move(torch.tensor([0.0, 0, 0.1])))
    assert ground.up_side == side and not ground.rival
    assert float(ground.up @ move.rotation[:, 2]) > math.cos(math.radians(3))


def test_a_table_and_a_wall_of_like_size_are_told_apart_by_the_given_side():
    """In photos from one side of a corner the table is below the cameras, in rotated ones the wall is."""
    generator = torch.Generator().manual_seed(0)
    table = torch.rand(3000, 3, generator=generator) * torch.tensor([2.0, 2, 0]) - torch.tensor([1.0, 1, 0])
    wall = torch.rand(3000, 3, generator=generator) * torch.tensor([0.0, 2, 2]) - torch.tensor([1.0, 1, 0])
    eyes = torch.tensor([[1.0, 0.2 * k, 1.0] for k in range(-3, 4)])
    viewmats, points = look_at(eyes, torch.tensor([[-0.5, 0.0, 0.5]]).expand(7, 3)), torch.cat([table, wall])
    focus = torch.tensor([-0.7, 0.0, 0.3])
    assert float(world_frame.find_ground(points, viewmats, focus).up[2]) > 0.99
    sideways = world_frame.turned(viewmats, "bottom")
    found = world_frame.find_ground(points, sideways, focus, up_side="bottom")
    assert float(found.up[2]) > 0.99 and not found.rival


def test_focus_scale_and_heading():
    points, viewmats, move = displaced(tabletop(), one_sided(), 2)
    focus = move(torch.tensor([0.0, 0, 0.1]))
    ground = world_frame.find_ground(points, viewmats, focus)
    world = world_frame.to_world(ground, points, viewmats, metric=False)
    torch.testing.assert_close(world(focus)[:2], torch.zeros(2), rtol=0, atol=1e-4)
    eyes = world(centres(viewmats))
    assert abs(float((eyes - world(focus)).norm(dim=1).median()) - 1) < 1e-3
    assert abs(float(eyes[0, 0])) < 1e-3 and eyes[0, 1] < 0  # the first camera is on the -y side
    assert torch.det(world.rotation) > 0.999


def test_scale_of_given_cameras_is_kept():
    points, viewmats, move = displaced(tabletop(), one_sided(), 3)
    ground = world_frame.find_ground(points, viewmats, move(torch.tensor([0.0, 0, 0.1])))
    assert world_frame.to_world(ground, points, viewmats, metric=True).scale == 1.0


def test_a_table_seen_from_above_is_the_floor():
    """A slanted plane through the table and the things on it looks more like one that the cameras look down on."""
    generator = torch.Generator().manual_seed(0)
    rand = lambda n: torch.rand(n, 3, generator=generator) - 0.5  # noqa: E731
    table = rand(6000) * torch.tensor([0.6, 0.5, 0])
    things = rand(6000) * torch.tensor([0.4, 0.3, 0.15]) + torch.tensor([0, 0, 0.075])
    eyes = torch.tensor([[x, y, 0.9] for x in (-0.2, 0.0, 0.2) for y in (-0.15, 0.0, 0.15)])
    viewmats = look_at(eyes, eyes * torch.tensor([0.8, 0.8, 0]) + torch.tensor([0, 0.1, 0]))
    ground = world_frame.find_ground(torch.cat([table, things]), viewmats, torch.zeros(3))
    assert float(ground.up[2]) > 0.999 and abs(float(ground.plane.offset)) < 0.01


def test_wall_is_not_a_floor():
    # For an object on a wall and horizontal cameras there is no floor, and up is the up axis of the cameras.
    generator = torch.Generator().manual_seed(0)
    wall = torch.rand(5000, 3, generator=generator) * torch.tensor([2.0, 0, 2]) + torch.tensor([-1.0, 1, -1])
    bump = 0.2 * torch.randn(2000, 3, generator=generator)
    eyes = torch.stack([torch.linspace(-0.5, 0.5, 6), torch.full((6,), -1.0), torch.zeros(6)], 1)
    viewmats = look_at(eyes, torch.zeros(6, 3))
    ground = world_frame.find_ground(torch.cat([wall, bump]), viewmats, torch.zeros(3))
    assert ground.plane is None
    assert float(ground.up[2]) > 0.999


def test_up_from_cameras_without_roll():
    ring = orbit(8, torch.zeros(3), 2.0, elevation=50.0)
    assert float(world_frame.up_from_cameras(ring)[2]) > 0.9999


def test_focus_is_ahead_of_the_cameras():
    viewmats = orbit(8, torch.tensor([1.0, 2, 3]), 2.0, elevation=20.0)
    focus = world_frame.focus_point(viewmats, torch.full((8,), 2.0))
    torch.testing.assert_close(focus, torch.tensor([1.0, 2, 3]), rtol=0, atol=1e-4)
