"""How much stiffer a body is than a hollow or thin one of the same material."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

REFERENCE_THICKNESS = 0.015  # volume over surface of bodies in the published data, all of which are hollow or thin [m]


def solidity(points: Float[Tensor, "n 3"], volume: float) -> float:
    """How many times stiffer, from points on its surface [m] and its volume [m^3]; 1 for what is hollow or thin.

    Walls and boards resist bending by the cube of their thickness.
    """
    a, b, c = box_sides(points).tolist()
    return max(volume / (2 * (a * b + b * c + c * a)) / REFERENCE_THICKNESS, 1.0) ** 3


def box_sides(points: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """Of a block whose points spread as these do, the shortest first."""
    return (12 * torch.linalg.eigvalsh(points.T.cov(correction=0)).clamp_min(1e-12)).sqrt()
