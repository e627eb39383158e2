"""Front-to-back compositing of binned splats: on the CPU 16 pixels (4 x 4) at a time, on CUDA by `compositing_cuda`.

The state of a bin's 64 blocks of pixels stays in the first-level cache during one pass over the bin's splats. 64-bit
masks hold the blocks that a splat overlaps and the blocks that are not yet finished.
"""

from __future__ import annotations

from functools import cache

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import view
from stages.core.kernels.splat import compositing_cuda
from stages.core.kernels.splat.binning import Bins
from stages.core.kernels.splat.compositing_adjoint import composite_adjoint
from stages.core.kernels.splat.pixel_blocks import (
    BIN_BLOCKS,
    MAX_ALPHA,
    MIN_MEAN_ALPHA,
    MIN_TRANSMITTANCE,
    PIXELS_PER_BIN,
)
from stages.core.kernels.splat.projection import MIN_ALPHA
from stages.core.kernels.splat.simd import VECTORS, launch_ranges, num_threads
from stages.core.kernels.splat.tiles import Tiles

_FORWARD = r"""
F T[BLOCKS], colour[BLOCKS][4];
I stop[BLOCKS];
TRACK(F best[BLOCKS]; I which[BLOCKS];)
unsigned long long alive = 0;
for (int b = 0; b < BLOCKS; ++b) {
    I in = inside(b);
    T[b] = in ? (F)(1.0f) : (F)(-1.0f);  // negative: pixel finished
    for (int c = 0; c < 4; ++c) colour[b][c] = none;
    TRACK(best[b] = none; which[b] = (I)(-1);)
    stop[b] = (I)(0x7fffffff);
    if (bits(in)) alive |= 1ull << b;
}
int k = begin;
for (const int end = starts.data[bin + 1]; k < end && alive; ++k) {
    __builtin_prefetch(splats.data + 16 * (long)members.data[k + 8 < end ? k + 8 : k]);
    const int id = members.data[k];
    const float* s = splats.data + 16 * (long)id;
    const float x = s[0] - X, y = s[1] - Y;
    const float A = -0.721347520f * s[2], B = -1.44269504f * s[3], C = -0.721347520f * s[4], lo = s[10];
    TRACK(F sum = none;)
    for (unsigned long long todo = alive & overlapped(x, y, s[11], s[12]); todo; todo &= todo - 1) {
        const int b = __builtin_ctzll(todo);
        F dx = lx + (4 * (b & 7) - x), dy = ly + (4 * (b >> 3) - y);
        F power = fma(dx, fma((F)(A), dx, B * dy), fma(C * dy, dy, (F)(lo)));  // log2 of alpha
        I hit = (power >= -7.99435344f) & (T[b] > 0);
        if (!bits(hit)) continue;
        F alpha = vmin(exp2v(power), (F)(MAX_ALPHA)), next = T[b] - alpha * T[b];
        I drawn = hit & (next > MIN_TRANSMITTANCE);
        F w = drawn ? alpha * T[b] : none;
        for (int c = 0; c < 4; ++c) colour[b][c] = fma(w, (F)(s[6 + c]), colour[b][c]);
        TRACK(sum += w; I more = w > best[b]; best[b] = more ? w : best[b]; which[b] = more ? (I)(id) : which[b];)
        I shut = hit & ~drawn;
        T[b] = drawn ? next : T[b];
        if (bits(shut)) {
            T[b] = shut ? -T[b] : T[b];
            stop[b] = shut ? (I)(k) : stop[b];
            if (!bits(T[b] > 0)) alive &= ~(1ull << b);
        }
    }
    TRACK(float total = 0; for (int l = 0; l < 16; ++l) total += sum[l]; totals.data[k] = total;)
}
ends.data[bin] = k;
for (int b = 0; b < BLOCKS; ++b) {
    F t = __builtin_elementwise_abs(T[b]);
    I in = inside(b);
    store(left.data + ((long)bin * BLOCKS + b) * 16, t);
    __builtin_memcpy(stops.data + ((long)bin * BLOCKS + b) * 16, &stop[b], 64);
    for (int l = 0; l < 16; ++l) {
        if (!in[l]) continue;
        const int p = pixel(b, l);
        const float alpha = 1 - t[l];
        for (int c = 0; c < 3; ++c) rgb.data[3 * (long)p + c] = colour[b][c][l] + t[l] * behind.data[step * p + c];
        fourth.data[p] = mean ? colour[b][3][l] / (alpha > MIN_MEAN_ALPHA ? alpha : MIN_MEAN_ALPHA) : colour[b][3][l];
        alphas.data[p] = alpha;
        TRACK(index.data[p] = which[b][l];)
    }
}
"""
for _name, _value in (
    ("MAX_ALPHA", MAX_ALPHA),
    ("MIN_TRANSMITTANCE", MIN_TRANSMITTANCE),
    ("MIN_MEAN_ALPHA", MIN_MEAN_ALPHA),
):
    _FORWARD = _FORWARD.replace(_name, f"{_value}f")


@cache
def _forward(track: bool) -> wp.Kernel:
    """Build the kernel; `track`: with the dominant splat of each pixel, `index`, and the splats' `totals`."""
    macro = f"#define TRACK(...) {'__VA_ARGS__' if track else ''}\n"

    @wp.func_native(macro + VECTORS + BIN_BLOCKS + _FORWARD + "\n#undef TRACK\n")
    def composite_bin(
        bin: int, width: int, height: int, across: int, step: int, mean: int, splats: wp.array[float],
        members: wp.array[int], starts: wp.array[int], behind: wp.array[float], left: wp.array[float],
        stops: wp.array[int], ends: wp.array[int], rgb: wp.array[float], fourth: wp.array[float],
        alphas: wp.array[float], index: wp.array[int], totals: wp.array[float],
    ): ...  # fmt: skip

    @wp.kernel(module="unique", enable_backward=False)
    def composite(
        start: int, piece: int, width: int, height: int, across: int, step: int, mean: int, splats: wp.array[float],
        members: wp.array[int], starts: wp.array[int], behind: wp.array[float], left: wp.array[float],
        stops: wp.array[int], ends: wp.array[int], rgb: wp.array[float], fourth: wp.array[float],
        alphas: wp.array[float], index: wp.array[int], totals: wp.array[float],
    ):  # fmt: skip
        composite_bin(start + wp.tid(), width, height, across, step, mean, splats, members, starts, behind,
                      left, stops, ends, rgb, fourth, alphas, index, totals)  # fmt: skip

    return composite


def _arguments(splats: Tensor, bins: Bins, behind: Tensor, mean: bool, *tensors: Tensor | None) -> list:
    """Kernel arguments, from the width on."""
    flat = (splats, bins.members, bins.starts, behind, *tensors)
    step = 0 if behind.dim() == 1 else 3
    views = (None if t is None else view(t.view(-1)) for t in flat)
    return [bins.width, bins.height, bins.columns, step, int(mean), *views]


def _draw(splats: Tensor, bins: Bins, behind: Tensor, mean: bool, index: Tensor | None = None,
          totals: Tensor | None = None) -> tuple[list[Tensor], list[Tensor]]:  # fmt: skip
    """Images (rgb, fourth, alpha) and saved state (transmittance, stops, ends); fills `index` and `totals` if given."""
    count, size = len(bins.starts) - 1, (bins.height, bins.width)
    state = [torch.empty(count * PIXELS_PER_BIN), torch.empty(count * PIXELS_PER_BIN, dtype=torch.int32),
             torch.empty(count, dtype=torch.int32)]  # fmt: skip
    images = [torch.empty(*size, 3), torch.empty(size), torch.empty(size)]
    arguments = _arguments(splats, bins, behind, mean, *state, *images, index, totals)
    launch_ranges(_forward(index is not None), bins.balanced_bounds(4 * num_threads()), arguments)
    return images, state


def _draw_adjoint(splats: Tensor, bins: Bins, behind: Tensor, mean: bool, *state: Tensor) -> Tensor:
    """Gradient (n, 16) of the splats; `state`: as in `compositing_cuda.draw_adjoint`."""
    return composite_adjoint(splats, bins, state[2], _arguments(splats, bins, behind, mean, *state))


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, splats, bins, behind, mean):
        draw = compositing_cuda.draw if splats.is_cuda else _draw
        (rgb, fourth, alpha), state = draw(splats, bins, behind, mean)[:2]
        ctx.save_for_backward(splats, behind, *state, fourth, alpha)
        ctx.bins, ctx.mean = bins, mean
        return rgb, fourth, alpha

    @staticmethod
    def backward(ctx, *upstream):
        splats, behind, *state = ctx.saved_tensors
        draw_adjoint = compositing_cuda.draw_adjoint if splats.is_cuda else _draw_adjoint
        upstream = [v.float().contiguous() for v in upstream]
        return draw_adjoint(splats, ctx.bins, behind, ctx.mean, *state, *upstream), None, None, None


def composite(splats: Tensor, bins: Bins | Tiles, behind: Tensor | None = None, mean: bool = False):
    """Composite splats (n, 16): image (h, w, 3), fourth channel (h, w) and alpha (h, w). Differentiable in the splats.

    `behind` is a background colour (3,) or image (h, w, 3), black when None. The fourth channel is composited like the
    others or, with `mean`, divided by alpha. In the splats' gradient, columns 10 and 11 hold the sums over pixels of
    the absolute gradients of the centre, for densification: the signed ones cancel where a splat is larger than the
    detail it covers.
    Source: Kerbl et al. 2023; Ye et al. 2024, "AbsGS", eq. 8.
    """
    behind = splats.new_zeros(3) if behind is None else behind.to(splats).contiguous()
    return _Composite.apply(splats.contiguous(), bins, behind, mean)


def composite_with_dominant(splats: Tensor, bins: Bins | Tiles) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`composite` over black with `mean`; the splat with the largest weight in each pixel (h, w; -1: none), and each
    splat's total weight (n,) [px]. Not differentiable."""
    if splats.is_cuda:
        return compositing_cuda.composite_with_dominant(splats, bins)
    index = torch.empty(bins.height, bins.width, dtype=torch.int32)
    totals = torch.zeros(len(bins.members))  # of each pair of bin and splat
    images, _ = _draw(splats, bins, torch.zeros(3), True, index, totals)
    return *images, index.long(), torch.bincount(bins.members, totals, len(splats)).float()


def composite_reference(
    splats: Tensor, order: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Image, fourth channel and alpha as `composite` returns them, and the weights (h, w, m) of the splats in `order`.

    `order` (m,) lists splats from near to far. PyTorch, every splat at every pixel: for small scenes, any precision.
    """
    s = splats[order]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx, dy = x.to(s)[..., None] - s[:, 0], y.to(s)[..., None] - s[:, 1]
    sigma = 0.5 * (s[:, 2] * dx * dx + s[:, 4] * dy * dy) + s[:, 3] * dx * dy
    alpha = (s[:, 5] * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha, torch.zeros_like(alpha))
    drawn = (1 - alpha).cumprod(-1) > MIN_TRANSMITTANCE  # once false, false for all later splats
    alpha = torch.where(drawn, alpha, torch.zeros_like(alpha))
    T = (1 - alpha).cumprod(-1)
    weight = alpha * torch.cat([torch.ones_like(T[..., :1]), T[..., :-1]], -1)
    return weight @ s[:, 6:9], weight @ s[:, 9], weight.sum(-1), weight
