"""Shapes and materials at random, to learn from: ten objects alone teach no more than how those ten behave.

Families take turns; sizes, densities and stiffness are drawn evenly on a logarithmic scale, over what the objects of
GSCollision span.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from stages.core.geometry.rotations import matrix
from stages.lab.assets.heldout_shapes import ShapeKind
from stages.lab.assets.signed_distance import (
    Field,
    capsule,
    curve_through,
    ellipsoid,
    posed,
    revolved,
    revolved_wall,
    slab,
    torus,
    tube,
    union,
)

FIRST_ID = 1000  # id of the first
SIZE_RANGE = (0.3, 1.0)  # longest side [m]
DENSITY_RANGE = (100.0, 2700.0)  # [kg/m^3]
SPECIFIC_STIFFNESS_RANGE = (
    10.0,
    7400.0,
)  # Young's modulus over density [m^2/s^2]: from the rope to the phone, which the substep bears
MAX_RADIUS = 0.55  # from the middle to the farthest point of a shape

Draw = np.random.Generator


def random_shapes(count: int, seed: int = 0) -> dict[str, ShapeKind]:
    """So many objects; the first ones are the same however many there are."""
    made = {}
    for i in range(count):
        draw = np.random.default_rng([seed, i])
        name, family = list(FAMILIES.items())[i % len(FAMILIES)]
        density = _log(draw, *DENSITY_RANGE)
        field = family(draw)
        turn = matrix(torch.from_numpy(draw.normal(size=4)).float())
        made[f"{name}{i}"] = ShapeKind(
            FIRST_ID + i, _log(draw, *SIZE_RANGE), density * _log(draw, *SPECIFIC_STIFFNESS_RANGE), density,
            lambda field=field, turn=turn: posed(field, turn),
        )  # fmt: skip
    return made


def _log(draw: Draw, low: float, high: float) -> float:
    return float(math.exp(draw.uniform(math.log(low), math.log(high))))


def _sides(draw: Draw, thinnest: float = 0.12) -> list[float]:
    """Half sides of a box, no corner of which is farther than REACH."""
    half = np.exp(draw.uniform(math.log(thinnest), 0, 3))
    return (MAX_RADIUS * half / np.linalg.norm(half)).tolist()


def _box(draw: Draw) -> Field:
    half = _sides(draw)
    least = min(half)
    return slab((0, 0, 0), half, draw.uniform(0.1, 0.9) * least, draw.uniform(0.05, 0.5) * least)


def _sheet(draw: Draw) -> Field:
    """A cloth, or a board."""
    x, z = draw.uniform(0.25, 0.38, 2)
    thick = draw.uniform(0.012, 0.04)
    return slab((0, 0, 0), (x, thick, z), draw.uniform(0.02, 0.1), 0.8 * thick)


def _egg(draw: Draw) -> Field:
    return ellipsoid((0, 0, 0), np.exp(draw.uniform(math.log(0.15), math.log(MAX_RADIUS), 3)).tolist())


def _stick(draw: Draw) -> Field:
    thick, end = draw.uniform(0.04, 0.16, 2)
    far = MAX_RADIUS - max(thick, end)
    return capsule((-far, 0, 0), (far, 0, 0), thick, end)


def _vessel(draw: Draw) -> Field:
    """A cup, a bowl or a vase: a wall, and a bottom."""
    height, (low, middle, high) = draw.uniform(0.12, 0.38), draw.uniform(0.15, 0.38, 3)
    return revolved_wall([(0, -height), (low, -height), (middle, 0), (high, height)], draw.uniform(0.03, 0.06))


def _lump(draw: Draw) -> Field:
    """What has turned on a lathe: a can, a cone, a pawn."""
    height, (low, middle, high) = draw.uniform(0.15, 0.4), draw.uniform(0.06, 0.36, 3)
    return revolved([(0, -height), (low, -height), (middle, 0), (high, height), (0, height)], 0.02)


def _ring(draw: Draw) -> Field:
    thick = draw.uniform(0.05, 0.15)
    return torus((0, 0, 0), MAX_RADIUS - thick, thick)


def _doll(draw: Draw) -> Field:
    """A body with limbs."""
    body = ellipsoid((0, 0, 0), draw.uniform(0.15, 0.28, 3).tolist())
    ends = draw.normal(size=(int(draw.integers(2, 6)), 3))
    ends *= draw.uniform(0.3, 0.45, (len(ends), 1)) / np.linalg.norm(ends, axis=1, keepdims=True)
    return union(body, *(capsule((0, 0, 0), e.tolist(), *draw.uniform(0.05, 0.1, 2)) for e in ends), smooth=0.04)


def _rope(draw: Draw) -> Field:
    knots = np.cumsum(draw.normal(size=(6, 3)) * [1, 1, 0.4], 0)
    knots = (knots - knots.mean(0)) / np.abs(knots - knots.mean(0)).max()
    return tube(curve_through((0.33 * knots).tolist(), 400), draw.uniform(0.04, 0.07))


FAMILIES: dict[str, Callable[[Draw], Field]] = {
    "box": _box, "sheet": _sheet, "egg": _egg, "stick": _stick, "vessel": _vessel, "lump": _lump, "ring": _ring,
    "doll": _doll, "rope": _rope,
}  # fmt: skip
