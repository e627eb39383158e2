"""Furniture and rooms of clutter scenes, made of painted boxes: tables, seats, floors, walls, shelves, mats."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.scene.gaussians import Gaussians, concatenate
from stages.lab.assets import background_paint as paint
from stages.lab.assets.shapes import Surface, box, noise, to_gaussians
from stages.lab.clutter.drapes import Drape
from stages.lab.clutter.props import random_colour, random_paint

Rng = np.random.Generator
# spacing of Gaussians on faces near the objects, and on the room [camera distances]
SPACING, COARSE = 0.008, 0.035
MAT_SHARE = 0.5  # fraction of scenes with mats
SEAT_SHARE = 0.25  # fraction of scenes on a chair, bench or sofa
NEARBY_SHARE = 0.4  # fraction of scenes with other furniture in the background
FRONT = 1.1 * math.pi, 1.9 * math.pi  # camera azimuths from which the front is visible [rad]
PATTERNS = (paint.oak, paint.marble, paint.gingham, paint.flagstones, paint.worn_paint, paint.slate, paint.azulejo,
            paint.felt, paint.wooden_floor, paint.dark_floor, paint.bricks, paint.garden)  # fmt: skip


@dataclass(frozen=True)
class StaticBox:
    """A static box."""

    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    spacing: float = SPACING  # spacing of the Gaussians on its faces
    yaw: float = 0.0  # rotation about z [rad], applied after `tilt`
    tilt: float = 0.0  # rotation about x [rad]
    paint: int | None = None  # boxes with the same number have the same paint; None: a paint of its own

    def rotation(self) -> Float[Tensor, "3 3"]:
        """Rotation from box to scene coordinates."""
        (a, b), (c, s) = ((math.cos(x), math.sin(x)) for x in (self.yaw, self.tilt))
        return torch.tensor([[a, -b, 0], [b, a, 0], [0, 0, 1]]) @ torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]])

    def quaternion(self) -> tuple[float, float, float, float]:
        """The same rotation as a quaternion w x y z."""
        (a, b), (c, s) = ((math.cos(x / 2), math.sin(x / 2)) for x in (self.yaw, self.tilt))
        return a * c, a * s, b * s, b * c


@dataclass(frozen=True)
class Furniture:
    """The static boxes of a scene, the areas where objects are dropped, and the possible camera directions."""

    blocks: list[StaticBox]
    areas: list[tuple[float, float, float, float, float]]  # x0 x1 y0 y1 z of each surface for objects
    open_sides: tuple[float, float]  # range of camera azimuths without walls [rad]
    drapes: tuple[Drape, ...] = ()  # cloths on the first area
    back: float = 1.0  # y coordinate from which there is space behind the furniture

    def rise(self, low: tuple[float, float], high: tuple[float, float]) -> float:
        """Maximum height of the drapes within a rectangle of the first area."""
        x, y = (torch.linspace(a, b, 9) for a, b in zip(low, high, strict=True))
        return max((float(d.height(torch.cartesian_prod(x, y)).max()) for d in self.drapes), default=0.0)


def random_furniture(rng: Rng) -> Furniture:
    """A table, seat or piece of floor with its top at z = 0; in some scenes with walls, a partition or a shelf."""
    made = _seat(rng) if rng.uniform() < SEAT_SHARE else _table(rng)
    if rng.uniform() < NEARBY_SHARE:
        made = replace(made, blocks=made.blocks + _nearby(made.back, rng), open_sides=_narrowed(made.open_sides))
    x, y = made.areas[0][1], made.areas[0][3]
    mats = [_mat((x, y), rng) for _ in range(rng.integers(1, 5) if rng.uniform() < MAT_SHARE else 0)]
    return replace(made, blocks=made.blocks + mats)


def _narrowed(sides: tuple[float, float]) -> tuple[float, float]:
    """The azimuths restricted to the front, if the scene was open on all sides."""
    return FRONT if sides[0] == 0 else sides


def _table(rng: Rng) -> Furniture:
    on_floor = rng.uniform() < 0.2
    a, b = (2.5, 2.5) if on_floor else (rng.uniform(0.45, 1.2), rng.uniform(0.35, 0.8))
    blocks, used = [], (min(a, rng.uniform(0.4, 0.75)), min(b, rng.uniform(0.3, 0.6)))
    if on_floor:
        blocks.append(StaticBox((0, 0, -0.05), (a, b, 0.05), 1.6 * SPACING))
    else:
        thick, height = rng.uniform(0.015, 0.05), rng.uniform(0.4, 0.8)
        blocks += [
            StaticBox((0, 0, -thick), (a, b, thick)),
            *_legs(0.9 * a, 0.85 * b, 2 * thick, height),
            _floor(height),
        ]
    areas = [(-used[0], used[0], -used[1], used[1], 0.0)]
    sides, back = (0.0, 2 * math.pi), used[1] + rng.uniform(0.06, 0.2) if on_floor else b
    low = 0.0 if on_floor else -0.6
    if rng.uniform() < 0.35:  # a wall behind, and in 40 % of these scenes another one at the side
        gap = rng.uniform(0.0, 0.06)
        blocks.append(StaticBox((0, back + gap + 0.03, low + 1.0), (3.5, 0.03, 1.2), COARSE / 1.5))
        sides = FRONT
        if rng.uniform() < 0.4:
            blocks.append(StaticBox((a + gap + 0.03, 0, low + 1.0), (0.03, 3.5, 1.2), COARSE / 1.5))
            sides = (1.1 * math.pi, 1.45 * math.pi)
    if rng.uniform() < 0.2:  # a partition on the table
        blocks.append(
            StaticBox((0, back - 0.02, 0.2), (min(a, 1.2), rng.uniform(0.01, 0.02), rng.uniform(0.12, 0.25)), SPACING)
        )
        sides = _narrowed(sides)
    elif rng.uniform() < 0.25:  # a shelf
        wide, deep, high = rng.uniform(0.25, 0.6), rng.uniform(0.08, 0.14), rng.uniform(0.15, 0.4)
        wide, y = min(wide, a - 0.05), back - deep - 0.01
        blocks += [StaticBox((0, y, high), (wide, deep, 0.01)),
                   *(StaticBox((s * wide, y, high / 2), (0.01, deep, high / 2)) for s in (-1, 1))]  # fmt: skip
        areas.append((-wide + 0.05, wide - 0.05, y - deep + 0.04, y + deep - 0.04, high + 0.01))
        sides = _narrowed(sides)
    return Furniture(blocks, areas, sides, back=back)


def _seat(rng: Rng) -> Furniture:
    """A chair, bench or sofa, whose back may be curved, tilted or slatted, in some scenes with armrests."""
    a, b = math.exp(rng.uniform(math.log(0.22), math.log(0.8))), rng.uniform(0.2, 0.4)
    thick, height = rng.uniform(0.01, 0.08), rng.uniform(0.3, 0.6)
    alike = 0 if rng.uniform() < 0.7 else None
    blocks = [StaticBox((0, 0, -thick), (a, b, thick), paint=0), _floor(height)]
    if rng.uniform() < 0.5:
        blocks += _legs(0.9 * a, 0.85 * b, 2 * thick, height)
    else:  # a solid base down to the floor
        half = (height - 2 * thick) / 2
        blocks.append(StaticBox((0, 0, half - height), (0.95 * a, 0.95 * b, half), 2 * SPACING, paint=alike))
    if rng.uniform() < 0.85:
        blocks += _back(a, b, alike, rng)
    if rng.uniform() < 0.4:
        wide, high = rng.uniform(0.015, 0.08), rng.uniform(0.06, 0.12)
        blocks += [StaticBox((s * (a + wide), 0, high - thick), (wide, b, high + thick), paint=alike) for s in (-1, 1)]
    return Furniture(blocks, [(-0.9 * a, 0.9 * a, -0.85 * b, 0.75 * b, 0.0)], FRONT, back=b + 0.3)


def _back(a: float, b: float, paint: int | None, rng: Rng) -> list[StaticBox]:
    """The back of a seat with half sides a and b: strips along an arc, tilted backwards."""
    strips = int(rng.integers(5, 12)) if rng.uniform() < 0.6 else 1
    # the depth of the arc is at most a quarter of b
    bend = min(rng.uniform(0.1, 0.7), 2 * math.atan(0.25 * b / a)) if strips > 1 else 0.0
    rise, deep, tilt = rng.uniform(0.12, 0.35), rng.uniform(0.008, 0.06), rng.uniform(0, 0.35)
    gap = rng.uniform(0, 0.12) if rng.uniform() < 0.3 else -0.02  # between back and seat
    if slats := strips > 1 and rng.uniform() < 0.3:
        bend *= 0.5
    radius = a / math.sin(bend) if bend else 0.0
    wide = a if strips == 1 else (0.55 if slats else 1.04) * max(a, radius * bend) / strips
    out = []
    for k in range(strips):
        angle = bend * (2 * (k + 0.5) / strips - 1) if strips > 1 else 0.0
        x, y = radius * math.sin(angle), b + deep - radius * (1 - math.cos(angle))
        up = math.sin(tilt) * rise  # distance of the centre behind the lower edge
        centre = (x - up * math.sin(-angle), y + up * math.cos(angle), gap + math.cos(tilt) * rise)
        out.append(StaticBox(centre, (wide, deep, rise), yaw=angle, tilt=-tilt, paint=paint))
    return out


def _legs(x: float, y: float, top: float, height: float) -> list[StaticBox]:
    """Four legs from `top` below z = 0 to the floor at -height."""
    half = (0.03, 0.03, (height - top) / 2)
    return [StaticBox((sx * x, sy * y, half[2] - height), half, COARSE) for sx in (-1, 1) for sy in (-1, 1)]


def _floor(height: float) -> StaticBox:
    return StaticBox((0, 0, -height - 0.05), (4, 4, 0.05), COARSE)


def _nearby(back: float, rng: Rng) -> list[StaticBox]:
    """Cabinets, boards and boxes on the floor in the background."""
    out = []
    for _ in range(int(rng.integers(1, 4))):
        half = (rng.uniform(0.1, 0.5), rng.uniform(0.02, 0.3), rng.uniform(0.3, 0.7))
        reach = math.hypot(*half[:2])
        x, y = rng.uniform(-1.0, 1.0), back + reach + rng.uniform(0.02, 0.5)
        out.append(StaticBox((x, y, half[2] - 0.6), half, 1.6 * SPACING, yaw=rng.uniform(0, math.pi)))
    return out


def _mat(used: tuple[float, float], rng: Rng) -> StaticBox:
    """A mat, cloth or sheet of paper on the surface, too thin to be an object."""
    half = (rng.uniform(0.06, 0.4), rng.uniform(0.06, 0.3), math.exp(rng.uniform(math.log(0.0005), math.log(0.003))))
    x, y = rng.uniform(-used[0], used[0]), rng.uniform(-used[1], used[1])
    half = (min(half[0], abs(used[0] - abs(x)) + 0.05), min(half[1], abs(used[1] - abs(y)) + 0.05), half[2])
    return StaticBox((x, y, half[2]), half, SPACING)


def painted(furniture: Furniture, rng: Rng) -> Gaussians:
    """The Gaussians on all faces and drapes, with object_id 0."""
    parts = []
    faces: dict[int, Callable[[Tensor], Tensor]] = {}
    for block in furniture.blocks:
        surface = box(tuple(2 * h for h in block.half), block.spacing)
        keep = (surface.points.abs() + torch.tensor(block.centre).abs()).amax(1) < 6
        surface, R = surface.kept(keep), block.rotation()
        placed = Surface(surface.points @ R.T, surface.normals @ R.T).moved(block.centre)
        face = random_face(rng) if block.paint is None else faces.setdefault(block.paint, random_face(rng))
        rgb = face(surface.points if block.paint is None else placed.points) * _daylight(placed.normals)[:, None]
        parts.append(to_gaussians(placed, rgb, 0, width=0.7, widest=3 * block.spacing))
    for drape in furniture.drapes:
        surface = drape.surface(SPACING)
        rgb = (random_face if rng.uniform() < 0.5 else random_paint)(rng)(surface.points)
        rgb = rgb * _daylight(surface.normals)[:, None]
        parts.append(to_gaussians(surface, rgb, 0, width=0.7, widest=3 * SPACING))
    return concatenate(parts)


def random_face(rng: Rng) -> Callable[[Tensor], Tensor]:
    """A random colour function for points on a box: a pattern of a data set table, or noise between two colours."""
    kind, scale, seed = rng.uniform(), float(rng.uniform(1.0, 4.0)), int(rng.integers(1 << 30))
    one, two = random_colour(rng), random_colour(rng)
    if kind < 0.45:
        pattern = PATTERNS[rng.integers(len(PATTERNS))]
        tint = 1 + 0.15 * torch.from_numpy(rng.normal(size=3)).float()
        return lambda p: pattern(scale * _unrolled(p)) * tint
    size, contrast = float(rng.uniform(0.01, 0.3)), float(rng.uniform(0.02, 0.5))

    def noisy(p: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        t = 0.6 * noise(p + 9, size, seed) + 0.4 * noise(p + 9, 0.31 * size, seed + 1)
        return one + contrast * (two - one) * t[:, None] + 0.02 * (noise(p + 9, 0.012, seed + 2) - 0.5)[:, None]

    return noisy


def _unrolled(p: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
    """Planar texture coordinates of points on the faces of a box."""
    return torch.stack([p[:, 0] + 0.7 * p[:, 2], p[:, 1] + 0.7 * p[:, 2]], 1)


def _daylight(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    return 0.78 + 0.18 * normals[:, 2] + 0.06 * normals[:, 0]
