"""Adjoint of compositing on the CPU: processes the splats of each bin back to front, 16 pixels at a time.

Written by hand, since Warp's automatic adjoint of such a loop is wrong.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import view, with_arrays
from stages.core.kernels.simd import LANE_SUMS, VECTORS, launch_ranges, num_threads
from stages.core.kernels.splat.binning import BinnedSplats, Bins, SplatOrder
from stages.core.kernels.splat.canvas import Canvas, ImageGradients
from stages.core.kernels.splat.pixel_blocks import BIN_BLOCKS, MAX_ALPHA, MIN_MEAN_ALPHA
from stages.core.kernels.splat.projection import SPLAT_SIZE, SplatGradients
from stages.core.kernels.threads import small_operations

wp.set_module_options({"enable_backward": False})

# dL/dalpha = T (colour . v) - S / (1 - alpha), where S is the contribution of what lies behind: the sum of
# w (colour . v) over the later splats, minus T_end v_alpha. Sums over the pixels of a bin are stored as moments of the
# offset d, one row per pair of bin and splat; after all bins they are summed and converted to gradients of centre and
# covariance.
_BACKWARD = r"""
F T[BLOCKS], S[BLOCKS], v[BLOCKS][4];
I stop[BLOCKS];  // index of the splat at which a pixel finished
int last[BLOCKS];
for (int b = 0; b < BLOCKS; ++b) {
    I in = inside(b);
    F v_alpha = none;
    T[b] = load(canvas.left.data + ((long)bin * BLOCKS + b) * 16);
    __builtin_memcpy(&stop[b], canvas.stops.data + ((long)bin * BLOCKS + b) * 16, 64);
    stop[b] = in ? stop[b] : (I)(0);
    last[b] = __builtin_reduce_max(stop[b]);
    for (int c = 0; c < 4; ++c) v[b][c] = none;
    for (int l = 0; l < 16; ++l) {
        if (!in[l]) continue;
        const int p = pixel(b, l);
        float va = upstream.alpha.data[p], v4 = upstream.fourth.data[p];
        for (int c = 0; c < 3; ++c) {
            v[b][c][l] = upstream.rgb.data[3 * (long)p + c];
            va -= v[b][c][l] * canvas.behind.data[step * p + c];
        }
        if (canvas.mean) {
            v4 = canvas.alpha.data[p] > MIN_MEAN_ALPHA ? v4 / canvas.alpha.data[p] : 0;
            va -= v4 * canvas.fourth.data[p];
        }
        v[b][3][l] = v4;
        v_alpha[l] = va;
    }
    S[b] = -v_alpha * T[b];
}
const int *slots = bins.slots.data, reached = bins.ends.data[bin];
for (int k = reached; k < end; ++k) store(moments.data + 16 * (long)slots[k], none);
for (int k = reached - 1; k >= begin; --k) {
    __builtin_prefetch(splats + 16 * (long)members[k - 8 > begin ? k - 8 : begin]);
    const int id = members[k];
    const float* s = splats + 16 * (long)id;
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
    store(moments.data + 16 * (long)slots[k], any ? sums(sum) : none);
}
""".replace("MAX_ALPHA", f"{MAX_ALPHA}f").replace("MIN_MEAN_ALPHA", f"{MIN_MEAN_ALPHA}f")

# Sums the moments of each splat over its bins, which have consecutive slots, and converts them to the gradient of the
# splat's row. The order of summation does not depend on the number of threads.
_GRADIENT = r"""
long slot = order.firsts.data[piece];
for (int i = order.bounds.data[piece], end = order.bounds.data[piece + 1]; i < end; ++i) {
    const int id = order.ids.data[i], later = order.ids.data[i + 16 < end ? i + 16 : i];
    __builtin_prefetch(order.rects.data + 4 * (long)later);
    __builtin_prefetch(rows.splats.data + 16 * (long)later);
    __builtin_prefetch(rows.grads.data + 16 * (long)later, 1);
    const short* r = order.rects.data + 4 * (long)id;
    F m = (F)(0.0f);
    for (const long last = slot + (r[2] - r[0] + 1) * (r[3] - r[1] + 1); slot < last; ++slot)
        m += load(moments.data + 16 * slot);
    const float* s = rows.splats.data + 16 * (long)id;
    F g = m;
    g[0] = s[2] * m[0] + s[3] * m[1];
    g[1] = s[3] * m[0] + s[4] * m[1];
    g[2] = -0.5f * m[2];
    g[3] = -m[3];
    g[4] = -0.5f * m[4];
    g[5] = s[5] > 0 ? m[5] / s[5] : 0.0f;
    store(rows.grads.data + 16 * (long)id, g);
}
"""


@wp.func_native(VECTORS + LANE_SUMS + BIN_BLOCKS + _BACKWARD)
def _adjoint_of_bin(
    bin: int, bins: BinnedSplats, canvas: Canvas, upstream: ImageGradients, moments: wp.array2d[float]
): ...  # fmt: skip


@wp.kernel
def _composite_adjoint(
    start: int, piece: int, bins: BinnedSplats, canvas: Canvas, upstream: ImageGradients, moments: wp.array2d[float]
):  # fmt: skip
    _adjoint_of_bin(start + wp.tid(), bins, canvas, upstream, moments)


@wp.func_native(VECTORS + _GRADIENT)
def _gradient_rows(piece: int, order: SplatOrder, moments: wp.array2d[float], rows: SplatGradients): ...


@wp.kernel
def _gradients(start: int, piece: int, order: SplatOrder, moments: wp.array2d[float], rows: SplatGradients):
    _gradient_rows(piece, order, moments, rows)


def composite_adjoint(splats: Tensor, bins: Bins, ends: Tensor, canvas: Canvas, upstream: ImageGradients) -> Tensor:
    """Return the gradient (n, 16) of the splats.

    `ends` (bins,) is the index of the member at which the forward pass of each bin stopped; `canvas` is in the state
    after that pass.
    """
    bounds = bins.balanced_bounds(4 * num_threads(), ends - bins.starts[:-1])
    moments = torch.empty(len(bins.members), SPLAT_SIZE)
    with small_operations():  # waking a second thread takes longer than writing zeros
        grads = torch.zeros(len(splats), SPLAT_SIZE)
    launch_ranges(_composite_adjoint, bounds, [bins.of(splats, ends), canvas, upstream, view(moments)])
    rows = with_arrays(SplatGradients(), {"splats": splats, "grads": grads})
    launch_ranges(_gradients, list(range(bins.order.bounds.shape[0])), [bins.order, view(moments), rows])
    return grads
