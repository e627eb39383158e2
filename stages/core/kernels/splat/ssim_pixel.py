"""Structural similarity and its gradient with one thread a value, two launches each: for CUDA, and tests anywhere.

The formula is that of `ssim`; its window goes down the columns into scratch maps first, then along the rows.
"""

from __future__ import annotations

import math

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import device_of, launch, view

wp.set_module_options({"enable_backward": False})

WINDOW_RADIUS = 5  # pixels to either side of the window's centre
SIGMA = 1.5  # [px]
C1, C2 = 0.01**2, 0.03**2  # for images in 0..1

_WEIGHTS = [math.exp(-0.5 * (i / SIGMA) ** 2) for i in range(-WINDOW_RADIUS, WINDOW_RADIUS + 1)]
WINDOW = [weight / sum(_WEIGHTS) for weight in _WEIGHTS]
TAPS = len(WINDOW)

maps5 = wp.types.vector(5, wp.float32)
taps = wp.types.vector(TAPS, wp.float32)


@wp.kernel
def _down(window: taps, first: wp.array2d[float], second: wp.array2d[float], sums: wp.array2d[maps5]):
    """Of both images, their squares and their product."""
    i, j = wp.tid()
    total = maps5()
    for t in range(wp.static(TAPS)):
        row = i + t - wp.static(WINDOW_RADIUS)
        if row >= 0 and row < first.shape[0]:
            x = first[row, j]
            y = second[row, j]
            total += window[t] * maps5(x, y, x * x, y * y, x * y)
    sums[i, j] = total


@wp.kernel
def _compare(
    window: taps, channels: int, sums: wp.array2d[maps5], similar: wp.array2d[float], slopes: wp.array2d[wp.vec3]
):  # fmt: skip
    """Similarity, and its derivatives by mean and variance of the first image and by the covariance."""
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
    similar[i, j] = s
    slopes[i, j] = wp.vec3(by_mean, by_variance, by_covariance)


@wp.kernel
def _down_slopes(window: taps, slopes: wp.array2d[wp.vec3], sums: wp.array2d[wp.vec3]):
    i, j = wp.tid()
    total = wp.vec3()
    for t in range(wp.static(TAPS)):
        row = i + t - wp.static(WINDOW_RADIUS)
        if row >= 0 and row < slopes.shape[0]:
            total += window[t] * slopes[row, j]
    sums[i, j] = total


@wp.kernel
def _gather(
    window: taps, channels: int, share: float, first: wp.array2d[float], second: wp.array2d[float],
    sums: wp.array2d[wp.vec3], grads: wp.array2d[float],
):  # fmt: skip
    """A pixel moves the mean by its window, the variance by 2 x, the covariance by y."""
    i, j = wp.tid()
    e = wp.vec3()
    for t in range(wp.static(TAPS)):
        column = j + (t - wp.static(WINDOW_RADIUS)) * channels
        if column >= 0 and column < sums.shape[1]:
            e += window[t] * sums[i, column]
    grads[i, j] = share * (e[0] + 2.0 * first[i, j] * e[1] + second[i, j] * e[2])


def ssim_forward(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Mean similarity of images (h, w, c), and its derivatives (h, w * c, 3) by mean and variance of the first and by
    the covariance."""
    x, y = first.flatten(1), second.flatten(1)
    sums, similar, slopes = x.new_empty(*x.shape, 5), torch.empty_like(x), x.new_empty(*x.shape, 3)
    launch(_down, x.shape, [taps(WINDOW), view(x), view(y)], [view(sums, maps5)], device_of(x))
    launch(_compare, x.shape, [taps(WINDOW), first.shape[2], view(sums, maps5)],
           [view(similar), view(slopes, wp.vec3)], device_of(x))  # fmt: skip
    return similar.mean(), slopes


def ssim_backward(first: Tensor, second: Tensor, slopes: Tensor) -> Tensor:
    """Gradient of the mean similarity by the first image."""
    x, y = first.flatten(1), second.flatten(1)
    sums, grads = torch.empty_like(slopes), torch.empty_like(x)
    launch(_down_slopes, x.shape, [taps(WINDOW), view(slopes, wp.vec3)], [view(sums, wp.vec3)], device_of(x))
    launch(_gather, x.shape,
           [taps(WINDOW), first.shape[2], 1 / x.numel(), view(x), view(y), view(sums, wp.vec3)],
           [view(grads)], device_of(x))  # fmt: skip
    return grads.view(first.shape)
