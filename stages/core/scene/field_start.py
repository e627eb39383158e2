"""Group `field` of a trajectory file: initial conditions of the learned engine, from which a page can simulate."""

from __future__ import annotations

from dataclasses import dataclass, fields

import h5py
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.scene.h5_schema import Dataset, attribute
from stages.core.scene.h5_text import check_attributes
from stages.core.scene.schema import number, numbers, quote, whole

GROUP = "field"
LARGE = 1e30  # upper bound of masses, volumes, moduli and solidity
DATASETS = {  # p keypoints, o objects
    "points": Dataset("p 3"),
    "mass_fraction": Dataset("p", low=0, high=1.001),
    "mass": Dataset("o", low=0, high=LARGE),
    "volume": Dataset("o", low=0, high=LARGE),
    "E": Dataset("o", low=0, high=LARGE),
    "solidity": Dataset("o", low=1, high=LARGE),
    "nu": Dataset("o", low=-1, high=0.5),
    "friction": Dataset("o", low=0),
    "velocity": Dataset("o 3"),
    "inertia": Dataset("o 3 3"),
    "box": Dataset("o 2 3"),
    "awake": Dataset("o", "int", 0, 1),
    "standing": Dataset("o", "int", 0, 1),
    "material": Dataset("o", "text"),
}


@dataclass(frozen=True)
class UnitFactors:
    """Factors from scene units (lengths) and SI units (other quantities) to the units of the learned model."""

    length: float  # model metres per scene unit
    scale: float  # model metres per metre
    time: float  # model seconds per second
    mass: float  # model kilograms per kilogram


@dataclass(frozen=True)
class FieldUnits(UnitFactors):
    """Unit conversion and time stepping of the learned model."""

    origin: tuple[float, float, float]  # scene point that becomes (0, 0, FLOOR) [scene units]
    gravity: float  # downward acceleration in model units [m/s^2]
    steps: int  # time steps of the model per frame
    weights: str  # sha256 of the model's weights
    friction: float | None = None  # of all objects; overrides that of their materials


@dataclass(frozen=True)
class FieldStart:
    """Initial keypoints, rigid-body states and materials in model units; keypoints and objects in the file's order."""

    points: Float[Tensor, "p 3"]  # [m]
    mass_fraction: Float[Tensor, "p"]  # fraction of the object's mass at each keypoint
    mass: Float[Tensor, "o"]  # [kg]
    volume: Float[Tensor, "o"]  # in SI units, not model units [m^3]
    E: Float[Tensor, "o"]  # Young's modulus [Pa]
    solidity: Float[Tensor, "o"]  # stiffness relative to a hollow body
    nu: Float[Tensor, "o"]  # Poisson's ratio
    friction: Float[Tensor, "o"]
    velocity: Float[Tensor, "o 3"]  # of the centre of mass [m/s]
    inertia: Float[Tensor, "o 3 3"]  # about the centre of mass, per unit of mass [m^2]
    box: Float[Tensor, "o 2 3"]  # lower and upper corner of each object's domain [m]
    awake: Int[Tensor, "o"]  # 0: asleep until a contact wakes it
    standing: Int[Tensor, "o"]  # 1: stands on the floor
    material: tuple[str, ...]  # names
    units: FieldUnits


def write_field_start(file: h5py.File, start: FieldStart) -> None:
    """Write the group, replacing an existing one."""
    if GROUP in file:
        del file[GROUP]
    group = file.create_group(GROUP)
    for name, dataset in DATASETS.items():
        values = getattr(start, name)
        text = dataset.kind == "text"
        group.create_dataset(name, data=list(values) if text else values.cpu().numpy(),
                             dtype=h5py.string_dtype() if text else None)  # fmt: skip
    units = {f.name: getattr(start.units, f.name) for f in fields(FieldUnits)}
    group.attrs.update({name: value for name, value in units.items() if value is not None})


def read_field_start(file: h5py.File, lengths: dict[str, int]) -> FieldStart | None:
    """Read the group; None if the file has none. Raises KeyError and ValueError for a damaged one."""
    if GROUP not in file:
        return None
    read = {name: dataset.read(file, f"{GROUP}/{name}", lengths) for name, dataset in DATASETS.items()}
    values = {k: torch.from_numpy(v) if isinstance(v, np.ndarray) else tuple(quote(s, 40) for s in v)
              for k, v in read.items()}  # fmt: skip
    check_attributes(file[GROUP])
    group = file[GROUP]
    factors = {name: number(attribute(group, name), name, 1e-12, 1e12) for name in ("length", "scale", "time", "mass")}
    friction = number(attribute(group, "friction"), "friction", 0, 100) if "friction" in group.attrs else None
    units = FieldUnits(
        **factors, origin=numbers(attribute(group, "origin"), 3, "origin"),
        gravity=number(attribute(group, "gravity"), "gravity"),
        steps=whole(attribute(group, "steps"), "steps", 1, 10_000), weights=quote(attribute(group, "weights"), 64),
        friction=friction,
    )  # fmt: skip
    return FieldStart(**values, units=units)
