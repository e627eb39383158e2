"""Binning on CUDA: lists of the splats that overlap each tile of TILE_SIZE x TILE_SIZE pixels, sorted by depth.

The splats are sorted by depth, listed in that order once for every tile that they overlap, and the list is sorted by
tile; both sorts are stable. An entry of the unsorted list is called a slot. The slots of a splat are contiguous, so the
adjoint sums a splat's gradient over its tiles in a fixed order, without atomics.

With a given capacity the functions do not synchronise with the GPU, so they can be captured in a CUDA graph.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import device_of, launch, view, with_arrays
from stages.core.kernels.splat.projection import TILE_SIZE

wp.set_module_options({"enable_backward": False})

MAX_INT16 = 2**15 - 1


@wp.struct
class SlotRanges:
    """The splats in order of depth, and the range of slots of each: ends[r] - counts[r] up to ends[r]."""

    ids: wp.array[wp.int64]  # (n,)
    counts: wp.array[int]  # (n,)
    ends: wp.array[int]  # (n,); may exceed the number of slots if the capacity is too small


@wp.struct
class TiledSplats:
    """Splats and the lists of the splats in each tile; see `Tiles`."""

    splats: wp.array2d[float]  # (n, 16)
    slots: wp.array[wp.int64]  # (m,)
    ids: wp.array[int]  # (m,)
    starts: wp.array[int]  # (tiles + 1,)


@wp.kernel
def _count(order: wp.array[wp.int64], keys: wp.array[int], rects: wp.array2d[wp.int16], counts: wp.array[int]):
    r = wp.tid()
    i = wp.int32(order[r])
    if keys[i] >= 0:
        counts[r] = (int(rects[i, 2] - rects[i, 0]) + 1) * (int(rects[i, 3] - rects[i, 1]) + 1)
    else:
        counts[r] = 0


@wp.kernel
def _fill(
    splats: SlotRanges, rects: wp.array2d[wp.int16], across: int, tiles: wp.array[wp.int32], ids: wp.array[int]
):  # fmt: skip
    r = wp.tid()
    i = wp.int32(splats.ids[r])
    if splats.counts[r] == 0:
        return
    slot = splats.ends[r] - splats.counts[r]
    for y in range(int(rects[i, 1]), int(rects[i, 3]) + 1):
        for x in range(int(rects[i, 0]), int(rects[i, 2]) + 1):
            if slot < tiles.shape[0]:
                tiles[slot] = y * across + x
                ids[slot] = i
            slot += 1


@wp.kernel
def _starts(tiles: wp.array[wp.int32], starts: wp.array[int]):
    """Find the first entry of each tile in the sorted list; entries of tile -1 are unused capacity."""
    k = wp.tid()
    tile = tiles[k]
    before = wp.int32(-1)
    if k > 0:
        before = tiles[k - 1]
    for t in range(before + 1, tile + 1):
        starts[t] = k
    if k == tiles.shape[0] - 1:
        for t in range(tile + 1, starts.shape[0]):
            starts[t] = k + 1


@dataclass(frozen=True)
class Capacity:
    """Fixed number of slots, for repeated calls that must not synchronise with the GPU."""

    slots: int
    needed: Tensor  # (1,) int32, the largest number of slots that any call needed

    @classmethod
    def at_least(cls, needed: int, device: torch.device) -> Capacity:
        """Return a capacity of 1.5 times the `needed` slots plus a constant, since later calls may need more."""
        return cls(needed + needed // 2 + 1024, torch.zeros(1, dtype=torch.int32, device=device))


@dataclass(frozen=True)
class Tiles:
    """The splats of each tile, nearest first; tiles are numbered row by row. m is the number of slots."""

    slots: Tensor  # (m,) int64, tile b holds slots[starts[b]:starts[b + 1]]
    ids: Tensor  # (m,) int32, splat of each slot
    starts: Tensor  # (tiles + 1,) int32
    order: SlotRanges
    width: int  # [px]
    height: int

    def of(self, splats: Tensor) -> TiledSplats:
        """Return the tiles with their splats (n, 16) for kernels."""
        tiled = with_arrays(TiledSplats(), {"splats": splats, "ids": self.ids, "starts": self.starts})
        tiled.slots = view(self.slots)
        return tiled


def bin_tiles(keys: Tensor, rects: Tensor, width: int, height: int, capacity: Capacity | None = None) -> Tiles:
    """Sort splats into tiles, given the sort keys (n,) and tile rectangles (n, 4) from `project`.

    Without a capacity there are as many slots as needed; otherwise slots beyond the capacity are dropped.
    """
    device, n = keys.device, len(keys)
    across, down = -(-width // TILE_SIZE), -(-height // TILE_SIZE)
    order = keys.sort(stable=True).indices
    counts = torch.empty(n, dtype=torch.int32, device=device)
    launch(_count, n, [view(order), view(keys), view(rects)], [view(counts)], device_of(keys))
    ends = counts.cumsum(0, dtype=torch.int32)
    if capacity is None:
        size = int(ends[-1]) if n else 0
    else:
        size = capacity.slots
        torch.maximum(capacity.needed, ends[-1:], out=capacity.needed)
    tiles = torch.full((size,), -1, dtype=torch.int32, device=device)
    ids = torch.zeros(size, dtype=torch.int32, device=device)
    ranges = with_arrays(SlotRanges(), {"counts": counts, "ends": ends})
    ranges.ids = view(order)
    launch(_fill, n, [ranges, view(rects), across], [view(tiles), view(ids)], device_of(keys))
    # a narrower key needs fewer passes of the radix sort
    narrow = tiles.to(torch.int16) if across * down <= MAX_INT16 else tiles
    tiles, slots = narrow.sort(stable=True)
    starts = torch.zeros(across * down + 1, dtype=torch.int32, device=device)
    launch(_starts, size, [view(tiles.int())], [view(starts)], device_of(keys))
    return Tiles(slots, ids, starts, ranges, width, height)
