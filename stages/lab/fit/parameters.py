"""Parameters of a fit: material quantities and velocities with their ranges, and conversion from search coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from stages.core.physics.materials import Material


@dataclass(frozen=True)
class Quantity:
    """A material constant as a search parameter: its range, and the accuracy required to call it identifiable."""

    low: float
    high: float
    max_half_width: float  # largest half width of the 95 % interval of an identifiable value
    log: bool = False  # range and interval are in log10
    relative: bool = False  # the range is that of the ratio to the initial material
    what: str = ""


QUANTITIES: Mapping[str, Quantity] = {
    "friction": Quantity(0.0, 1.2, 0.15, what="Coulomb's coefficient"),
    "loss": Quantity(0.0, 1.0, 0.15, what="loss factor, which decides how objects rebound"),
    "density": Quantity(-1.0, 1.0, 0.15, log=True, relative=True, what="density over that of the first object"),
    "E": Quantity(3.0, 8.0, 0.5, log=True, what="Young's modulus [Pa]"),
}
RIGID = ("friction", "loss", "density")  # quantities that affect rigid motion; it does not identify any others
AXES = "xyz"
SPEED_RANGE = 1.0  # half width of the search range about the velocity guessed from the first frames [scene units/s]
STEP, SPEED_STEP = 0.25, 0.1  # initial standard deviations of the search for materials and velocities [ranges]


@dataclass(frozen=True)
class Parameter:
    """One coordinate of the search, scaled from 0 (`low`) to 1 (`high`)."""

    object_id: int
    name: str  # key of QUANTITIES, or one of AXES for a velocity
    low: float
    high: float
    start: float  # initial value of the search
    step: float = STEP

    def value(self, x: float) -> float:
        """The value at a coordinate; its log10 for quantities with a logarithmic range."""
        return self.low + x * (self.high - self.low)

    def coordinate(self, value: float) -> float:
        """The inverse of `value`, clamped to the range."""
        return min(1.0, max(0.0, (value - self.low) / (self.high - self.low)))


def material_parameters(object_id: int, material: Material, names: Sequence[str]) -> list[Parameter]:
    """Parameters for the named quantities of an object, with a material as initial values."""
    parameters = []
    for name in names:
        q, now = QUANTITIES[name], getattr(material, name)
        start = math.log10(now) if q.log else now
        offset = start if q.relative else 0.0
        parameters.append(Parameter(object_id, name, q.low + offset, q.high + offset, start))
    return parameters


def velocity_parameters(object_id: int, velocity: Mapping[str, float]) -> list[Parameter]:
    """Parameters for the initial velocity of an object along the given axes, centred on a guess."""
    return [Parameter(object_id, axis, v - SPEED_RANGE, v + SPEED_RANGE, v, SPEED_STEP) for axis, v in velocity.items()]


def fitted(
    parameters: Sequence[Parameter], x: Sequence[float], materials: Mapping[int, Material]
) -> tuple[dict[int, Material], dict[int, tuple[float, float, float]]]:
    """Materials and initial velocities at a point of the search."""
    found, velocity = dict(materials), {}
    for p, coordinate in zip(parameters, x, strict=True):
        value = p.value(float(coordinate))
        if p.name in AXES:
            v = list(velocity.get(p.object_id, (0.0, 0.0, 0.0)))
            v[AXES.index(p.name)] = value
            velocity[p.object_id] = tuple(v)
        else:
            value = 10**value if QUANTITIES[p.name].log else value
            found[p.object_id] = replace(found[p.object_id], **{p.name: value})
    return found, velocity


def as_json(material: Material) -> dict:
    """A material in the form that `ngff simulate --materials` reads."""
    row = {name: getattr(material, name) for name in ("E", "density", "nu", "friction", "loss")}
    if material.model != Material.model:
        row |= {"model": material.model, "plastic": list(material.plastic)}
    return row
