"""Rigid bodies of objects: convex hulls, moments of inertia, and balls."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from stages.core.geometry.cameras import orbit
from stages.core.physics.rigid_shapes import _voxel_moments, rigid_shapes
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.shapes import Surface, box, ellipsoid, to_gaussians, union
from stages.lab.bench.experiments.bodies import bowl
from tests.conftest import two_balls_scene


@cache
def scene(surface: Surface) -> Scene:
    """Scene with one object; cached, because Surface is hashed by identity."""
    g = to_gaussians(surface, torch.full((len(surface.points), 3), 0.5), 1)
    return Scene(g, (SceneObject(1, "thing"),))


def test_a_box_is_convex_with_its_own_volume_and_inertia():
    a, b, c = sides = (0.2, 0.1, 0.3)
    shape = rigid_shapes(scene(box(sides, 0.01).moved((1.0, 2.0, 3.0))))[0]
    assert shape.convex and shape.volume == pytest.approx(a * b * c, rel=0.02)  # edges between the points are cut off
    torch.testing.assert_close(shape.com, torch.tensor([1.0, 2.0, 3.0]), rtol=0, atol=1e-4)
    expected = shape.volume / 12 * torch.diag(torch.tensor([b * b + c * c, a * a + c * c, a * a + b * b]))
    torch.testing.assert_close(shape.inertia, expected, rtol=0.02, atol=1e-6)


def test_a_ball_has_the_moments_of_a_ball():
    shape = rigid_shapes(scene(ellipsoid((0.1, 0.1, 0.1), 3000)))[0]
    hull = shape.hull
    torch.testing.assert_close(hull.norm(dim=1), torch.full((len(hull),), 0.1), rtol=1e-3, atol=0)
    assert shape.ball.radius == pytest.approx(0.1, rel=1e-3)
    assert shape.volume == pytest.approx(4 / 3 * math.pi * 1e-3, rel=3e-3)
    torch.testing.assert_close(shape.inertia, 0.4 * shape.volume * 0.01 * torch.eye(3), rtol=3e-3, atol=1e-12)


def test_an_egg_is_round_to_one_percent():
    radii = torch.tensor([0.1, 0.1, 0.12])
    shape = rigid_shapes(scene(ellipsoid(tuple(radii.tolist()), 3000)))[0]
    hull = shape.hull
    assert shape.ball is None and len(hull) == 200
    torch.testing.assert_close((hull / radii).norm(dim=1), torch.ones(200), rtol=1e-3, atol=0)
    expected = shape.volume / 5 * (radii.square().sum() - radii.square())
    torch.testing.assert_close(shape.inertia.diagonal(), expected, rtol=0.01, atol=0)


def test_a_cone_keeps_its_tip():
    """3/10 m r^2 about its axis, m (3/20 r^2 + 3/80 h^2) across it; the samples' spacing of .02 r cuts off edges."""
    radius, height = 0.1, 0.2
    rng = torch.Generator().manual_seed(0)
    share, turn = torch.rand(12000, generator=rng).sqrt(), 2 * math.pi * torch.rand(12000, generator=rng)
    base = torch.arange(12000) < 12000 / (1 + math.sqrt(5))  # the area of the base and that of the side
    ring = radius * share[:, None] * torch.stack([turn.cos(), turn.sin()], 1)
    points = torch.cat([ring, torch.where(base, 0.0, height * (1 - share))[:, None]], 1)
    out = torch.where(base[:, None], torch.tensor([0.0, 0, -1]), torch.nn.functional.normalize(points, dim=1))
    shape = rigid_shapes(scene(Surface(points, out)))[0]
    assert shape.convex and float(shape.hull[:, 2].max()) > 0.97 * height
    assert shape.volume == pytest.approx(math.pi * radius**2 * height / 3, rel=0.02)
    across = 3 / 20 * radius**2 + 3 / 80 * height**2
    expected = shape.volume * torch.tensor([across, across, 3 / 10 * radius**2])
    torch.testing.assert_close(shape.inertia.diagonal(), expected, rtol=0.02, atol=0)


def test_a_ball_does_not_reach_into_another_object():
    """A ball without 1/10 of its height on a block: a complete ball would penetrate the block."""
    dome = ellipsoid((0.1,) * 3, 3000)
    dome = together(dome.kept(dome.points[:, 2] > -0.08), disc(0, 0.06, -0.08))
    block = box((0.3, 0.3, 0.1), 0.01).moved((0.0, 0.0, -0.131))
    grey = [to_gaussians(s, torch.full((len(s.points), 3), 0.5), i) for i, s in enumerate((dome, block), start=1)]
    cameras = orbit(2, torch.zeros(3), 1.0, 20.0), torch.eye(3).expand(2, 3, 3), torch.full((2, 2), 100), ("a", "b")
    seen = Scene(grey[0], (SceneObject(1, "dome"),), Cameras(*cameras))
    on_block = replace(seen, gaussians=concatenate(grey), objects=(*seen.objects, SceneObject(2, "block")))
    assert rigid_shapes(seen)[0].ball is not None and rigid_shapes(on_block)[0].ball is None


def test_inertia_of_two_cubes_that_are_one_object():
    """Cubes of side 0.1 with centres 0.2 to both sides of the middle: own inertia plus that of their positions."""
    cubes = [(box((0.1,) * 3, 0.01).moved((x, 0.0, 0.0)), lambda p: p[:, 0] > 9) for x in (-0.2, 0.2)]
    shape = rigid_shapes(scene(union(*cubes)))[0]
    side = (shape.volume / 2) ** (1 / 3)
    assert side == pytest.approx(0.1, abs=0.5 / 48)  # accurate to a voxel
    own = side**2 / 6
    expected = torch.diag(torch.tensor([own, own + 0.04, own + 0.04]))
    torch.testing.assert_close(shape.inertia / shape.volume, expected, rtol=0.02, atol=0.02 * own)


@pytest.mark.parametrize("counts", [(1, 1, 1), (2, 3, 1)])
def test_moments_of_full_voxels_are_those_of_their_box(counts):
    """V / 12 (b^2 + c^2) about the axis perpendicular to sides b and c; a half-full voxel counts half."""
    h, first = 0.1, np.array([1.0, 2.0, 3.0])
    x = first + h * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1).reshape(-1, 3)
    volume, com, inertia = _voxel_moments(x, np.ones(len(x)), h)
    sides = h * torch.tensor(counts)
    assert volume == pytest.approx(float(sides.prod()))
    torch.testing.assert_close(com, torch.from_numpy(x.mean(0)).float())
    expected = volume / 12 * (sides.square().sum() - sides.square())
    torch.testing.assert_close(inertia, torch.diag(expected), rtol=1e-5, atol=1e-9)
    pair = np.stack([first, first + [3 * h, 0, 0]])
    volume, com, _ = _voxel_moments(pair, np.array([1.0, 0.5]), h)
    assert volume == pytest.approx(1.5 * h**3) and float(com[0]) == pytest.approx(1.0 + h)


def test_what_is_below_the_floor_is_cut_off():
    """A cube is a quarter below the floor; one that is completely below keeps its topmost layer."""
    cube = scene(box((0.2,) * 3, 0.01))
    shape = rigid_shapes(cube, bottom=-0.05)[0]
    assert shape.volume == pytest.approx(0.75 * 0.2**3, rel=0.03)
    torch.testing.assert_close(shape.com, torch.tensor([0.0, 0.0, 0.025]), rtol=0, atol=2e-3)
    assert float(shape.hull[:, 2].min()) == pytest.approx(-0.05, abs=1e-6)
    assert rigid_shapes(cube, bottom=0.3)[0].volume > 0


def test_a_sparse_ball_on_the_floor_is_filled():
    """It has gaps where the floor closes the surface; a shell would have much less volume than its hull."""
    assert rigid_shapes(two_balls_scene())[0].convex


def disc(inner: float, outer: float, z: float, spacing: float = 0.005) -> Surface:
    """Points on a disc or ring at height z."""
    k = torch.arange(int(math.pi * (outer**2 - inner**2) / spacing**2)) + 0.5
    r = (inner**2 + k * spacing**2 / math.pi).sqrt()
    turn = k * math.pi * (1 + 5**0.5)
    points = torch.stack([r * turn.cos(), r * turn.sin(), torch.full_like(r, z)], 1)
    return Surface(points, torch.tensor([0.0, 0.0, 1.0]).expand(len(r), 3))


def wall(radius: float, low: float, high: float, spacing: float = 0.005) -> Surface:
    """Points on a cylinder surface about z."""
    turn = torch.arange(int(2 * math.pi * radius / spacing)) * spacing / radius
    a, z = torch.meshgrid(turn, torch.arange(low + spacing / 2, high, spacing), indexing="ij")
    out = torch.stack([a.cos(), a.sin(), torch.zeros_like(a)], -1).reshape(-1, 3)
    return Surface(radius * out + z.reshape(-1, 1) * torch.tensor([0.0, 0.0, 1.0]), out)


def together(*surfaces: Surface) -> Surface:
    return Surface(torch.cat([s.points for s in surfaces]), torch.cat([s.normals for s in surfaces]))


def plate(thickness: float) -> tuple[Surface, float]:
    """A disc of radius 0.15, and its volume."""
    r, t = 0.15, thickness
    return together(disc(0, r, 0.0), disc(0, r, t), wall(r, 0.0, t)), math.pi * r**2 * t


def pan(thickness: float) -> tuple[Surface, float]:
    """A pan of radius 0.15 and height 0.06, and the volume of its walls."""
    r, h, t = 0.15, 0.06, thickness
    surface = together(disc(0, r, 0.0), disc(0, r - t, t), wall(r, 0.0, h), wall(r - t, t, h), disc(r - t, r, h))
    return surface, math.pi * (r**2 * h - (r - t) ** 2 * (h - t))


def half_ball(inner: float) -> tuple[Surface, float]:
    """Half a spherical shell of outer radius 0.3, and its volume."""
    return bowl(inner, 0.3), 2 / 3 * math.pi * (0.3**3 - inner**3)


def test_a_concave_object_has_its_convex_hull_and_the_moments_of_what_it_fills():
    """The object is a dumb-bell of two overlapping balls; its convex hull is a capsule."""

    def sphere(x):
        centre = torch.tensor([x, 0.0, 0.0])
        return ellipsoid((0.1,) * 3, 2000).moved((x, 0.0, 0.0)), lambda p: (p - centre).norm(dim=1) < 0.0999

    shape = rigid_shapes(scene(union(sphere(-0.09), sphere(0.09))))[0]
    assert not shape.convex and shape.ball is None
    to_axis = (shape.hull - torch.tensor([0.09, 0.0, 0.0]) * shape.hull[:, :1].sign()).norm(dim=1)
    torch.testing.assert_close(to_axis, torch.full((len(shape.hull),), 0.1), rtol=0, atol=0.005)
    torch.testing.assert_close(shape.com, torch.zeros(3), rtol=0, atol=0.002)
    lens = math.pi * (4 * 0.1 + 0.18) * (2 * 0.1 - 0.18) ** 2 / 12  # volume of the intersection of both balls
    assert shape.volume == pytest.approx(8 / 3 * math.pi * 1e-3 - lens, rel=0.03)


SHEETS = {"plate 1/20": plate(0.015), "plate 1/80": plate(0.00375), "pan 1/15": pan(0.02), "pan 1/30": pan(0.01),
          "bowl 1/12": half_ball(0.25), "bowl 1/30": half_ball(0.28)}  # fmt: skip


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.slow) if name in ("bowl 1/30", "pan 1/15") else name for name in SHEETS
])  # fmt: skip
def test_thin_walls_keep_their_volume(name):
    """Walls of 1/12 to 1/80 of the size; the mass is right to 10 %."""
    surface, true = SHEETS[name]
    shape = rigid_shapes(scene(surface))[0]
    assert shape.volume == pytest.approx(true, rel=0.1)
    assert shape.convex == name.startswith("plate")


def test_a_flat_box_is_convex():
    """The height of 12.8 voxels is not a whole number; this must not make it seem hollow."""
    (shape,) = rigid_shapes(scene(box((0.3, 0.2, 0.08), 0.011)))
    assert shape.convex and shape.volume == pytest.approx(0.0048, rel=0.02)


CARD = box((0.09, 0.06, 0.002), 0.003)


def test_a_card_that_is_as_thin_as_a_voxel_has_its_volume():
    """The card is 45 times as wide as thick; its voxels hold 2/3 of its volume. Half a spacing is missing at edges."""
    shape = rigid_shapes(scene(CARD))[0]
    sides = CARD.points.amax(0) - CARD.points.amin(0)
    assert shape.convex and shape.volume == pytest.approx(float(sides.prod()), rel=0.03)


@pytest.mark.parametrize("name", ["angle", "bent"])
def test_thin_plates_with_another_outline_or_bent_are_not_convex(name):
    """An L of three quarters of the card, and a card with its ends 6 mm above its middle."""
    x = CARD.points
    if name == "angle":
        plate = CARD.kept((x[:, 0] < 0) | (x[:, 1] < 0))
    else:
        plate = Surface(x + torch.tensor([0.0, 0.0, 3.0]) * x[:, :1].square(), CARD.normals)
    assert not rigid_shapes(scene(plate))[0].convex
