"""Operations on grid cells, given as rows of integers."""

from math import prod

import torch
from jaxtyping import Int
from torch import Tensor


def distinct_cells(cells: Int[Tensor, "n d"]) -> tuple[Int[Tensor, "n"], Int[Tensor, "u"]]:
    """Index of each row among the distinct rows, in lexicographic order, and the count of each distinct row.

    As `unique(dim=0)`, but many times faster: rows are encoded as single numbers if these fit in 62 bits.
    """
    if not len(cells):
        return cells.new_zeros(0), cells.new_zeros(0)
    low = cells.amin(0)
    sides = (cells.amax(0).double() - low.double() + 1).tolist()
    if prod(sides) >= 2**62:
        return cells.unique(dim=0, return_inverse=True, return_counts=True)[1:]
    key = torch.zeros_like(cells[:, 0])
    for column, side in zip((cells - low).unbind(1), sides, strict=True):
        key = key * int(side) + column
    return key.unique(return_inverse=True, return_counts=True)[1:]
