"""Random shapes and materials for training, to make models generalise beyond the ten objects.

Shape families are used in turn; sizes, densities and stiffness are sampled log-uniformly over the range of the objects
of GSCollision.
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

FIRST_ID = 1000  # first object id
SIZE_RANGE = (0.3, 1.0)  # longest side [m]
DENSITY_RANGE = (100.0, 2700.0)  # range of densities [kg/m^3]
# E / density [m^2/s^2], from the rope to the phone; stable at the published substep
SPECIFIC_STIFFNESS_RANGE = (10.0, 7400.0)
MAX_RADIUS = 0.55  # largest distance of a point of a shape from its centre

Generator = np.random.Generator


def random_shapes(count: int, seed: int = 0) -> dict[str, ShapeKind]:
    """`count` random objects by name; the first ones do not depend on `count`."""
    made = {}
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        name, family = list(FAMILIES.items())[i % len(FAMILIES)]
        density = _log(rng, *DENSITY_RANGE)
        field = family(rng)
        turn = matrix(torch.from_numpy(rng.normal(size=4)).float())
        made[f"{name}{i}"] = ShapeKind(
            FIRST_ID + i, _log(rng, *SIZE_RANGE), density * _log(rng, *SPECIFIC_STIFFNESS_RANGE), density,
            lambda field=field, turn=turn: posed(field, turn),
        )  # fmt: skip
    return made


def _log(rng: Generator, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def _sides(rng: Generator, thinnest: float = 0.12) -> list[float]:
    """Half sides of a random box with its corners at distance MAX_RADIUS from the centre."""
    half = np.exp(rng.uniform(math.log(thinnest), 0, 3))
    return (MAX_RADIUS * half / np.linalg.norm(half)).tolist()


def _box(rng: Generator) -> Field:
    half = _sides(rng)
    shortest = min(half)
    return slab((0, 0, 0), half, rng.uniform(0.1, 0.9) * shortest, rng.uniform(0.05, 0.5) * shortest)


def _sheet(rng: Generator) -> Field:
    """A cloth or board."""
    x, z = rng.uniform(0.25, 0.38, 2)
    thick = rng.uniform(0.012, 0.04)
    return slab((0, 0, 0), (x, thick, z), rng.uniform(0.02, 0.1), 0.8 * thick)


def _egg(rng: Generator) -> Field:
    return ellipsoid((0, 0, 0), np.exp(rng.uniform(math.log(0.15), math.log(MAX_RADIUS), 3)).tolist())


def _stick(rng: Generator) -> Field:
    thick, end = rng.uniform(0.04, 0.16, 2)
    far = MAX_RADIUS - max(thick, end)
    return capsule((-far, 0, 0), (far, 0, 0), thick, end)


def _vessel(rng: Generator) -> Field:
    """A cup, bowl or vase with a wall and a bottom."""
    height, (low, middle, high) = rng.uniform(0.12, 0.38), rng.uniform(0.15, 0.38, 3)
    return revolved_wall([(0, -height), (low, -height), (middle, 0), (high, height)], rng.uniform(0.03, 0.06))


def _lump(rng: Generator) -> Field:
    """A solid of revolution, such as a can, a cone or a pawn."""
    height, (low, middle, high) = rng.uniform(0.15, 0.4), rng.uniform(0.06, 0.36, 3)
    return revolved([(0, -height), (low, -height), (middle, 0), (high, height), (0, height)], 0.02)


def _ring(rng: Generator) -> Field:
    thick = rng.uniform(0.05, 0.15)
    return torus((0, 0, 0), MAX_RADIUS - thick, thick)


def _doll(rng: Generator) -> Field:
    """A body with limbs."""
    body = ellipsoid((0, 0, 0), rng.uniform(0.15, 0.28, 3).tolist())
    ends = rng.normal(size=(int(rng.integers(2, 6)), 3))
    ends *= rng.uniform(0.3, 0.45, (len(ends), 1)) / np.linalg.norm(ends, axis=1, keepdims=True)
    return union(body, *(capsule((0, 0, 0), e.tolist(), *rng.uniform(0.05, 0.1, 2)) for e in ends), smooth=0.04)


def _rope(rng: Generator) -> Field:
    knots = np.cumsum(rng.normal(size=(6, 3)) * [1, 1, 0.4], 0)
    knots = (knots - knots.mean(0)) / np.abs(knots - knots.mean(0)).max()
    return tube(curve_through((0.33 * knots).tolist(), 400), rng.uniform(0.04, 0.07))


FAMILIES: dict[str, Callable[[Generator], Field]] = {
    "box": _box, "sheet": _sheet, "egg": _egg, "stick": _stick, "vessel": _vessel, "lump": _lump, "ring": _ring,
    "doll": _doll, "rope": _rope,
}  # fmt: skip
