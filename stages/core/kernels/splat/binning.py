"""Binning on the CPU: lists of the splats that overlap each bin of the image, sorted by depth.

The splats are sorted by depth once and appended in that order to the bins that they overlap, so every bin is sorted.
This sorts fewer keys than one per pair of splat and bin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import view, with_arrays
from stages.core.kernels.simd import even_bounds, launch_ranges, num_threads
from stages.core.kernels.splat.projection import BIN_SIZE

wp.set_module_options({"enable_backward": False})

# Radix sort, least significant digit first, 3 x 11 bits (the sign of a depth is always 0); stable.
_SORT = r"""
enum { DIGITS = 2048 };
const int n = keys.shape[0];
unsigned hist[3][DIGITS] = {};
unsigned* key[2] = {(unsigned*)scratch.data, (unsigned*)scratch.data + n};
int* id[2] = {order.data, scratch.data + 2 * (long)n};
int m = 0;
for (int i = 0; i < n; ++i) {
    unsigned k = keys.data[i];
    if ((int)k < 0) continue;
    key[1][m] = k;
    id[1][m++] = i;
    ++hist[0][k & 2047]; ++hist[1][(k >> 11) & 2047]; ++hist[2][k >> 22];
}
for (int pass = 0; pass < 3; ++pass) {
    unsigned at = 0, *h = hist[pass];
    for (int d = 0; d < DIGITS; ++d) { unsigned c = h[d]; h[d] = at; at += c; }
    const unsigned* from = key[~pass & 1];
    const int* ids = id[~pass & 1];
    for (int i = 0; i < m; ++i) {
        unsigned slot = h[(from[i] >> (11 * pass)) & 2047]++;
        key[pass & 1][slot] = from[i];
        id[pass & 1][slot] = ids[i];
    }
}
total.data[0] = m;
"""

# The range of a part, in local variables, so that stores to other arrays do not make the compiler reload the struct.
_RANGE = r"""
const int begin = splats.bounds.data[piece], end = splats.bounds.data[piece + 1], across = splats.across;
const int* ids = splats.ids.data;
const short* rects = splats.rects.data;
"""

# Counting pass: each part counts the splats of its range per bin, which gives its write position in every bin.
_COUNT = r"""
const int bins = counts.shape[1];
int* count = counts.data + (long)piece * bins;
for (int b = 0; b < bins; ++b) count[b] = 0;
for (int i = begin; i < end; ++i) {
    const short* r = rects + 4 * (long)ids[i];
    for (int y = r[1]; y <= r[3]; ++y)
        for (int x = r[0]; x <= r[2]; ++x) ++count[y * across + x];
}
"""

# Filling pass: each part appends its range to the bins.
_FILL = r"""
int *at = counts.data + (long)piece * counts.shape[1], slot = splats.firsts.data[piece];
for (int i = begin; i < end; ++i) {
    const int id = ids[i];
    const short* r = rects + 4 * (long)id;
    for (int y = r[1]; y <= r[3]; ++y)
        for (int x = r[0]; x <= r[2]; ++x) {
            const int k = at[y * across + x]++;
            members.data[k] = id;
            slots.data[k] = slot++;
        }
}
"""


@wp.struct
class SplatOrder:
    """The visible splats in order of depth, divided into ranges for parallel work, and the bins that each overlaps."""

    ids: wp.array[int]  # (n,), indices of splats, nearest first; entries outside the ranges are unused
    bounds: wp.array[int]  # (pieces + 1,), bounds of the ranges
    firsts: wp.array[int]  # (pieces,), slot of the first splat of each range
    rects: wp.array2d[wp.int16]  # (n, 4), bins of each splat: first column, first row, last column, last row
    across: int  # bins per row of the image


@wp.struct
class BinnedSplats:
    """Splats and the lists of the splats in each bin; see `Bins`."""

    splats: wp.array2d[float]  # (n, 16)
    members: wp.array[int]  # (m,)
    starts: wp.array[int]  # (bins + 1,)
    ends: wp.array[int]  # (bins,), one past the last member of each bin that compositing processed
    slots: wp.array[int]  # (m,)


@wp.func_native(_SORT)
def _sort_keys(keys: wp.array[int], order: wp.array[int], scratch: wp.array[int], total: wp.array[int]): ...


@wp.kernel
def _sort(
    start: int, piece: int, keys: wp.array[int], order: wp.array[int], scratch: wp.array[int], total: wp.array[int]
):  # fmt: skip
    _sort_keys(keys, order, scratch, total)


@wp.func_native(_RANGE + _COUNT)
def _count_piece(piece: int, splats: SplatOrder, counts: wp.array2d[int]): ...


@wp.func_native(_RANGE + _FILL)
def _fill_piece(
    piece: int, splats: SplatOrder, counts: wp.array2d[int], members: wp.array[int], slots: wp.array[int]
): ...  # fmt: skip


@wp.kernel
def _count(start: int, piece: int, splats: SplatOrder, counts: wp.array2d[int]):
    _count_piece(piece, splats, counts)


@wp.kernel
def _fill(
    start: int, piece: int, splats: SplatOrder, counts: wp.array2d[int], members: wp.array[int], slots: wp.array[int]
):  # fmt: skip
    _fill_piece(piece, splats, counts, members, slots)


@dataclass(frozen=True)
class Bins:
    """The splats of each bin, nearest first; bins are numbered row by row."""

    members: Tensor  # (m,) int32, indices of splats
    starts: Tensor  # (bins + 1,) int32, bin b holds members[starts[b]:starts[b + 1]]
    slots: Tensor  # (m,) int32, position of each member in the list by splat: nearest splat first, bins in row order
    order: SplatOrder
    width: int  # [px]
    height: int

    def of(self, splats: Tensor, ends: Tensor | None = None) -> BinnedSplats:
        """Return the bins with their splats (n, 16) for kernels; `ends` (bins,) is where compositing ended in each."""
        tensors = {"splats": splats, "members": self.members, "starts": self.starts, "slots": self.slots}
        return with_arrays(BinnedSplats(), tensors if ends is None else {**tensors, "ends": ends})

    def balanced_bounds(self, count: int, work: Tensor | None = None) -> list[int]:
        """Return the bounds of at most `count` ranges of bins with about equal work.

        `work` (bins,) is by default the number of members of each bin.
        """
        work = self.starts.diff() if work is None else work
        total = (work + 1).cumsum(0).double()
        cuts = torch.searchsorted(total, total[-1] * torch.arange(1, count) / count)
        return sorted({0, *cuts.tolist(), len(work)})

    def with_any(self, which: Tensor) -> Bins:
        """Return a copy without the members of bins that hold none of the splats `which` (n,); not for gradients."""
        bins, counts = len(self.starts) - 1, self.starts.diff()
        bin_of = torch.repeat_interleave(torch.arange(bins), counts)
        kept = torch.zeros(bins, dtype=torch.bool)
        kept[bin_of[which[self.members]]] = True
        starts = torch.nn.functional.pad((counts * kept).cumsum(0, dtype=torch.int32), (1, 0))
        return replace(self, members=self.members[kept[bin_of]], starts=starts)


def bin_splats(keys: Tensor, rects: Tensor, width: int, height: int, side: int = BIN_SIZE) -> Bins:
    """Sort splats into bins of `side` pixels, given the sort keys (n,) and bin rectangles (n, 4) from `project`."""
    n, across, down = len(keys), -(-width // side), -(-height // side)
    bins = across * down
    order, scratch = torch.empty(n, dtype=torch.int32), torch.empty(3 * n, dtype=torch.int32)
    total = torch.zeros(1, dtype=torch.int32)
    if n:
        launch_ranges(_sort, [0, 1], [view(keys), view(order), view(scratch), view(total)])
    pieces = num_threads()
    bounds = torch.tensor(even_bounds(int(total), pieces), dtype=torch.int32)
    counts = torch.empty(pieces, bins, dtype=torch.int32)
    ordered = with_arrays(SplatOrder(), {"ids": order, "bounds": bounds, "rects": rects})
    ordered.across = across
    launch_ranges(_count, list(range(pieces + 1)), [ordered, view(counts)])
    ordered.firsts = view((counts.sum(1).cumsum(0) - counts.sum(1)).int())
    ends = counts.T.reshape(-1).cumsum(0, dtype=torch.int32)  # bin by bin, within it piece by piece
    starts = torch.cat([ends.new_zeros(1), ends[pieces - 1 :: pieces]])
    counts.copy_((ends - counts.T.reshape(-1)).view(bins, pieces).T)
    members, slots = torch.empty(2, int(ends[-1]), dtype=torch.int32)
    launch_ranges(_fill, list(range(pieces + 1)), [ordered, view(counts), view(members), view(slots)])
    return Bins(members, starts, slots, ordered, width, height)


def depth_order_reference(splats: Tensor) -> Tensor:
    """Return the indices of all visible splats, nearest first: the members of a single bin over the whole image."""
    visible = (splats[:, 11] > 0).nonzero()[:, 0]
    return visible[splats[visible, 9].argsort(stable=True)]
