"""Rasterisation of Gaussians on the CPU and on CUDA, with the conventions of gsplat.

Pixel centres are at +0.5, the blur is 0.3 px^2, splats are sorted by camera depth, alpha is 1/255 to 0.999, and
compositing of a pixel stops at a transmittance of 1e-4. Differentiable in means, quats, scales, opacities, sh and
features, not in cameras or background. Images and gradients are bit-identical when repeated on the same device, on the
CPU for any number of threads.

If Warp has no compiler for the CPU, a GPU does the work; images are returned on the device of the Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import degree_of
from stages.core.kernels.interop import kernel_device
from stages.core.kernels.splat.binning import Bins, bin_splats
from stages.core.kernels.splat.compositing import composite, composite_with_dominant
from stages.core.kernels.splat.projection import pack_camera, project
from stages.core.kernels.splat.tiles import Capacity, Tiles, bin_tiles
from stages.core.scene.gaussians import Gaussians

NEAR = 0.01  # Gaussians with a smaller camera depth are left out [m]


@dataclass(frozen=True)
class Rendering:
    """Images of c cameras, and image-space quantities for densification and pruning of the n Gaussians."""

    rgb: Float[Tensor, "c h w 3"]
    alpha: Float[Tensor, "c h w"]
    depth: Float[Tensor, "c h w"]  # along the viewing axis [m], alpha-weighted mean; 0 where alpha is 0
    extents: Float[Tensor, "c n 2"]  # half width and height on the image [px]; 0: not visible
    absgrad_getters: tuple[Callable[[], list[Tensor]], ...]  # one per camera; empty lists before backward()

    @property
    def visible(self) -> Bool[Tensor, "c n"]:
        """Whether a Gaussian overlaps the image with at least the minimum alpha."""
        return self.extents[..., 0] > 0

    @property
    def absgrad(self) -> Float[Tensor, "c n 2"]:
        """Sum over pixels of |dL / d image centre| [1/px] of each Gaussian, after backward(); 0 before."""
        nothing = torch.zeros_like(self.extents[0])
        return _stack([sum((grad.to(nothing) for grad in get()), nothing) for get in self.absgrad_getters])


def rasterise(
    gaussians: Gaussians,
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    background: Float[Tensor, "3"] | Float[Tensor, "h w 3"] | None = None,
) -> Rendering:
    """Render Gaussians in one or more cameras over a background colour or image (black when None).

    Width and height are in pixels. Gaussians with a camera depth below NEAR are left out.
    """
    g = _drawable(gaussians)
    packed = [_View(V, K, width, height).packed(g) for V, K in zip(viewmats, Ks, strict=True)]
    drawn = [rasterise_packed(g, camera, width, height, background) for camera in packed]
    *images, getters = zip(*drawn, strict=True)
    return Rendering(*(_stack(image).to(gaussians.means.device) for image in images), getters)


def rasterise_packed(
    gaussians: Gaussians, camera: Float[Tensor, "26"], width: int, height: int, background: Tensor | None = None,
    capacity: Capacity | None = None,
):  # fmt: skip
    """Render one view with a camera from `pack_camera` on the device of the Gaussians.

    Returns rgb (h, w, 3), alpha (h, w), depth (h, w), extents (n, 2) and a getter of the absolute gradients; see
    `Rendering`. On CUDA, with a capacity for the splat-tile pairs, nothing waits for the GPU, so that the call and its
    gradient can be captured in a CUDA graph.
    """
    splats, bins = _splats(gaussians, camera, width, height, capacity)
    absgrad: list[Tensor] = []
    if splats.requires_grad:
        splats.register_hook(lambda grad: absgrad.append(grad[:, 10:12]))
    behind = None if background is None else background.detach()
    rgb, depth, alpha = composite(splats, bins, behind, mean=True)
    return rgb, alpha, depth, splats.detach()[:, 11:13], lambda: absgrad


def count_pairs(gaussians: Gaussians, camera: Float[Tensor, "26"], width: int, height: int) -> int:
    """Number of splat-tile pairs in this view, on CUDA; see `Capacity`."""
    return len(_splats(gaussians, camera, width, height)[1].slots)


def rasterise_features(
    gaussians: Gaussians,
    features: Float[Tensor, "n f"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
) -> Float[Tensor, "c h w f"]:
    """Composite feature vectors of the Gaussians like colours, over 0: the sum of weight x feature. Differentiable."""
    g = _drawable(gaussians)
    views = [_View(V, K, width, height) for V, K in zip(viewmats, Ks, strict=True)]
    return _stack([_features(g, features.to(g.means.device), view) for view in views]).to(gaussians.means.device)


class Visibility(NamedTuple):
    """What one camera sees over a black background; rgb, alpha and depth as in `Rendering`."""

    rgb: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    index: Int[Tensor, "h w"]  # the Gaussian with the largest weight in each pixel, -1: none
    weight: Float[Tensor, "n"]  # each Gaussian's total weight [px]


@torch.no_grad()
def visibility(
    gaussians: Gaussians, viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"], width: int, height: int
) -> Visibility:
    """Find which Gaussians are visible in a view of this size [px], and render it. Not differentiable."""
    g = _drawable(gaussians)
    splats, bins = _splats(g, _View(viewmat, K, width, height).packed(g), width, height)
    rgb, depth, alpha, index, weight = composite_with_dominant(splats, bins)
    return Visibility(*(x.to(gaussians.means.device) for x in (rgb, alpha, depth, index, weight)))


def _drawable(g: Gaussians) -> Gaussians:
    """The Gaussians on their device, or on a GPU if no kernel can be compiled for the CPU."""
    return g.to(kernel_device(g.means))


class _View(NamedTuple):
    """One camera and its image size [px]."""

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int

    def packed(self, g: Gaussians) -> Float[Tensor, "26"]:
        """The camera as the kernels read it, on the device of the Gaussians."""
        return pack_camera(*self, NEAR).to(g.means.device)


def _stack(images: list[Tensor] | tuple[Tensor, ...]) -> Tensor:
    return images[0][None] if len(images) == 1 else torch.stack(tuple(images))


def _splats(
    g: Gaussians, camera: Tensor, width: int, height: int, capacity: Capacity | None = None
) -> tuple[Tensor, Bins | Tiles]:
    degree_of(g.sh.shape[1])
    splats, keys, rects = project(camera, g.means, g.quats, g.scales, g.opacities, g.sh)
    if splats.is_cuda:
        return splats, bin_tiles(keys, rects, width, height, capacity)
    return splats, bin_splats(keys, rects, width, height)


def _features(g: Gaussians, features: Tensor, view: _View):
    """Composite four features at a time in the columns of colour and depth.

    On a CPU without gradients, splats whose four features are all zero are skipped.
    """
    splats, bins = _splats(g, view.packed(g), view.width, view.height)
    count = features.shape[1]
    padded = torch.nn.functional.pad(features.float(), (0, -count % 4))
    images = []
    for four in padded.split(4, dim=1):
        drawn = torch.cat([splats[:, :6], four, splats[:, 10:]], 1)
        where = bins if drawn.is_cuda or drawn.requires_grad else bins.with_any(four.any(1))
        rgb, fourth, _ = composite(drawn, where)
        images += [rgb, fourth[..., None]]
    return torch.cat(images, -1)[..., :count] if images else splats.new_zeros(view.height, view.width, 0)
