"""Compositing with one thread per pixel, on any device.

On the CPU it is several times slower than `compositing`, and tests compare the two; on CUDA it provides the splat with
the largest weight in each pixel, which gsplat does not.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import device_of, launch, view
from stages.core.kernels.splat.pixel_blocks import MAX_ALPHA, MIN_TRANSMITTANCE
from stages.core.kernels.splat.projection import MIN_ALPHA

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _composite(
    splats: wp.array2d[float], members: wp.array[int], starts: wp.array[int], tile: int, across: int,
    image: wp.array2d[wp.vec4], alphas: wp.array2d[float], index: wp.array2d[int], totals: wp.array[float],
):  # fmt: skip
    i, j = wp.tid()
    bin = (i // tile) * across + j // tile
    T = wp.float32(1.0)
    colour = wp.vec4()
    best, which = wp.float32(0.0), wp.int32(-1)
    for k in range(starts[bin], starts[bin + 1]):
        s = members[k]
        dx, dy = float(j) + 0.5 - splats[s, 0], float(i) + 0.5 - splats[s, 1]
        sigma = 0.5 * (splats[s, 2] * dx * dx + splats[s, 4] * dy * dy) + splats[s, 3] * dx * dy
        alpha = wp.min(splats[s, 5] * wp.exp(-sigma), wp.static(MAX_ALPHA))
        if alpha < wp.static(MIN_ALPHA):
            continue
        if T * (1.0 - alpha) <= wp.static(MIN_TRANSMITTANCE):
            break
        w = alpha * T
        colour += w * wp.vec4(splats[s, 6], splats[s, 7], splats[s, 8], splats[s, 9])
        wp.atomic_add(totals, s, w)
        if w > best:
            best, which = w, s
        T *= 1.0 - alpha
    image[i, j] = colour
    alphas[i, j] = 1.0 - T
    index[i, j] = which


def composite_pixelwise(splats: Tensor, members: Tensor, starts: Tensor, tile: int, width: int, height: int):
    """Composite splats (n, 16) in bins of tile x tile pixels, front to back. Not differentiable.

    Bin b (row-major) holds members[starts[b]:starts[b + 1]], nearest first. Returns the image of four channels
    (h, w, 4), alpha (h, w), the splat with the largest weight in each pixel (h, w; -1: none), and the total weight of
    each splat over all pixels (n,).
    """
    new = splats.new_empty
    image, alphas, totals = new(height, width, 4), new(height, width), splats.new_zeros(len(splats))
    index = new(height, width, dtype=torch.int32)
    launch(
        _composite, (height, width), [view(splats), view(members), view(starts), tile, -(-width // tile)],
        [view(image, wp.vec4), view(alphas), view(index), view(totals)], device_of(splats),
    )  # fmt: skip
    return image, alphas, index.long(), totals
