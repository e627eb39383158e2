"""Structural similarity (SSIM) of two images and its gradient.

Definition: Gaussian window of 11 x 11 pixels with sigma 1.5 and weights that sum to 1; images are zero-padded by 5
pixels, and the mean is over all pixels and channels, as in the loss of 3D Gaussian splatting.
`stages.evaluate.images.ssim` instead averages over the windows that lie inside the image (no padding), so the values of
the two are not comparable.

The window is separable and the channels are interleaved, so both passes are sums of shifted rows: down the columns of
the images into a scratch line, then along that line.
"""

from __future__ import annotations

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from stages.core.kernels.interop import view
from stages.core.kernels.simd import LANES, VECTORS, even_bounds, launch_ranges, num_threads
from stages.core.kernels.splat import ssim_pixel
from stages.core.kernels.splat.ssim_pixel import C1, C2, WINDOW, WINDOW_RADIUS, ImagePair, image_pair

wp.set_module_options({"enable_backward": False})

# Applies the window down the columns at every element of row i, then along the row; COUNT maps at once.
_ROWS = r"""
const float window[11] = {WINDOW};
const float *first = images.first.data, *second = images.second.data;
const int height = images.first.shape[0], channels = images.channels, width = images.first.shape[1] / channels;
const int size = width * channels, line = size + 10 * channels + 16;  // size as a product: faster code
float* scratch = lines.data + (long)piece * COUNT * line;
const int top = i < 5 ? 5 - i : 0, bottom = i + 5 < height ? 10 : height - 1 - i + 5;
auto some = [&](const float* p, int count) {
    if (count >= 16) return load(p);
    F v = (F)(0.0f);
    for (int l = 0; l < count; ++l) v[l] = p[l];
    return v;
};
auto put = [&](float* p, F v, int count) {
    if (count >= 16) return store(p, v);
    for (int l = 0; l < count; ++l) p[l] = v[l];
};
auto along = [&](F* sum, int j) {
    for (int m = 0; m < COUNT; ++m) {
        sum[m] = (F)(0.0f);
        for (int t = 0; t < 11; ++t) sum[m] += window[t] * load(scratch + m * line + j + t * channels);
    }
};
auto clear = [&]() {
    for (int m = 0; m < COUNT; ++m) {
        float* row = scratch + m * line;
        for (int j = 0; j < 5 * channels; ++j) row[j] = 0;
        for (int j = 5 * channels + size; j < line; ++j) row[j] = 0;
    }
};
""".replace("WINDOW", ", ".join(f"{weight!r}f" for weight in WINDOW))

# Computes means, variances and covariance, then SSIM and its derivatives with respect to the mean and variance of the
# first image and to the covariance.
_FORWARD = r"""
for (int j = 0; j < size; j += 16) {
    F sum[5];
    for (int m = 0; m < 5; ++m) sum[m] = (F)(0.0f);
    for (int t = top; t <= bottom; ++t) {
        const long at = (long)(i + t - 5) * size + j;
        F x = some(first + at, size - j), y = some(second + at, size - j);
        F wx = window[t] * x, wy = window[t] * y;
        sum[0] += wx; sum[1] += wy; sum[2] += wx * x; sum[3] += wy * y; sum[4] += wx * y;
    }
    for (int m = 0; m < 5; ++m) store(scratch + m * line + 5 * channels + j, sum[m]);
}
clear();
double total = 0;
for (int j = 0; j < size; j += 16) {
    F e[5];
    along(e, j);
    F mx = e[0], my = e[1];
    F a1 = 2 * mx * my + C1, b1 = mx * mx + my * my + C1;
    F a2 = 2 * (e[4] - mx * my) + C2, b2 = (e[2] - mx * mx) + (e[3] - my * my) + C2;
    F ib = 1.0f / (b1 * b2), s = a1 * a2 * ib;
    F by_cov = 2 * a1 * ib, by_var = -s / b2;
    F by_mean = 2 * my * a2 * ib - 2 * mx * s / b1 - 2 * mx * by_var - my * by_cov;
    const int count = size - j < 16 ? size - j : 16;
    for (int l = 0; l < count; ++l) total += s[l];
    const long at = (long)i * size + j, all = (long)height * size;
    put(derivatives.data + at, by_mean, count);
    put(derivatives.data + all + at, by_var, count);
    put(derivatives.data + 2 * all + at, by_cov, count);
}
totals.data[i] = total;
""".replace("C1", f"{C1}f").replace("C2", f"{C2}f")

# Chain rule to the first image, with a window weight w: d mean = w, d variance = 2 w x, d covariance = w y.
_BACKWARD = r"""
const long all = (long)height * size;
for (int j = 0; j < size; j += 16)
    for (int m = 0; m < 3; ++m) {
        F sum = (F)(0.0f);
        for (int t = top; t <= bottom; ++t)
            sum += window[t] * some(derivatives.data + m * all + (long)(i + t - 5) * size + j, size - j);
        store(scratch + m * line + 5 * channels + j, sum);
    }
clear();
for (int j = 0; j < size; j += 16) {
    F e[3];
    along(e, j);
    const long at = (long)i * size + j;
    F x = some(first + at, size - j), y = some(second + at, size - j);
    put(grads.data + at, e[0] + 2 * x * e[1] + y * e[2], size - j);
}
"""


@wp.func_native(VECTORS + _ROWS.replace("COUNT", "5") + _FORWARD)
def _ssim_row(
    i: int, piece: int, images: ImagePair, lines: wp.array[float], derivatives: wp.array[float],
    totals: wp.array[wp.float64],
): ...  # fmt: skip


@wp.kernel
def _similarity(
    start: int, piece: int, images: ImagePair, lines: wp.array[float], derivatives: wp.array[float],
    totals: wp.array[wp.float64],
):  # fmt: skip
    _ssim_row(start + wp.tid(), piece, images, lines, derivatives, totals)


@wp.func_native(VECTORS + _ROWS.replace("COUNT", "3") + _BACKWARD)
def _gradient_row(
    i: int, piece: int, images: ImagePair, lines: wp.array[float], derivatives: wp.array[float], grads: wp.array[float]
): ...  # fmt: skip


@wp.kernel
def _gradient(
    start: int, piece: int, images: ImagePair, lines: wp.array[float], derivatives: wp.array[float],
    grads: wp.array[float],
):  # fmt: skip
    _gradient_row(start + wp.tid(), piece, images, lines, derivatives, grads)


def _forward(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean SSIM, and the derivatives (3, h, w, c) of the SSIM.

    Derivatives are with respect to the mean and variance of the first image, and to the covariance.
    """
    derivatives = torch.empty(3, *first.shape)
    totals = torch.empty(len(first), dtype=torch.float64)
    _launch(_similarity, first, second, 5, derivatives, totals)
    return (totals.sum() / first.numel()).float(), derivatives


def _backward(first: Tensor, second: Tensor, derivatives: Tensor) -> Tensor:
    """Return the gradient of the mean SSIM with respect to the first image."""
    grads = torch.empty_like(first)
    _launch(_gradient, first, second, 3, derivatives, grads)
    return grads / first.numel()


def _launch(kernel: wp.Kernel, first: Tensor, second: Tensor, maps: int, *outputs: Tensor) -> None:
    height, width, channels = first.shape
    pieces = num_threads()
    lines = torch.empty(pieces * maps * (width * channels + 2 * WINDOW_RADIUS * channels + LANES))
    flat = [view(t.view(-1)) for t in (lines, *outputs)]
    launch_ranges(kernel, even_bounds(height, pieces), [image_pair(first, second), *flat])


def _passes(image: Tensor):
    """Return the forward and backward pass for the device of an image."""
    return (_pixel_forward, ssim_pixel.ssim_backward) if image.is_cuda else (_forward, _backward)


def _pixel_forward(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """`_forward` on CUDA; the derivatives have the layout of `ssim_pixel`."""
    ssim_map, derivatives = ssim_pixel.ssim_forward(first, second)
    return ssim_map.mean(), derivatives


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, first, second):
        value, derivatives = _passes(first)[0](first, second)
        ctx.save_for_backward(first, second, derivatives)
        return value

    @staticmethod
    def backward(ctx, v):
        first, second, derivatives = ctx.saved_tensors
        forward, backward = _passes(first)
        by_first = v * backward(first, second, derivatives) if ctx.needs_input_grad[0] else None
        by_second = v * backward(second, first, forward(second, first)[1]) if ctx.needs_input_grad[1] else None
        return by_first, by_second


def ssim(first: Float[Tensor, "h w c"], second: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Mean structural similarity of two images with values in 0..1, zero-padded; differentiable in both, at most 1.

    Raises ValueError if the shapes differ.
    Source: Wang et al. 2004, "Image quality assessment", eq. 13, with K1 = 0.01, K2 = 0.03.
    """
    if first.shape != second.shape:
        raise ValueError(f"images of different shape: {tuple(first.shape)} and {tuple(second.shape)}")
    return _Ssim.apply(first.float().contiguous(), second.float().contiguous())


def ssim_reference(first: Float[Tensor, "h w c"], second: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """`ssim` in PyTorch, in any precision."""
    window = torch.tensor(WINDOW, dtype=torch.float64).to(first)
    x, y = first.permute(2, 0, 1)[:, None], second.permute(2, 0, 1)[:, None]

    def blur(image: Tensor) -> Tensor:
        down = torch.nn.functional.conv2d(image, window[None, None, :, None], padding=(WINDOW_RADIUS, 0))
        return torch.nn.functional.conv2d(down, window[None, None, None, :], padding=(0, WINDOW_RADIUS))

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    return ((2 * mx * my + C1) * (2 * cov + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2))).mean()
