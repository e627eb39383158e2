"""Adjoint of compositing: the splats of each bin back to front, 16 pixels at a time.

Written out by hand, since Warp's automatic adjoint of such a loop is wrong.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import view
from stages.core.kernels.splat.binning import Bins
from stages.core.kernels.splat.pixel_blocks import BIN_BLOCKS, MAX_ALPHA, MIN_MEAN_ALPHA
from stages.core.kernels.splat.projection import SPLAT_SIZE
from stages.core.kernels.splat.simd import LANE_SUMS, VECTORS, launch_ranges, num_threads
from stages.core.kernels.threads import small_operations

wp.set_module_options({"enable_backward": False})

# dL/dalpha = T (colour . v) - S / (1 - alpha), where S is the contribution from behind: the sum of w (colour . v) over
# the later splats, minus T_end v_alpha. Sums over the pixels of a bin are stored as moments of d, a row for each pair
# of bin and splat; after all bins they are added up and converted to gradients of centre and covariance.
_BACKWARD = r"""
F T[BLOCKS], S[BLOCKS], v[BLOCKS][4];
I stop[BLOCKS];  // index of the splat at which a pixel finished
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
            v4 = alphas.data[p] > MIN_MEAN_ALPHA ? v4 / alphas.data[p] : 0;
            va -= v4 * fourth.data[p];
        }
        v[b][3][l] = v4;
        v_alpha[l] = va;
    }
    S[b] = -v_alpha * T[b];
}
for (int k = ends.data[bin]; k < starts.data[bin + 1]; ++k) store(moments.data + 16 * (long)slots.data[k], none);
for (int k = ends.data[bin] - 1; k >= begin; --k) {
    __builtin_prefetch(splats.data + 16 * (long)members.data[k - 8 > begin ? k - 8 : begin]);
    const int id = members.data[k];
    const float* s = splats.data + 16 * (long)id;
    const float x = s[0] - X, y = s[1] - Y;
    const float A = -0.721347520f * s[2], B = -1.44269504f * s[3], C = -0.721347520f * s[4], lo = s[10];
    F sum[16];
    for (int i = 0; i < 16; ++i) sum[i] = none;
    bool any = false;
    for (unsigned long long todo = overlapped(x, y, s[11], s[12]); todo; todo &= todo - 1) {
        const int b = __builtin_ctzll(todo);
        if (k >= last[b]) continue;
        F dx = lx + (4 * (b & 7) - x), dy = ly + (4 * (b >> 3) - y);
        F power = fma(dx, fma((F)(A), dx, B * dy), fma(C * dy, dy, (F)(lo)));
        I hit = (power >= -7.99435344f) & (k < stop[b]);
        if (!bits(hit)) continue;
        any = true;
        F raw = exp2v(power), alpha = hit ? vmin(raw, (F)(MAX_ALPHA)) : none;
        F open = 1.0f / (1.0f - alpha);
        F t = T[b] * open, w = alpha * t, v_weight = none;
        for (int c = 0; c < 4; ++c) {
            v_weight = fma(v[b][c], (F)(s[6 + c]), v_weight);
            sum[6 + c] = fma(w, v[b][c], sum[6 + c]);
        }
        F g = raw <= MAX_ALPHA ? alpha * (t * v_weight - S[b] * open) : none;  // dL/dlog(alpha)
        T[b] = t;
        S[b] = fma(w, v_weight, S[b]);
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
    store(moments.data + 16 * (long)slots.data[k], any ? sums(sum) : none);
}
""".replace("MAX_ALPHA", f"{MAX_ALPHA}f").replace("MIN_MEAN_ALPHA", f"{MIN_MEAN_ALPHA}f")

# Sum the moments of each splat over its bins, which have consecutive slots, and convert them to the gradient of the
# splat's row. The order of the sum does not depend on the number of threads.
_GRADIENT = r"""
long slot = firsts.data[piece];
for (int i = bounds.data[piece], end = bounds.data[piece + 1]; i < end; ++i) {
    const int id = order.data[i], later = order.data[i + 16 < end ? i + 16 : i];
    __builtin_prefetch(rects.data + 4 * (long)later);
    __builtin_prefetch(splats.data + 16 * (long)later);
    __builtin_prefetch(grads.data + 16 * (long)later, 1);
    const short* r = rects.data + 4 * (long)id;
    F m = (F)(0.0f);
    for (const long last = slot + (r[2] - r[0] + 1) * (r[3] - r[1] + 1); slot < last; ++slot)
        m += load(moments.data + 16 * slot);
    const float* s = splats.data + 16 * (long)id;
    F g = m;
    g[0] = s[2] * m[0] + s[3] * m[1];
    g[1] = s[3] * m[0] + s[4] * m[1];
    g[2] = -0.5f * m[2];
    g[3] = -m[3];
    g[4] = -0.5f * m[4];
    g[5] = s[5] > 0 ? m[5] / s[5] : 0.0f;
    store(grads.data + 16 * (long)id, g);
}
"""


@wp.func_native(VECTORS + LANE_SUMS + BIN_BLOCKS + _BACKWARD)
def _adjoint_of_bin(
    bin: int, width: int, height: int, across: int, step: int, mean: int,
    splats: wp.array[float], members: wp.array[int], starts: wp.array[int], behind: wp.array[float],
    left: wp.array[float], stops: wp.array[int], ends: wp.array[int], fourth: wp.array[float], alphas: wp.array[float],
    v_rgb: wp.array[float], v_fourth: wp.array[float], v_alphas: wp.array[float],
    slots: wp.array[int], moments: wp.array[float],
): ...  # fmt: skip


@wp.kernel
def _composite_adjoint(
    start: int, piece: int, width: int, height: int, across: int, step: int, mean: int,
    splats: wp.array[float], members: wp.array[int], starts: wp.array[int], behind: wp.array[float],
    left: wp.array[float], stops: wp.array[int], ends: wp.array[int], fourth: wp.array[float], alphas: wp.array[float],
    v_rgb: wp.array[float], v_fourth: wp.array[float], v_alphas: wp.array[float],
    slots: wp.array[int], moments: wp.array[float],
):  # fmt: skip
    _adjoint_of_bin(start + wp.tid(), width, height, across, step, mean, splats, members, starts, behind,
                    left, stops, ends, fourth, alphas, v_rgb, v_fourth, v_alphas, slots, moments)  # fmt: skip


@wp.func_native(VECTORS + _GRADIENT)
def _gradient_rows(
    piece: int, bounds: wp.array[int], firsts: wp.array[int], order: wp.array[int], rects: wp.array[wp.int16],
    splats: wp.array[float], moments: wp.array[float], grads: wp.array[float],
): ...  # fmt: skip


@wp.kernel
def _gradients(
    start: int, piece: int, bounds: wp.array[int], firsts: wp.array[int], order: wp.array[int],
    rects: wp.array[wp.int16], splats: wp.array[float], moments: wp.array[float], grads: wp.array[float],
):  # fmt: skip
    _gradient_rows(piece, bounds, firsts, order, rects, splats, moments, grads)


def composite_adjoint(splats: Tensor, bins: Bins, ends: Tensor, arguments: list) -> Tensor:
    """Gradient (n, 16) of the splats.

    `ends` (bins,): index of the member at which each bin's forward pass stopped. `arguments`: of the kernel, from the
    width on: those of the forward pass, its saved state, and the upstream gradients.
    """
    bounds = bins.balanced_bounds(4 * num_threads(), ends - bins.starts[:-1])
    moments = torch.empty(len(bins.members), SPLAT_SIZE)
    with small_operations():  # waking a second thread takes longer than writing zeros
        grads = torch.zeros(len(splats), SPLAT_SIZE)
    launch_ranges(_composite_adjoint, bounds, [*arguments, view(bins.slots), view(moments.view(-1))])
    flat = [view(t.view(-1)) for t in (bins.bounds, bins.firsts, bins.order, bins.rects, splats, moments, grads)]
    launch_ranges(_gradients, list(range(len(bins.bounds))), flat)
    return grads
