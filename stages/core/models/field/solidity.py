"""Solidity: bending stiffness of a compact body relative to a thin-walled body of the same material."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

MIN_STIFFNESS = 3e3  # Young's modulus of the softest bodies in training [Pa]; stiffer ones are extrapolated
REFERENCE_THICKNESS = 0.015  # measured volume / surface of the published objects, which are all hollow or thin [m]


def solidity(points: Float[Tensor, "n 3"], volume: float) -> float:
    """Stiffness ratio from points on the surface [m] and the volume [m^3]; 1 for hollow or thin bodies.

    It is (volume / surface / REFERENCE_THICKNESS)^3, since the bending stiffness of a plate grows with the cube of its
    thickness. The surface is that of the box of `box_sides`. A heuristic without a source.
    """
    a, b, c = box_sides(points).tolist()
    return max(volume / (2 * (a * b + b * c + c * a)) / REFERENCE_THICKNESS, 1.0) ** 3


def box_sides(points: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """Side lengths [m], ascending, of a solid box whose uniform density has the same covariance as the points."""
    return (12 * torch.linalg.eigvalsh(points.T.cov(correction=0)).clamp_min(1e-12)).sqrt()
