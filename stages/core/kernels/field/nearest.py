"""Nearest points between objects, by brute force within bounding boxes.

The kernel is written in Triton (see `compilers`), which is imported with this module.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from stages.core.kernels.operators import operator

BLOCK = tl.constexpr(16)  # query points per program
CHUNK = tl.constexpr(128)  # points of the other object per iteration


@triton.jit
def _nearest_kernel(points, low, high, distance, index, radius, o, n):
    blocks = tl.cdiv(n, BLOCK)
    pair, block = tl.program_id(0) // blocks, tl.program_id(0) % blocks
    i, j = pair // o, (pair // (o * o)) * o + pair % o  # rows of objects of the same scene
    r = block * BLOCK + tl.arange(0, BLOCK)
    p = points + 3 * i * n + r
    infinity = float("inf")
    x, y, z = (tl.load(p, mask=r < n, other=infinity), tl.load(p + n, mask=r < n, other=infinity),
               tl.load(p + 2 * n, mask=r < n, other=infinity))  # fmt: skip
    near = (i != j) & (x > tl.load(low + 3 * j) - radius) & (x < tl.load(high + 3 * j) + radius)
    near &= (y > tl.load(low + 3 * j + 1) - radius) & (y < tl.load(high + 3 * j + 1) + radius)
    near &= (z > tl.load(low + 3 * j + 2) - radius) & (z < tl.load(high + 3 * j + 2) + radius)
    column = tl.arange(0, CHUNK)
    smallest = tl.full([BLOCK, CHUNK], infinity, tl.float32)
    which = tl.zeros([BLOCK, CHUNK], tl.int32)
    if tl.sum(near.to(tl.int32)) > 0:
        for first in range(0, n, CHUNK):
            s = first + column
            q = points + 3 * j * n + s
            dx = x[:, None] - tl.load(q, mask=s < n, other=infinity)[None, :]
            dy = y[:, None] - tl.load(q + n, mask=s < n, other=infinity)[None, :]
            dz = z[:, None] - tl.load(q + 2 * n, mask=s < n, other=infinity)[None, :]
            squared = dx * dx + dy * dy + dz * dz
            nearer = squared < smallest
            smallest = tl.where(nearer, squared, smallest)
            which = tl.where(nearer, first, which)
    best = tl.min(smallest, 1)
    which = tl.min(tl.where(smallest == best[:, None], which + column[None, :], n), 1)
    best = tl.where(near & (best < radius * radius), tl.sqrt(best), infinity)
    tl.store(distance + pair * n + r, best, mask=r < n)
    tl.store(index + pair * n + r, tl.minimum(which, n - 1).to(tl.int64), mask=r < n)


def _nearest_shapes(points: Tensor, low: Tensor, high: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    b, o, _, n = points.shape
    return points.new_empty(b, o, o, n), torch.empty(b, o, o, n, dtype=torch.int64, device=points.device)


@operator("nearest", _nearest_shapes)
def _nearest(points: Tensor, low: Tensor, high: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    b, o, _, n = points.shape
    distance = points.new_empty(b, o, o, n)
    index = torch.empty(b, o, o, n, dtype=torch.int64, device=points.device)
    grid = (b * o * o * triton.cdiv(n, BLOCK.value),)
    _nearest_kernel[grid](points, low, high, distance, index, radius, o, n)
    return distance, index


def nearest_between_objects(points: Tensor, valid: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Return the distance [m] from each point of object i to the nearest point of object j, and that point's index.

    `points` (b o n 3) are in single precision [m]; `valid` (b o n) is false for padding. Both results are (b o o n).
    The distance is infinite, and the index undefined, where it is not below `radius` [m], for j = i, and to or from
    padding.
    """
    hidden = ~valid[..., None]
    placed = points.masked_fill(hidden, torch.inf)  # infinitely far from everything
    low, high = placed.amin(2), points.masked_fill(hidden, -torch.inf).amax(2)
    return _nearest(placed.mT.contiguous(), low, high, radius)


def nearest_between_objects_reference(points: Tensor, valid: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """`nearest_between_objects` from the full distance matrix, in any precision."""
    distance = (points[:, :, None, :, None] - points[:, None, :, None]).norm(dim=-1)
    distance, index = distance.masked_fill(~valid[:, None, :, None], torch.inf).min(-1)
    is_self = torch.eye(points.shape[1], dtype=torch.bool, device=points.device)[:, :, None]
    return distance.masked_fill(is_self | ~valid[:, :, None] | (distance >= radius), torch.inf), index
