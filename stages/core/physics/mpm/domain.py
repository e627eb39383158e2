"""Domain of an MPM simulation. Imports no kernels, so that other engines can use it."""

from __future__ import annotations

from dataclasses import dataclass

MAX_NODES = 60_000_000  # maximum number of grid nodes of a scene: about 1 GB of address space per copy of the grid


@dataclass(frozen=True)
class Box:
    """Axis-aligned floor, walls and ceiling [m]; friction is that of the body in contact."""

    low: tuple[float | int, float | int, float | int]  # z is the floor
    high: tuple[float | int, float | int, float | int]
    restitution: float = 0.0  # fraction of normal speed returned; 0: only the body's own elasticity
    tangential_retention: float = -1.0  # 0 to 1: fraction of tangential speed kept per substep, as in NGFF; -1: Coulomb
