"""Front-to-back alpha compositing of binned splats: 16 pixels (4 x 4) at a time on the CPU, `compositing_cuda` on CUDA.

The state of a bin's 64 blocks of pixels stays in the L1 cache during one pass over the bin's splats. 64-bit masks hold
the blocks that a splat overlaps and the blocks that are not yet finished.
"""

from __future__ import annotations

from functools import cache

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import view
from stages.core.kernels.simd import VECTORS, launch_ranges, num_threads
from stages.core.kernels.splat import compositing_cuda
from stages.core.kernels.splat.binning import BinnedSplats, Bins
from stages.core.kernels.splat.canvas import Canvas, canvas_over, image_gradients
from stages.core.kernels.splat.compositing_adjoint import composite_adjoint
from stages.core.kernels.splat.pixel_blocks import (
    BIN_BLOCKS,
    MAX_ALPHA,
    MIN_MEAN_ALPHA,
    MIN_TRANSMITTANCE,
    PIXELS_PER_BIN,
)
from stages.core.kernels.splat.projection import MIN_ALPHA
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
for (; k < end && alive; ++k) {
    __builtin_prefetch(splats + 16 * (long)members[k + 8 < end ? k + 8 : k]);
    const int id = members[k];
    const float* s = splats + 16 * (long)id;
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
bins.ends.data[bin] = k;
for (int b = 0; b < BLOCKS; ++b) {
    F t = __builtin_elementwise_abs(T[b]);
    I in = inside(b);
    store(canvas.left.data + ((long)bin * BLOCKS + b) * 16, t);
    __builtin_memcpy(canvas.stops.data + ((long)bin * BLOCKS + b) * 16, &stop[b], 64);
    for (int l = 0; l < 16; ++l) {
        if (!in[l]) continue;
        const int p = pixel(b, l);
        const float alpha = 1 - t[l];
        for (int c = 0; c < 3; ++c)
            canvas.rgb.data[3 * (long)p + c] = colour[b][c][l] + t[l] * canvas.behind.data[step * p + c];
        const float sum = colour[b][3][l];
        canvas.fourth.data[p] = canvas.mean ? sum / (alpha > MIN_MEAN_ALPHA ? alpha : MIN_MEAN_ALPHA) : sum;
        canvas.alpha.data[p] = alpha;
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
    """Build the kernel; with `track` it also writes the dominant splat of each pixel, `index`, and the `totals`."""
    macro = f"#define TRACK(...) {'__VA_ARGS__' if track else ''}\n"

    @wp.func_native(macro + VECTORS + BIN_BLOCKS + _FORWARD + "\n#undef TRACK\n")
    def composite_bin(
        bin: int, bins: BinnedSplats, canvas: Canvas, index: wp.array2d[int], totals: wp.array[float]
    ): ...  # fmt: skip

    @wp.kernel(module="unique", enable_backward=False)
    def composite(
        start: int, piece: int, bins: BinnedSplats, canvas: Canvas, index: wp.array2d[int], totals: wp.array[float]
    ):  # fmt: skip
        composite_bin(start + wp.tid(), bins, canvas, index, totals)

    return composite


def _draw(splats: Tensor, bins: Bins, behind: Tensor, mean: bool, index: Tensor | None = None,
          totals: Tensor | None = None) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:  # fmt: skip
    """Return images (rgb, fourth, alpha) and saved state (left, stops, ends); fills `index` and `totals` if given."""
    count, size = len(bins.starts) - 1, (bins.height, bins.width)
    left, stops = torch.empty(count * PIXELS_PER_BIN), torch.empty(count * PIXELS_PER_BIN, dtype=torch.int32)
    ends = torch.empty(count, dtype=torch.int32)
    rgb, fourth, alpha = torch.empty(*size, 3), torch.empty(size), torch.empty(size)
    canvas = canvas_over(behind, mean, rgb=rgb, fourth=fourth, alpha=alpha, left=left, stops=stops)
    tracked = [None if t is None else view(t) for t in (index, totals)]
    bounds = bins.balanced_bounds(4 * num_threads())
    launch_ranges(_forward(index is not None), bounds, [bins.of(splats, ends), canvas, *tracked])
    return (rgb, fourth, alpha), (left, stops, ends)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, splats, bins, behind, mean):
        draw = compositing_cuda.draw if splats.is_cuda else _draw
        (rgb, fourth, alpha), state = draw(splats, bins, behind, mean)[:2]
        ctx.save_for_backward(splats, behind, fourth, alpha, *state)
        ctx.bins, ctx.mean = bins, mean
        return rgb, fourth, alpha

    @staticmethod
    def backward(ctx, *upstream):
        splats, behind, fourth, alpha, left, stops, *ends = ctx.saved_tensors
        adjoint = compositing_cuda.draw_adjoint if splats.is_cuda else composite_adjoint
        canvas = canvas_over(behind, ctx.mean, fourth=fourth, alpha=alpha, left=left, stops=stops)
        gradients = image_gradients(*(v.float() for v in upstream))
        return adjoint(splats, ctx.bins, *ends, canvas, gradients), None, None, None


def composite(splats: Tensor, bins: Bins | Tiles, behind: Tensor | None = None, mean: bool = False):
    """Composite splats (n, 16) to an image (h, w, 3), fourth channel (h, w) and alpha (h, w); differentiable in splats.

    `behind` is a background colour (3,) or image (h, w, 3), black when None. The fourth channel is composited like the
    others and, with `mean`, divided by alpha. In the splats' gradient, columns 10 and 11 hold the sums over pixels of
    the absolute gradients of the centre, for densification: signed gradients cancel where a splat is larger than the
    detail it covers.
    Source: Kerbl et al. 2023; Ye et al. 2024, "AbsGS", eq. 8.
    """
    behind = splats.new_zeros(3) if behind is None else behind.to(splats).contiguous()
    return _Composite.apply(splats.contiguous(), bins, behind, mean)


def composite_with_dominant(splats: Tensor, bins: Bins | Tiles) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`composite` over black with `mean`, and the dominant splats; not differentiable.

    Additionally returns the splat with the largest weight in each pixel (h, w; -1: none), and the total weight (n,) of
    each splat [px].
    """
    if splats.is_cuda:
        return compositing_cuda.composite_with_dominant(splats, bins)
    index = torch.empty(bins.height, bins.width, dtype=torch.int32)
    totals = torch.zeros(len(bins.members))  # total weight of each pair of bin and splat
    images, _ = _draw(splats, bins, torch.zeros(3), True, index, totals)
    return *images, index.long(), torch.bincount(bins.members, totals, len(splats)).float()


def composite_reference(
    splats: Tensor, order: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`composite` in PyTorch, in any precision; evaluates every splat at every pixel, so only for small scenes.

    `order` (m,) lists splats from near to far. Additionally returns the weights (h, w, m) of the splats in `order`.
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
