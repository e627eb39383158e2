"""Compositing of binned splats, front to back, and its adjoint, back to front; sixteen pixels (4 x 4) at a time.

The bin's 64 blocks of pixels keep their state in the first-level cache while the bin's splats pass by once. A 64-bit
mask says which blocks a splat can reach and which still let light through, so neither costs more than a bit.

The rule, as in gsplat: alpha = min(0.999, opacity exp(-d'Cd/2)) counts from 1/255, a pixel is finished when the next
splat would leave a transmittance T of 1e-4 or less (that splat is not drawn), and w = alpha T.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from stages.kernels.interop import view
from stages.kernels.splat_bin import Bins
from stages.kernels.splat_lanes import SUMS, VECTORS, even, parts, run
from stages.kernels.splat_project import BIN, FAINTEST, WIDTH

wp.set_module_options({"enable_backward": False})

SOLID = 0.999  # alpha is never more, so that light always passes and 1 / (1 - alpha) exists
CLOSED = 1e-4  # transmittance at which a pixel is finished
NOTHING = 1e-10  # alpha below which a mean is 0, not noise
BLOCKS = (BIN // 4) ** 2
PIXELS = BLOCKS * 16  # in a bin, in the order of blocks and lanes in which per-pixel state is kept between passes

_BIN = r"""
enum { BLOCKS = 64 };
const int X = (bin % across) * 32, Y = (bin / across) * 32;
const F lx = {.5f, 1.5f, 2.5f, 3.5f, .5f, 1.5f, 2.5f, 3.5f, .5f, 1.5f, 2.5f, 3.5f, .5f, 1.5f, 2.5f, 3.5f};
const F ly = {.5f, .5f, .5f, .5f, 1.5f, 1.5f, 1.5f, 1.5f, 2.5f, 2.5f, 2.5f, 2.5f, 3.5f, 3.5f, 3.5f, 3.5f};
const F none = (F)(0.0f);
const int begin = starts.data[bin];
auto inside = [&](int block) -> I {
    return (lx + (float)(X + 4 * (block & 7)) < (float)width) & (ly + (float)(Y + 4 * (block >> 3)) < (float)height);
};
// where lane l of a block lies in the image, row by row
auto pixel = [&](int block, int l) {
    return (Y + 4 * (block >> 3) + (l >> 2)) * width + X + 4 * (block & 7) + (l & 3);
};
// the blocks that the box x +- rx, y +- ry touches, as bits
auto reached = [&](float x, float y, float rx, float ry) -> unsigned long long {
    auto clamp = [](float v) { return (int)(v < -1.0f ? -1.0f : v > 8.0f ? 8.0f : v); };
    int j0 = clamp((x - rx + 0.5f) * 0.25f), j1 = clamp((x + rx - 0.5f) * 0.25f);
    int i0 = clamp((y - ry + 0.5f) * 0.25f), i1 = clamp((y + ry - 0.5f) * 0.25f);
    j0 = j0 < 0 ? 0 : j0; i0 = i0 < 0 ? 0 : i0; j1 = j1 > 7 ? 7 : j1; i1 = i1 > 7 ? 7 : i1;
    if (j0 > j1 || i0 > i1 || x + rx < 0.5f || y + ry < 0.5f) return 0;
    unsigned long long columns = ((2u << j1) - (1u << j0)) * 0x0101010101010101ull;
    return columns & (~0ull << (8 * i0)) & (~0ull >> (56 - 8 * i1));
};
"""

_FORWARD = r"""
F T[BLOCKS], colour[BLOCKS][4];
I stop[BLOCKS];
TRACK(F best[BLOCKS]; I which[BLOCKS]; float* total = totals.data + (long)piece * n;)
unsigned long long alive = 0;
for (int b = 0; b < BLOCKS; ++b) {
    I in = inside(b);
    T[b] = in ? (F)(1.0f) : (F)(-1.0f);  // negative: finished
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
    for (unsigned long long todo = alive & reached(x, y, s[11], s[12]); todo; todo &= todo - 1) {
        const int b = __builtin_ctzll(todo);
        F dx = lx + (4 * (b & 7) - x), dy = ly + (4 * (b >> 3) - y);
        F power = fma(dx, fma((F)(A), dx, B * dy), fma(C * dy, dy, (F)(lo)));  // log2 of alpha
        I hit = (power >= -7.99435344f) & (T[b] > 0);
        if (!bits(hit)) continue;
        F alpha = vmin(exp2v(power), (F)(SOLID)), next = T[b] - alpha * T[b];
        I drawn = hit & (next > CLOSED);
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
    TRACK(for (int l = 0; l < 16; ++l) total[id] += sum[l];)
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
        fourth.data[p] = mean ? colour[b][3][l] / (alpha > NOTHING ? alpha : NOTHING) : colour[b][3][l];
        alphas.data[p] = alpha;
        TRACK(index.data[p] = which[b][l];)
    }
}
""".replace("SOLID", f"{SOLID}f").replace("CLOSED", f"{CLOSED}f").replace("NOTHING", f"{NOTHING}f")

# dL/dalpha = T (colour . v) - S / (1 - alpha), where S is what lies behind, seen through: the sum of w (colour . v)
# over the later splats, minus T_end v_alpha. The sums over pixels are moments in d, so that what they mean for a
# splat's centre and covariance can wait until all bins are added up.
_BACKWARD = r"""
if (first) __builtin_memset(moments.data + (long)piece * n * 16, 0, (long)n * 64);
F T[BLOCKS], S[BLOCKS], v[BLOCKS][4];
I stop[BLOCKS];
int last[BLOCKS];
for (int b = 0; b < BLOCKS; ++b) {
    I in = inside(b);
    F v_alpha = none;
    T[b] = load(left.data + ((long)bin * BLOCKS + b) * 16);
    __builtin_memcpy(&stop[b], stops.data + ((long)bin * BLOCKS + b) * 16, 64);
    stop[b] = in ? stop[b] : (I)(0);
    last[b] = __builtin_reduce_max(stop[b]);
    for (int c = 0; c < 4; ++c) v[b][c] = none;
    for (int l = 0; l < 16; ++l) {
        if (!in[l]) continue;
        const int p = pixel(b, l);
        float va = v_alphas.data[p], v4 = v_fourth.data[p];
        for (int c = 0; c < 3; ++c) {
            v[b][c][l] = v_rgb.data[3 * (long)p + c];
            va -= v[b][c][l] * behind.data[step * p + c];
        }
        if (mean) {
            v4 = alphas.data[p] > NOTHING ? v4 / alphas.data[p] : 0;
            va -= v4 * fourth.data[p];
        }
        v[b][3][l] = v4;
        v_alpha[l] = va;
    }
    S[b] = -v_alpha * T[b];
}
for (int k = ends.data[bin] - 1; k >= begin; --k) {
    __builtin_prefetch(splats.data + 16 * (long)members.data[k - 8 > begin ? k - 8 : begin]);
    const int id = members.data[k];
    const float* s = splats.data + 16 * (long)id;
    const float x = s[0] - X, y = s[1] - Y;
    const float A = -0.721347520f * s[2], B = -1.44269504f * s[3], C = -0.721347520f * s[4], lo = s[10];
    F sum[16];
    for (int i = 0; i < 16; ++i) sum[i] = none;
    bool any = false;
    for (unsigned long long todo = reached(x, y, s[11], s[12]); todo; todo &= todo - 1) {
        const int b = __builtin_ctzll(todo);
        if (k >= last[b]) continue;
        F dx = lx + (4 * (b & 7) - x), dy = ly + (4 * (b >> 3) - y);
        F power = fma(dx, fma((F)(A), dx, B * dy), fma(C * dy, dy, (F)(lo)));
        I hit = (power >= -7.99435344f) & (k < stop[b]);
        if (!bits(hit)) continue;
        any = true;
        F raw = exp2v(power), alpha = hit ? vmin(raw, (F)(SOLID)) : none;
        F open = 1.0f / (1.0f - alpha);
        F t = T[b] * open, w = alpha * t, facing = none;
        for (int c = 0; c < 4; ++c) {
            facing = fma(v[b][c], (F)(s[6 + c]), facing);
            sum[6 + c] = fma(w, v[b][c], sum[6 + c]);
        }
        F g = raw <= SOLID ? alpha * (t * facing - S[b] * open) : none;  // dL/dlog(alpha)
        T[b] = t;
        S[b] = fma(w, facing, S[b]);
        F gx = g * dx, gy = g * dy;
        sum[0] += gx;
        sum[1] += gy;
        sum[2] = fma(gx, dx, sum[2]);
        sum[3] = fma(gx, dy, sum[3]);
        sum[4] = fma(gy, dy, sum[4]);
        sum[5] += g;
        sum[10] += __builtin_elementwise_abs(s[2] * gx + s[3] * gy);
        sum[11] += __builtin_elementwise_abs(s[3] * gx + s[4] * gy);
    }
    if (any) {
        float* to = moments.data + ((long)piece * n + id) * 16;
        store(to, load(to) + sums(sum));
    }
}
""".replace("SOLID", f"{SOLID}f").replace("NOTHING", f"{NOTHING}f")

# The moments of all pieces of a splat's gradient become the gradient of its row.
_GRADIENT = r"""
F m = load(moments.data + 16 * (long)i);
for (int p = 1; p < pieces; ++p) m += load(moments.data + 16 * ((long)p * n + i));
const float* s = splats.data + 16 * (long)i;
F g = m;
g[0] = s[2] * m[0] + s[3] * m[1];
g[1] = s[3] * m[0] + s[4] * m[1];
g[2] = -0.5f * m[2];
g[3] = -m[3];
g[4] = -0.5f * m[4];
g[5] = s[5] > 0 ? m[5] / s[5] : 0.0f;
store(grads.data + 16 * (long)i, g);
"""


def _tracked(code: str, track: bool) -> str:
    """The forward snippet with or without the lines that look for the heaviest splat."""
    return f"#define TRACK(...) {'__VA_ARGS__' if track else ''}\n{code}\n#undef TRACK\n"


@wp.func_native(_tracked(VECTORS + _BIN + _FORWARD, False))
def _blend_bin(
    bin: int, width: int, height: int, across: int, step: int, mean: int, splats: wp.array[float],
    members: wp.array[int], starts: wp.array[int], behind: wp.array[float], left: wp.array[float],
    stops: wp.array[int], ends: wp.array[int], rgb: wp.array[float], fourth: wp.array[float], alphas: wp.array[float],
): ...  # fmt: skip


@wp.kernel
def _blend(
    start: int, piece: int, n: int, width: int, height: int, across: int, step: int, mean: int,
    splats: wp.array[float], members: wp.array[int], starts: wp.array[int], behind: wp.array[float],
    left: wp.array[float], stops: wp.array[int], ends: wp.array[int],
    rgb: wp.array[float], fourth: wp.array[float], alphas: wp.array[float],
):  # fmt: skip
    _blend_bin(start + wp.tid(), width, height, across, step, mean, splats, members, starts, behind,
               left, stops, ends, rgb, fourth, alphas)  # fmt: skip


@wp.func_native(_tracked(VECTORS + _BIN + _FORWARD, True))
def _heaviest_bin(
    bin: int, piece: int, n: int, width: int, height: int, across: int, step: int, mean: int, splats: wp.array[float],
    members: wp.array[int], starts: wp.array[int], behind: wp.array[float], left: wp.array[float],
    stops: wp.array[int], ends: wp.array[int], rgb: wp.array[float], fourth: wp.array[float], alphas: wp.array[float],
    index: wp.array[int], totals: wp.array[float],
): ...  # fmt: skip


@wp.kernel
def _heaviest(
    start: int, piece: int, n: int, width: int, height: int, across: int, step: int, mean: int,
    splats: wp.array[float], members: wp.array[int], starts: wp.array[int], behind: wp.array[float],
    left: wp.array[float], stops: wp.array[int], ends: wp.array[int],
    rgb: wp.array[float], fourth: wp.array[float], alphas: wp.array[float],
    index: wp.array[int], totals: wp.array[float],
):  # fmt: skip
    _heaviest_bin(start + wp.tid(), piece, n, width, height, across, step, mean, splats, members, starts, behind,
                  left, stops, ends, rgb, fourth, alphas, index, totals)  # fmt: skip


@wp.func_native(VECTORS + SUMS + _BIN + _BACKWARD)
def _unblend_bin(
    bin: int, first: bool, piece: int, n: int, width: int, height: int, across: int, step: int, mean: int,
    splats: wp.array[float], members: wp.array[int], starts: wp.array[int], behind: wp.array[float],
    left: wp.array[float], stops: wp.array[int], ends: wp.array[int], fourth: wp.array[float], alphas: wp.array[float],
    v_rgb: wp.array[float], v_fourth: wp.array[float], v_alphas: wp.array[float], moments: wp.array[float],
): ...  # fmt: skip


@wp.kernel
def _blend_adjoint(
    start: int, piece: int, n: int, width: int, height: int, across: int, step: int, mean: int,
    splats: wp.array[float], members: wp.array[int], starts: wp.array[int], behind: wp.array[float],
    left: wp.array[float], stops: wp.array[int], ends: wp.array[int], fourth: wp.array[float], alphas: wp.array[float],
    v_rgb: wp.array[float], v_fourth: wp.array[float], v_alphas: wp.array[float], moments: wp.array[float],
):  # fmt: skip
    _unblend_bin(start + wp.tid(), wp.tid() == 0, piece, n, width, height, across, step, mean, splats, members,
                 starts, behind, left, stops, ends, fourth, alphas, v_rgb, v_fourth, v_alphas, moments)  # fmt: skip


@wp.func_native(VECTORS + _GRADIENT)
def _gradient_row(
    i: int, n: int, pieces: int, splats: wp.array[float], moments: wp.array[float], grads: wp.array[float]
): ...


@wp.kernel
def _gradients(
    start: int, piece: int, n: int, pieces: int, splats: wp.array[float], moments: wp.array[float],
    grads: wp.array[float],
):  # fmt: skip
    _gradient_row(start + wp.tid(), n, pieces, splats, moments, grads)


def _outputs(bins: Bins) -> tuple[Tensor, ...]:
    """Empty tensors for what a forward pass leaves for the backward pass, and for its images."""
    count, size = len(bins.starts) - 1, (bins.height, bins.width)
    left, stops = torch.empty(count * PIXELS), torch.empty(count * PIXELS, dtype=torch.int32)
    ends = torch.empty(count, dtype=torch.int32)
    return left, stops, ends, torch.empty(*size, 3), torch.empty(size), torch.empty(size)


def _walk(splats: Tensor, bins: Bins, behind: Tensor, mean: bool, *tensors: Tensor) -> list:
    """Kernel arguments from the number of splats on."""
    flat = (splats, bins.members, bins.starts, behind, *tensors)
    step = 0 if behind.dim() == 1 else 3
    views = (view(t.view(-1)) for t in flat)
    return [len(splats), bins.width, bins.height, bins.across, step, int(mean), *views]


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, splats, bins, behind, mean):
        state = _outputs(bins)
        run(_blend, bins.pieces(4 * parts()), _walk(splats, bins, behind, mean, *state))
        left, stops, ends, rgb, fourth, alpha = state
        ctx.save_for_backward(splats, behind, left, stops, ends, fourth, alpha)
        ctx.bins, ctx.mean = bins, mean
        return rgb, fourth, alpha

    @staticmethod
    def backward(ctx, *upstream):
        splats, behind, *state = ctx.saved_tensors
        bins, n, ends = ctx.bins, len(splats), state[2]
        bounds = bins.pieces(parts(), ends - bins.starts[:-1])
        moments, grads = torch.empty(len(bounds) - 1, n, WIDTH), torch.empty(n, WIDTH)
        upstream = [v.float().contiguous() for v in upstream]
        run(_blend_adjoint, bounds, _walk(splats, bins, behind, ctx.mean, *state, *upstream, moments))
        tables = [view(t.view(-1)) for t in (splats, moments, grads)]
        run(_gradients, even(n, parts()), [n, len(moments), *tables])
        return grads, None, None, None


def blend(splats: Tensor, bins: Bins, behind: Tensor | None = None, mean: bool = False):
    """Image (h, w, 3), fourth channel (h, w) and alpha (h, w) of splats (n, 16). Differentiable in the splats.

    `behind` is a background colour (3,) or picture (h, w, 3), black when None. The fourth channel is a composite like
    the others or, with `mean`, the mean over what is seen. In the splats' gradient, columns 10 and 11 hold the sums
    over pixels of the absolute gradients of the centre, which densification wants: the plain ones cancel where a
    splat is too large for the detail it covers.
    Source: Kerbl et al. 2023; Ye et al. 2024, "AbsGS", eq. 8.
    """
    behind = torch.zeros(3) if behind is None else behind.float().contiguous()
    return _Blend.apply(splats.contiguous(), bins, behind, mean)


def heaviest(splats: Tensor, bins: Bins) -> tuple[Tensor, Tensor]:
    """For every pixel the splat with the greatest weight (h, w; -1: none), for every splat its total weight (n,)."""
    bounds = bins.pieces(parts())
    index, totals = torch.empty(bins.height, bins.width, dtype=torch.int32), torch.zeros(len(bounds) - 1, len(splats))
    run(_heaviest, bounds, _walk(splats, bins, torch.zeros(3), False, *_outputs(bins), index, totals))
    return index.long(), totals.sum(0)


def blend_reference(splats: Tensor, order: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Image, fourth channel, alpha as `blend`, and the weights (h, w, m) of the splats in the given order, near to far.

    Plain PyTorch, every splat at every pixel: for small scenes, in any precision.
    """
    s = splats[order]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx, dy = x.to(s)[..., None] - s[:, 0], y.to(s)[..., None] - s[:, 1]
    sigma = 0.5 * (s[:, 2] * dx * dx + s[:, 4] * dy * dy) + s[:, 3] * dx * dy
    alpha = (s[:, 5] * torch.exp(-sigma)).clamp_max(SOLID)
    alpha = torch.where(alpha >= FAINTEST, alpha, torch.zeros_like(alpha))
    drawn = (1 - alpha).cumprod(-1) > CLOSED  # once false, false for all that follow
    alpha = torch.where(drawn, alpha, torch.zeros_like(alpha))
    T = (1 - alpha).cumprod(-1)
    weight = alpha * torch.cat([torch.ones_like(T[..., :1]), T[..., :-1]], -1)
    return weight @ s[:, 6:9], weight @ s[:, 9], weight.sum(-1), weight
