"""Front-to-back alpha compositing of splats in tiles on CUDA, and its adjoint: one thread block per tile.

Each warp renders 8 x 4 pixels, and skips splats whose bounding box does not reach these pixels. The adjoint sums over
the pixels of a tile by warp shuffles and shared memory, writes one row per slot, and then sums each splat's rows. It
uses no atomics, so the result does not depend on the order of execution.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import device_of, launch, view, with_arrays
from stages.core.kernels.simd import by_device
from stages.core.kernels.splat.canvas import Canvas, ImageGradients, canvas_over, image_gradients
from stages.core.kernels.splat.pixel_blocks import MAX_ALPHA, MIN_MEAN_ALPHA, MIN_TRANSMITTANCE
from stages.core.kernels.splat.projection import SPLAT_SIZE, TILE_SIZE, SplatGradients
from stages.core.kernels.splat.tiles import SlotRanges, TiledSplats, Tiles

wp.set_module_options({"enable_backward": False})

THREADS = TILE_SIZE * TILE_SIZE
MOMENTS = 12  # number of sums over pixels for each slot, see `_BACKWARD`

# The thread's pixel, and a test whether a splat at x, y with bounding box half sizes rx, ry reaches its warp's pixels.
_PIXEL = r"""
const int t = threadIdx.x, warp = t >> 5, lane = t & 31;
const int width = canvas.alpha.shape[1], height = canvas.alpha.shape[0], across = (width + 15) / 16;
const int X = (tile % across) * 16 + (warp & 1) * 8, Y = (tile / across) * 16 + (warp >> 1) * 4;
const int px = X + (lane & 7), py = Y + (lane >> 3), pixel = py * width + px;
const bool inside = px < width && py < height;
const float fx = px + 0.5f, fy = py + 0.5f;
const int begin = tiles.starts.data[tile], end = tiles.starts.data[tile + 1];
const int step = canvas.behind.shape[0] == 3 ? 0 : 3;
auto reaches = [X, Y](float4 box) {
    return box.x + box.z >= X + 0.5f && box.x - box.z <= X + 7.5f && box.y + box.w >= Y + 0.5f
        && box.y - box.w <= Y + 3.5f;
};
"""

# Copies of a batch of splats in shared memory: box (centre, half width and height), log2 alpha as a quadratic form, and
# colour.
_LOAD = r"""
__shared__ float4 box[BATCH], form[BATCH], colour[BATCH];
auto load = [&](int at, int k) {
    const float4* s = (const float4*)(tiles.splats.data + 16 * (long long)tiles.ids.data[tiles.slots.data[k]]);
    const float4 a = s[0], b = s[1], c = s[2];
    box[at] = make_float4(a.x, a.y, c.w, s[3].x);
    form[at] = make_float4(-0.721347520f * a.z, -1.44269504f * a.w, -0.721347520f * b.x, c.z);
    colour[at] = make_float4(b.z, b.w, c.x, c.y);
};
auto log2_alpha = [&](int j, float dx, float dy) {
    const float4 q = form[j];
    return fmaf(dx, fmaf(q.x, dx, q.y * dy), fmaf(q.z * dy, dy, q.w));
};
"""

_FORWARD = r"""
float T = 1, r = 0, g = 0, b = 0, z = 0, best = 0;
int stop = end, which = -1;
bool done = !inside;
for (int base = begin; base < end; base += 256) {
    if (__syncthreads_count(done) == 256) break;  // also: the batch before is no longer read
    if (base + t < end) load(t, base + t);
    __syncthreads();
    const int count = end - base < 256 ? end - base : 256;
    for (int j = 0; j < count && !done; ++j) {
        const float4 at = box[j];
        if (!reaches(at)) continue;
        const float power = log2_alpha(j, fx - at.x, fy - at.y);
        if (power < -7.99435344f) continue;
        const float alpha = fminf(exp2f(power), MAX_ALPHA), next = T - alpha * T;
        if (next <= MIN_TRANSMITTANCE) {
            done = true;
            stop = base + j;
            break;
        }
        const float w = alpha * T;
        const float4 c = colour[j];
        r = fmaf(w, c.x, r); g = fmaf(w, c.y, g); b = fmaf(w, c.z, b); z = fmaf(w, c.w, z);
        if (w > best) { best = w; which = base + j; }
        T = next;
    }
}
if (inside) {
    const float alpha = 1 - T;
    const float* behind_pixel = canvas.behind.data + step * (long long)pixel;
    canvas.rgb.data[3 * pixel] = r + T * behind_pixel[0];
    canvas.rgb.data[3 * pixel + 1] = g + T * behind_pixel[1];
    canvas.rgb.data[3 * pixel + 2] = b + T * behind_pixel[2];
    canvas.fourth.data[pixel] = canvas.mean ? z / fmaxf(alpha, MIN_MEAN_ALPHA) : z;
    canvas.alpha.data[pixel] = alpha;
    canvas.left.data[pixel] = T;
    canvas.stops.data[pixel] = stop;
    dominant.data[pixel] = which < 0 ? -1 : tiles.ids.data[tiles.slots.data[which]];
}
"""

# As in `compositing_adjoint`: dL/dalpha = T (colour . v) - S / (1 - alpha), where S is the contribution from behind.
# Moments of a slot: g dx, g dy, g dx^2, g dx dy, g dy^2, g with g = dL/dlog(alpha); four channels; absolute sums.
_BACKWARD = r"""
#define EXCHANGE(half, bit) _Pragma("unroll") for (int i = 0; i < half; ++i) { \
    const bool upper = lane & bit; \
    const float sent = upper ? sum[i] : sum[i + half], kept = upper ? sum[i + half] : sum[i]; \
    sum[i] = kept + __shfl_xor_sync(0xffffffff, sent, bit); \
}
__shared__ float4 conic[32];
__shared__ int slot[32], last;
__shared__ float part[32][8][12];
float T = 1, S = 0, v[4] = {0, 0, 0, 0};
int stop = begin;
if (inside) {
    T = canvas.left.data[pixel];
    stop = canvas.stops.data[pixel];
    const float* behind_pixel = canvas.behind.data + step * (long long)pixel;
    float v_alpha = upstream.alpha.data[pixel];
    for (int c = 0; c < 3; ++c) {
        v[c] = upstream.rgb.data[3 * pixel + c];
        v_alpha -= v[c] * behind_pixel[c];
    }
    v[3] = upstream.fourth.data[pixel];
    if (canvas.mean) {
        v[3] = canvas.alpha.data[pixel] > MIN_MEAN_ALPHA ? v[3] / canvas.alpha.data[pixel] : 0;
        v_alpha -= v[3] * canvas.fourth.data[pixel];
    }
    S = -v_alpha * T;
}
if (t == 0) last = begin;
__syncthreads();
atomicMax(&last, stop);
__syncthreads();
for (int i = t; i < 12 * (end - last); i += 256)  // members that no pixel reached
    moments.data[12 * tiles.slots.data[last + i / 12] + i % 12] = 0;
for (int top = last; top > begin; top -= 32) {
    const int count = top - begin < 32 ? top - begin : 32;  // members top - 1, top - 2, ...
    __syncthreads();
    if (t < count) {
        const int k = top - 1 - t;
        load(t, k);
        slot[t] = (int)tiles.slots.data[k];
        const float* s = tiles.splats.data + 16 * (long long)tiles.ids.data[slot[t]];
        conic[t] = make_float4(s[2], s[3], s[4], 0);
    }
    for (int i = t; i < count * 96; i += 256) ((float*)part)[i] = 0;
    __syncthreads();
    for (int j = 0; j < count; ++j) {
        const float4 at = box[j];
        if (!reaches(at)) continue;  // the same for all threads of the warp
        const float dx = fx - at.x, dy = fy - at.y, power = log2_alpha(j, dx, dy);
        const bool hit = top - 1 - j < stop && power >= -7.99435344f;
        if (!__any_sync(0xffffffff, hit)) continue;
        float sum[16] = {0};
        if (hit) {
            const float raw = exp2f(power), alpha = fminf(raw, MAX_ALPHA), open = 1 / (1 - alpha);
            const float before = T * open, w = alpha * before;
            const float4 c = colour[j], k = conic[j];
            const float v_weight = fmaf(v[3], c.w, fmaf(v[2], c.z, fmaf(v[1], c.y, v[0] * c.x)));
            const float g = raw <= MAX_ALPHA ? alpha * (before * v_weight - S * open) : 0;
            T = before;
            S = fmaf(w, v_weight, S);
            const float gx = g * dx, gy = g * dy;
            sum[0] = gx; sum[1] = gy; sum[2] = gx * dx; sum[3] = gx * dy; sum[4] = gy * dy; sum[5] = g;
            for (int i = 0; i < 4; ++i) sum[6 + i] = w * v[i];
            sum[10] = fabsf(k.x * gx + k.y * gy);
            sum[11] = fabsf(k.y * gx + k.z * gy);
        }
        // lanes exchange half of their values at each step: lane l ends up with the sum of value l / 2
        EXCHANGE(8, 16)
        EXCHANGE(4, 8)
        EXCHANGE(2, 4)
        EXCHANGE(1, 2)
        sum[0] += __shfl_xor_sync(0xffffffff, sum[0], 1);
        if (!(lane & 1) && lane < 24) part[j][warp][lane >> 1] = sum[0];
    }
    __syncthreads();
    for (int i = t; i < count * 12; i += 256) {
        float total = 0;
        for (int w = 0; w < 8; ++w) total += part[i / 12][w][i % 12];
        moments.data[12 * (long long)slot[i / 12] + i % 12] = total;
    }
}
#undef EXCHANGE
"""

# Sums a splat's slots with 16 threads per splat, and converts the sums to the gradient of its row.
_GRADIENT = r"""
const int r = at / 16, c = at % 16, id = (int)order.ids.data[r];
const int end = order.ends.data[r], to = end < moments.shape[0] ? end : moments.shape[0];
int slot = end - order.counts.data[r];
float m = 0;
if (c < 12)
    for (; slot < to; ++slot) m += moments.data[12 * (long long)slot + c];
const float x = __shfl_sync(0xffffffff, m, 0, 16), y = __shfl_sync(0xffffffff, m, 1, 16);
const float* s = rows.splats.data + 16 * (long long)id;
if (c == 0) m = s[2] * x + s[3] * y;
if (c == 1) m = s[3] * x + s[4] * y;
if (c == 2 || c == 4) m *= -0.5f;
if (c == 3) m = -m;
if (c == 5) m = s[5] > 0 ? m / s[5] : 0;
rows.grads.data[16 * (long long)id + c] = m;
"""


def _on_cuda(code: str, batch: int = 0) -> str:
    """Insert constants into a snippet, and compile it for CUDA only."""
    constants = {"MAX_ALPHA": MAX_ALPHA, "MIN_TRANSMITTANCE": MIN_TRANSMITTANCE, "MIN_MEAN_ALPHA": MIN_MEAN_ALPHA}
    for name, value in constants.items():
        code = code.replace(name, f"{value}f")
    return by_device(code.replace("BATCH", str(batch)), "")


@wp.func_native(_on_cuda(_PIXEL + _LOAD + _FORWARD, batch=256))
def _draw_pixel(tile: int, tiles: TiledSplats, canvas: Canvas, dominant: wp.array2d[int]): ...


@wp.kernel
def _composite(tiles: TiledSplats, canvas: Canvas, dominant: wp.array2d[int]):
    _draw_pixel(wp.tid() // wp.static(THREADS), tiles, canvas, dominant)


@wp.func_native(_on_cuda(_PIXEL + _LOAD + _BACKWARD, batch=32))
def _adjoint_of_pixel(
    tile: int, tiles: TiledSplats, canvas: Canvas, upstream: ImageGradients, moments: wp.array2d[float]
): ...  # fmt: skip


@wp.kernel
def _composite_adjoint(tiles: TiledSplats, canvas: Canvas, upstream: ImageGradients, moments: wp.array2d[float]):
    _adjoint_of_pixel(wp.tid() // wp.static(THREADS), tiles, canvas, upstream, moments)


@wp.func_native(_on_cuda(_GRADIENT))
def _gradient_value(at: int, order: SlotRanges, moments: wp.array2d[float], rows: SplatGradients): ...


@wp.kernel
def _gradients(order: SlotRanges, moments: wp.array2d[float], rows: SplatGradients):
    _gradient_value(wp.tid(), order, moments, rows)


def _launch(kernel: wp.Kernel, splats: Tensor, tiles: Tiles, inputs: list) -> None:
    """Launch a kernel with one thread block per tile."""
    count = THREADS * (len(tiles.starts) - 1)
    launch(kernel, count, [tiles.of(splats), *inputs], device=device_of(splats), block_dim=THREADS)


def draw(
    splats: Tensor, tiles: Tiles, behind: Tensor, mean: bool
) -> tuple[tuple[Tensor, ...], tuple[Tensor, Tensor], Tensor]:
    """Composite splats; arguments as for `compositing.composite`.

    Returns the images (rgb (h, w, 3), fourth channel and alpha (h, w)), the state of each pixel (final transmittance
    and position at which it was finished, both (h * w,)), and the splat with the largest weight (h, w; -1: none).
    """
    new, size = splats.new_empty, (tiles.height, tiles.width)
    rgb, fourth, alpha, dominant = new(*size, 3), new(size), new(size), new(size, dtype=torch.int32)
    left, stops = new(alpha.numel()), new(alpha.numel(), dtype=torch.int32)
    canvas = canvas_over(behind, mean, rgb=rgb, fourth=fourth, alpha=alpha, left=left, stops=stops)
    _launch(_composite, splats, tiles, [canvas, view(dominant)])
    return (rgb, fourth, alpha), (left, stops), dominant


def draw_adjoint(splats: Tensor, tiles: Tiles, canvas: Canvas, upstream: ImageGradients) -> Tensor:
    """Return the gradient (n, 16) of the splats; `canvas` is in the state after `draw`."""
    moments, grads = splats.new_empty(len(tiles.slots), MOMENTS), torch.empty_like(splats)
    _launch(_composite_adjoint, splats, tiles, [canvas, upstream, view(moments)])
    rows = with_arrays(SplatGradients(), {"splats": splats, "grads": grads})
    launch(_gradients, len(splats) * SPLAT_SIZE, [tiles.order, view(moments), rows], device=device_of(splats))
    return grads


def composite_with_dominant(splats: Tensor, tiles: Tiles) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`compositing.composite_with_dominant` for splats and tiles on a CUDA device.

    The total weight of a splat is computed as the derivative of the sum of a colour channel over all pixels with
    respect to the splat's colour.
    """
    behind = splats.new_zeros(3)
    (rgb, fourth, alpha), (left, stops), dominant = draw(splats, tiles, behind, True)
    canvas = canvas_over(behind, True, fourth=fourth, alpha=alpha, left=left, stops=stops)
    v_rgb = torch.zeros_like(rgb)
    v_rgb[..., 0] = 1
    none = torch.zeros_like(alpha)
    grads = draw_adjoint(splats, tiles, canvas, image_gradients(v_rgb, none, none))
    return rgb, fourth, alpha, dominant.long(), grads[:, 6].contiguous()
