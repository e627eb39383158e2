"""Structural similarity (SSIM) and its gradient with one thread per value; used on CUDA, tested on any device.

Definition as in `ssim` (zero padding). Value and gradient take two launches each: one applies the window down the
columns into scratch maps, the other along the rows.
"""

from __future__ import annotations

import math

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import device_of, launch, view, with_arrays

wp.set_module_options({"enable_backward": False})

WINDOW_RADIUS = 5  # [px]: the window is 11 x 11
SIGMA = 1.5  # [px]
C1, C2 = 0.01**2, 0.03**2  # (K1 L)^2 and (K2 L)^2 with K1 = 0.01, K2 = 0.03, L = 1

_WEIGHTS = [math.exp(-0.5 * (i / SIGMA) ** 2) for i in range(-WINDOW_RADIUS, WINDOW_RADIUS + 1)]
WINDOW = [weight / sum(_WEIGHTS) for weight in _WEIGHTS]
TAPS = len(WINDOW)

maps5 = wp.types.vector(5, wp.float32)
taps = wp.types.vector(TAPS, wp.float32)


@wp.struct
class ImagePair:
    """Two images of the same size to compare, with interleaved channels."""

    first: wp.array2d[float]  # (h, w * c)
    second: wp.array2d[float]  # (h, w * c)
    channels: int


def image_pair(first: Tensor, second: Tensor) -> ImagePair:
    """Wrap two images (h, w, c) for kernels."""
    images = with_arrays(ImagePair(), {"first": first.flatten(1), "second": second.flatten(1)})
    images.channels = first.shape[2]
    return images


@wp.kernel
def _down(window: taps, images: ImagePair, sums: wp.array2d[maps5]):
    """Apply the window down the columns of both images, their squares and their product."""
    i, j = wp.tid()
    total = maps5()
    for t in range(wp.static(TAPS)):
        row = i + t - wp.static(WINDOW_RADIUS)
        if row >= 0 and row < images.first.shape[0]:
            x = images.first[row, j]
            y = images.second[row, j]
            total += window[t] * maps5(x, y, x * x, y * y, x * y)
    sums[i, j] = total


@wp.kernel
def _compare(
    window: taps, channels: int, sums: wp.array2d[maps5], ssim_map: wp.array2d[float], derivatives: wp.array2d[wp.vec3]
):  # fmt: skip
    """Apply the window along the rows; compute SSIM and its derivatives.

    Derivatives are with respect to the mean and variance of the first image, and to the covariance.
    """
    i, j = wp.tid()
    e = maps5()
    for t in range(wp.static(TAPS)):
        column = j + (t - wp.static(WINDOW_RADIUS)) * channels
        if column >= 0 and column < sums.shape[1]:
            e += window[t] * sums[i, column]
    mx, my = e[0], e[1]
    a1, b1 = 2.0 * mx * my + wp.static(C1), mx * mx + my * my + wp.static(C1)
    a2 = 2.0 * (e[4] - mx * my) + wp.static(C2)
    b2 = (e[2] - mx * mx) + (e[3] - my * my) + wp.static(C2)
    s = a1 * a2 / (b1 * b2)
    by_variance, by_covariance = -s / b2, 2.0 * a1 / (b1 * b2)
    by_mean = 2.0 * my * a2 / (b1 * b2) - 2.0 * mx * s / b1 - 2.0 * mx * by_variance - my * by_covariance
    ssim_map[i, j] = s
    derivatives[i, j] = wp.vec3(by_mean, by_variance, by_covariance)


@wp.kernel
def _down_derivatives(window: taps, derivatives: wp.array2d[wp.vec3], sums: wp.array2d[wp.vec3]):
    """Apply the window down the columns of the three derivatives."""
    i, j = wp.tid()
    total = wp.vec3()
    for t in range(wp.static(TAPS)):
        row = i + t - wp.static(WINDOW_RADIUS)
        if row >= 0 and row < derivatives.shape[0]:
            total += window[t] * derivatives[row, j]
    sums[i, j] = total


@wp.kernel
def _gather(
    window: taps, factor: float, images: ImagePair, sums: wp.array2d[wp.vec3], grads: wp.array2d[float]
):  # fmt: skip
    """Apply the window along the rows, and the chain rule to the first image.

    With a window weight w and pixel values x and y: d mean = w, d variance = 2 w x, d covariance = w y.
    """
    i, j = wp.tid()
    e = wp.vec3()
    for t in range(wp.static(TAPS)):
        column = j + (t - wp.static(WINDOW_RADIUS)) * images.channels
        if column >= 0 and column < sums.shape[1]:
            e += window[t] * sums[i, column]
    grads[i, j] = factor * (e[0] + 2.0 * images.first[i, j] * e[1] + images.second[i, j] * e[2])


def ssim_forward(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Return the SSIM map (h, w * c) of images (h, w, c), and its derivatives (h, w * c, 3).

    Derivatives are with respect to the mean and variance of the first image, and to the covariance.
    """
    x = first.flatten(1)
    sums, ssim_map, derivatives = x.new_empty(*x.shape, 5), torch.empty_like(x), x.new_empty(*x.shape, 3)
    launch(_down, x.shape, [taps(WINDOW), image_pair(first, second)], [view(sums, maps5)], device_of(x))
    launch(_compare, x.shape, [taps(WINDOW), first.shape[2], view(sums, maps5)],
           [view(ssim_map), view(derivatives, wp.vec3)], device_of(x))  # fmt: skip
    return ssim_map, derivatives


def ssim_backward(first: Tensor, second: Tensor, derivatives: Tensor) -> Tensor:
    """Return the gradient (h, w, c) of the mean SSIM with respect to the first image.

    `derivatives` are those returned by `ssim_forward`.
    """
    x = first.flatten(1)
    sums, grads = torch.empty_like(derivatives), torch.empty_like(x)
    launch(_down_derivatives, x.shape, [taps(WINDOW), view(derivatives, wp.vec3)], [view(sums, wp.vec3)], device_of(x))
    launch(_gather, x.shape,
           [taps(WINDOW), 1 / x.numel(), image_pair(first, second), view(sums, wp.vec3)], [view(grads)],
           device_of(x))  # fmt: skip
    return grads.view(first.shape)
