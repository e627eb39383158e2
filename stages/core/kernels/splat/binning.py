"""Binning: the splats that overlap each bin of the image, sorted by depth.

The splats are sorted by depth once and appended in that order to the bins that they overlap, which leaves every bin
sorted: fewer keys than one for each pair of splat and bin.
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

# The range of a part, in locals: stores to other arrays must not make the compiler read the struct again.
_RANGE = r"""
const int begin = splats.bounds.data[piece], end = splats.bounds.data[piece + 1], across = splats.across;
const int* ids = splats.ids.data;
const short* rects = splats.rects.data;
"""

# Counting pass: each part counts its range of the order, which gives its write position in every bin.
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
    """The visible splats by depth, in ranges that are worked on in parallel, and the bins that each overlaps."""

    ids: wp.array[int]  # (n,), indices of splats; those outside the ranges are unused
    bounds: wp.array[int]  # (pieces + 1,), ranges of this order
    firsts: wp.array[int]  # (pieces,), slot of the first splat of each range
    rects: wp.array2d[wp.int16]  # (n, 4), first column and row and last ones of the bins of each splat
    across: int  # bins in a row


@wp.struct
class BinnedSplats:
    """Splats and the lists of those in each bin; see `Bins`."""

    splats: wp.array2d[float]  # (n, 16)
    members: wp.array[int]  # (m,)
    starts: wp.array[int]  # (bins + 1,)
    ends: wp.array[int]  # (bins,), one past the last member of each bin that compositing came to
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
    slots: Tensor  # (m,) int32, position of each member in the list by splat: nearest splat first, its bins row by row
    order: SplatOrder
    width: int  # [px]
    height: int

    def of(self, splats: Tensor, ends: Tensor | None = None) -> BinnedSplats:
        """These bins of splats (n, 16) for kernels, and where compositing ended in each of them (bins,), if it has."""
        tensors = {"splats": splats, "members": self.members, "starts": self.starts, "slots": self.slots}
        return with_arrays(BinnedSplats(), tensors if ends is None else {**tensors, "ends": ends})

    def balanced_bounds(self, count: int, work: Tensor | None = None) -> list[int]:
        """Bounds of at most `count` ranges of bins with about equal work (bins,), by default the number of members."""
        work = self.starts.diff() if work is None else work
        total = (work + 1).cumsum(0).double()
        cuts = torch.searchsorted(total, total[-1] * torch.arange(1, count) / count)
        return sorted({0, *cuts.tolist(), len(work)})

    def with_any(self, which: Tensor) -> Bins:
        """The same without the members of bins that hold none of the splats `which` (n,). Not for gradients."""
        bins, counts = len(self.starts) - 1, self.starts.diff()
        bin_of = torch.repeat_interleave(torch.arange(bins), counts)
        kept = torch.zeros(bins, dtype=torch.bool)
        kept[bin_of[which[self.members]]] = True
        starts = torch.nn.functional.pad((counts * kept).cumsum(0, dtype=torch.int32), (1, 0))
        return replace(self, members=self.members[kept[bin_of]], starts=starts)


def bin_splats(keys: Tensor, rects: Tensor, width: int, height: int, side: int = BIN_SIZE) -> Bins:
    """Sort splats into bins of `side` pixels, by sort keys (n,) and bin rectangles (n, 4) as `project` returns them."""
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
    """Indices of all visible splats, nearest first: the members of a single bin over the whole image."""
    visible = (splats[:, 11] > 0).nonzero()[:, 0]
    return visible[splats[visible, 9].argsort(stable=True)]
