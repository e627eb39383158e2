"""Rotary position embedding in two dimensions.

Source: Su et al. 2021, "RoFormer"; Heo et al. 2024, "Rotary Position Embedding for Vision Transformer", in the axial
form: half of the features are rotated according to the row, the other half according to the column.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

BASE = 100.0  # wavelengths range from 2 pi to nearly 2 pi BASE patches


class RotaryEmbedding(NamedTuple):
    """Cosines and sines of the rotation angles of each token's features, computed once for all blocks."""

    cos: Tensor  # (b, 1, t, d): the same for every head
    sin: Tensor

    def __getitem__(self, index) -> "RotaryEmbedding":
        """Select sequences of the batch."""
        return RotaryEmbedding(self.cos[index], self.sin[index])


def rotary_embedding(positions: Int[Tensor, "b t 2"], dim: int) -> RotaryEmbedding:
    """Rotary embedding for tokens at (row, column), with `dim` features per head, a multiple of 4."""
    half = dim // 2
    frequency = BASE ** (-torch.arange(0, half, 2, device=positions.device) / half)
    angle = positions[..., None] * frequency  # (b, t, 2, dim / 4)
    angle = torch.cat([angle, angle], -1).flatten(-2)[:, None]
    return RotaryEmbedding(angle.cos(), angle.sin())


def rotate(x: Float[Tensor, "b heads t d"], by: RotaryEmbedding) -> Float[Tensor, "b heads t d"]:
    """Rotate features; within each half, entry i is paired with entry i + d / 4."""
    a, b = x.unflatten(-1, (2, 2, -1)).unbind(-2)
    across = torch.stack([-b, a], -2).flatten(-3)
    return x * by.cos + across * by.sin


def patch_positions(views: int, rows: int, columns: int, registers: int, device=None) -> Int[Tensor, "v t 2"]:
    """(row, column) of each view's tokens: registers at (0, 0), then the patches in row order, from (1, 1)."""
    grid = torch.cartesian_prod(torch.arange(rows, device=device), torch.arange(columns, device=device)) + 1
    positions = torch.cat([grid.new_zeros(registers, 2), grid])
    return positions.expand(views, -1, -1)
