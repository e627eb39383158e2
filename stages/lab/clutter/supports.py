"""Furniture and rooms of clutter scenes: boxes with painted faces that are not objects."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.scene.gaussians import Gaussians, concatenate
from stages.lab.assets import background_paint as paint
from stages.lab.assets.shapes import box, noise, to_gaussians
from stages.lab.clutter.drapes import Drape
from stages.lab.clutter.props import random_colour, random_paint

Rng = np.random.Generator
SPACING, COARSE = 0.008, 0.035  # of Gaussians on faces near the objects, and on the room [camera distance]
MAT_SHARE = 0.5  # of scenes with mats
PATTERNS = (paint.oak, paint.marble, paint.gingham, paint.flagstones, paint.worn_paint, paint.slate, paint.azulejo,
            paint.felt, paint.wooden_floor, paint.dark_floor, paint.bricks, paint.garden)  # fmt: skip


@dataclass(frozen=True)
class StaticBox:
    """A box that stands still, its sides parallel to the axes."""

    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    spacing: float = SPACING


@dataclass(frozen=True)
class Furniture:
    """The blocks of a scene, where things are dropped, and from where the cameras may look."""

    blocks: list[StaticBox]
    areas: list[tuple[float, float, float, float, float]]  # x0 x1 y0 y1 z of each surface that things stand on
    open_sides: tuple[float, float]  # range of azimuths without walls [rad]
    drapes: tuple[Drape, ...] = ()  # on the first area

    def rise(self, low: tuple[float, float], high: tuple[float, float]) -> float:
        """The highest that a drape is in a rectangle of the first area."""
        x, y = (torch.linspace(a, b, 9) for a, b in zip(low, high, strict=True))
        return max((float(d.height(torch.cartesian_prod(x, y)).max()) for d in self.drapes), default=0.0)


def random_furniture(rng: Rng) -> Furniture:
    """A table or a stretch of floor, its top at z = 0; in some scenes with walls, a partition or a shelf."""
    on_floor = rng.uniform() < 0.2
    a, b = (2.5, 2.5) if on_floor else (rng.uniform(0.45, 1.2), rng.uniform(0.35, 0.8))
    blocks, used = [], (min(a, rng.uniform(0.4, 0.75)), min(b, rng.uniform(0.3, 0.6)))
    if on_floor:
        blocks.append(StaticBox((0, 0, -0.05), (a, b, 0.05), 1.6 * SPACING))
    else:
        thick, height = rng.uniform(0.015, 0.05), rng.uniform(0.4, 0.8)
        blocks.append(StaticBox((0, 0, -thick), (a, b, thick)))
        leg = (0.03, 0.03, height / 2 - thick)
        blocks += [StaticBox((sx * 0.9 * a, sy * 0.85 * b, -thick - height / 2), leg, COARSE)
                   for sx in (-1, 1) for sy in (-1, 1)]  # fmt: skip
        blocks.append(StaticBox((0, 0, -height - 0.05), (4, 4, 0.05), COARSE))
    areas = [(-used[0], used[0], -used[1], used[1], 0.0)]
    sides, back = (0.0, 2 * math.pi), used[1] + rng.uniform(0.06, 0.2) if on_floor else b
    low = 0.0 if on_floor else -0.6
    if rng.uniform() < 0.35:  # a wall behind, in half of the scenes one at the side too
        gap = rng.uniform(0.0, 0.06)
        blocks.append(StaticBox((0, back + gap + 0.03, low + 1.0), (3.5, 0.03, 1.2), COARSE / 1.5))
        sides = (1.1 * math.pi, 1.9 * math.pi)
        if rng.uniform() < 0.4:
            blocks.append(StaticBox((a + gap + 0.03, 0, low + 1.0), (0.03, 3.5, 1.2), COARSE / 1.5))
            sides = (1.1 * math.pi, 1.45 * math.pi)
    if rng.uniform() < 0.2:  # a partition on the table
        blocks.append(
            StaticBox((0, back - 0.02, 0.2), (min(a, 1.2), rng.uniform(0.01, 0.02), rng.uniform(0.12, 0.25)), SPACING)
        )
        sides = (1.1 * math.pi, 1.9 * math.pi) if sides[0] == 0 else sides
    elif rng.uniform() < 0.25:  # a shelf
        wide, deep, high = rng.uniform(0.25, 0.6), rng.uniform(0.08, 0.14), rng.uniform(0.15, 0.4)
        wide, y = min(wide, a - 0.05), back - deep - 0.01
        blocks += [StaticBox((0, y, high), (wide, deep, 0.01)),
                   *(StaticBox((s * wide, y, high / 2), (0.01, deep, high / 2)) for s in (-1, 1))]  # fmt: skip
        areas.append((-wide + 0.05, wide - 0.05, y - deep + 0.04, y + deep - 0.04, high + 0.01))
        sides = (1.1 * math.pi, 1.9 * math.pi) if sides[0] == 0 else sides
    for _ in range(rng.integers(1, 5) if rng.uniform() < MAT_SHARE else 0):
        blocks.append(_mat(used, rng))
    return Furniture(blocks, areas, sides)


def _mat(used: tuple[float, float], rng: Rng) -> StaticBox:
    """A mat, cloth or sheet of paper that lies on the surface: too thin to be an object."""
    half = (rng.uniform(0.06, 0.4), rng.uniform(0.06, 0.3), math.exp(rng.uniform(math.log(0.0005), math.log(0.003))))
    x, y = rng.uniform(-used[0], used[0]), rng.uniform(-used[1], used[1])
    half = (min(half[0], abs(used[0] - abs(x)) + 0.05), min(half[1], abs(used[1] - abs(y)) + 0.05), half[2])
    return StaticBox((x, y, half[2]), half, SPACING)


def painted(furniture: Furniture, rng: Rng) -> Gaussians:
    """The Gaussians of all faces, object_id 0."""
    parts = []
    for block in furniture.blocks:
        surface = box(tuple(2 * h for h in block.half), block.spacing)
        keep = (surface.points.abs() + torch.tensor(block.centre).abs()).amax(1) < 6
        surface = surface.kept(keep)
        rgb = random_face(rng)(surface.points) * _daylight(surface.normals)[:, None]
        parts.append(to_gaussians(surface.moved(block.centre), rgb, 0, width=0.7, widest=3 * block.spacing))
    for drape in furniture.drapes:
        surface = drape.surface(SPACING)
        rgb = (random_face if rng.uniform() < 0.5 else random_paint)(rng)(surface.points)
        rgb = rgb * _daylight(surface.normals)[:, None]
        parts.append(to_gaussians(surface, rgb, 0, width=0.7, widest=3 * SPACING))
    return concatenate(parts)


def random_face(rng: Rng) -> Callable[[Tensor], Tensor]:
    """A colour of points on a box: a pattern of one of the tables of the data set, noise of two colours, or plain."""
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
    """Plane coordinates of points on the faces of a box."""
    return torch.stack([p[:, 0] + 0.7 * p[:, 2], p[:, 1] + 0.7 * p[:, 2]], 1)


def _daylight(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    return 0.78 + 0.18 * normals[:, 2] + 0.06 * normals[:, 0]
