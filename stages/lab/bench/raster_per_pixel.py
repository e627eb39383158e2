"""Baseline of the rasteriser benchmark: compositing with one thread per pixel, forward and backward.

This is the usual form on GPUs, with tiles of 16 x 16 pixels; compiled for a CPU it is scalar code. Projection and
sorting are ours, so that only compositing differs.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import view, with_arrays
from stages.core.kernels.simd import even_bounds, launch_ranges, num_threads
from stages.core.kernels.splat.binning import BinnedSplats, Bins, bin_splats
from stages.core.kernels.splat.pixel_blocks import MAX_ALPHA, MIN_TRANSMITTANCE
from stages.core.kernels.splat.projection import MIN_ALPHA

wp.set_module_options({"enable_backward": False})
TILE = 16  # side of a tile [px]
GRADIENT_CHANNELS = 10  # channels of a splat with gradients: centre, inverse covariance, opacity, colour, depth


@wp.struct
class FinishedPixels:
    """State of each pixel at the end of the forward pass."""

    left: wp.array2d[float]  # (h, w), transmittance
    ends: wp.array2d[int]  # (h, w), one past the last composited splat in the list of the pixel's tile


@wp.func
def _falloff(splats: wp.array2d[float], s: int, dx: float, dy: float):
    return wp.exp(-0.5 * (splats[s, 2] * dx * dx + splats[s, 4] * dy * dy) - splats[s, 3] * dx * dy)


@wp.func
def _tile(i: int, j: int, width: int) -> int:
    across = (width + wp.static(TILE) - 1) // wp.static(TILE)
    return (i // wp.static(TILE)) * across + j // wp.static(TILE)


@wp.kernel
def _forward(start: int, piece: int, bins: BinnedSplats, image: wp.array2d[wp.vec4], pixels: FinishedPixels):
    p = start + wp.tid()
    width = image.shape[1]
    i, j = p // width, p % width
    bin = _tile(i, j, width)
    T = wp.float32(1.0)
    colour = wp.vec4()
    splats = bins.splats
    k = wp.int32(bins.starts[bin])
    while k < bins.starts[bin + 1]:
        s = bins.members[k]
        alpha = wp.min(splats[s, 5] * _falloff(splats, s, float(j) + 0.5 - splats[s, 0], float(i) + 0.5 - splats[s, 1]),
                       wp.static(MAX_ALPHA))  # fmt: skip
        if alpha >= wp.static(MIN_ALPHA):
            if T * (1.0 - alpha) <= wp.static(MIN_TRANSMITTANCE):
                break
            colour += alpha * T * wp.vec4(splats[s, 6], splats[s, 7], splats[s, 8], splats[s, 9])
            T *= 1.0 - alpha
        k += 1
    image[i, j] = colour
    pixels.left[i, j] = T
    pixels.ends[i, j] = k


@wp.kernel
def _backward(
    start: int, piece: int, bins: BinnedSplats, v_image: wp.array2d[wp.vec4], pixels: FinishedPixels,
    grads: wp.array3d[float],
):  # fmt: skip
    p = start + wp.tid()
    width = v_image.shape[1]
    i, j = p // width, p % width
    bin = _tile(i, j, width)
    T = wp.float32(pixels.left[i, j])
    v = v_image[i, j]
    splats = bins.splats
    behind = wp.float32(0.0)  # upstream gradient times the colour composited behind
    k = wp.int32(pixels.ends[i, j])
    while k > bins.starts[bin]:
        k -= 1
        s = bins.members[k]
        dx, dy = float(j) + 0.5 - splats[s, 0], float(i) + 0.5 - splats[s, 1]
        fall = _falloff(splats, s, dx, dy)
        alpha = wp.min(splats[s, 5] * fall, wp.static(MAX_ALPHA))
        if alpha < wp.static(MIN_ALPHA):
            continue
        T = T / (1.0 - alpha)
        w = alpha * T
        facing = wp.dot(v, wp.vec4(splats[s, 6], splats[s, 7], splats[s, 8], splats[s, 9]))
        for c in range(4):
            wp.atomic_add(grads, piece, s, 6 + c, w * v[c])
        if splats[s, 5] * fall <= wp.static(MAX_ALPHA):
            g = alpha * (T * facing - behind / (1.0 - alpha))
            wp.atomic_add(grads, piece, s, 0, g * (splats[s, 2] * dx + splats[s, 3] * dy))
            wp.atomic_add(grads, piece, s, 1, g * (splats[s, 3] * dx + splats[s, 4] * dy))
            wp.atomic_add(grads, piece, s, 2, -0.5 * g * dx * dx)
            wp.atomic_add(grads, piece, s, 3, -g * dx * dy)
            wp.atomic_add(grads, piece, s, 4, -0.5 * g * dy * dy)
            wp.atomic_add(grads, piece, s, 5, g / splats[s, 5])
        behind += w * facing


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, splats, bins):
        size = (bins.height, bins.width)
        image, left, ends = torch.empty(*size, 4), torch.empty(size), torch.empty(size, dtype=torch.int32)
        _launch(_forward, splats, bins, [view(image, wp.vec4), _finished(left, ends)])
        ctx.save_for_backward(splats, left, ends)
        ctx.bins = bins
        return image

    @staticmethod
    def backward(ctx, v_image):
        splats, left, ends = ctx.saved_tensors
        grads = torch.zeros(num_threads(), len(splats), GRADIENT_CHANNELS)  # one table per thread
        _launch(_backward, splats, ctx.bins, [view(v_image.contiguous(), wp.vec4), _finished(left, ends), view(grads)])
        return torch.nn.functional.pad(grads.sum(0), (0, splats.shape[1] - GRADIENT_CHANNELS)), None


def _finished(left: Tensor, ends: Tensor) -> FinishedPixels:
    return with_arrays(FinishedPixels(), {"left": left, "ends": ends})


def _launch(kernel: wp.Kernel, splats: Tensor, bins: Bins, inputs: list) -> None:
    """Launch over the image's pixels, split into as many ranges as there are threads."""
    launch_ranges(kernel, even_bounds(bins.width * bins.height, num_threads()), [bins.of(splats), *inputs])


def bin_into_tiles(splats: Tensor, keys: Tensor, width: int, height: int) -> Bins:
    """Bin splats (n, 16) by their sort keys into every tile that their bounding box touches."""
    last = torch.tensor([(width - 1) // TILE, (height - 1) // TILE])
    centre, radius = splats[:, :2].detach(), splats[:, 11:13].detach()
    low, high = (((centre + sign * radius - 0.5) / TILE).floor().clamp(0 * last, last) for sign in (-1, 1))
    return bin_splats(keys, torch.cat([low, high], 1).to(torch.int16), width, height, TILE)


def composite_per_pixel(splats: Tensor, bins: Bins) -> Tensor:
    """Composite four channels of splats (n, 16) into an image (h, w, 4); differentiable with respect to the splats."""
    return _Blend.apply(splats, bins)
