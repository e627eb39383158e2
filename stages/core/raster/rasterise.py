"""Rasterisation of Gaussians: gsplat on CUDA, `stages.core.kernels.splat` elsewhere, with the same conventions.

Pixel centres at +0.5, 0.3 px^2 of blur, splats sorted by camera depth, alpha from 1/255 to 0.999, a pixel finished at
a transmittance of 1e-4. Differentiable in means, quats, scales, opacities, sh and features, not in cameras or
background.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import degree_of
from stages.core.kernels.splat.binning import Bins, bin_splats
from stages.core.kernels.splat.compositing import composite, dominant_splats
from stages.core.kernels.splat.projection import pack_camera, project
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
        return _stack([sum(get(), torch.zeros_like(self.extents[0])) for get in self.absgrad_getters])


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
    draw = _draw_cuda if gaussians.means.is_cuda else _draw
    views = [draw(gaussians, _View(V, K, width, height), background) for V, K in zip(viewmats, Ks, strict=True)]
    *images, getters = zip(*views, strict=True)
    return Rendering(*(_stack(image) for image in images), getters)


def rasterise_features(
    gaussians: Gaussians,
    features: Float[Tensor, "n f"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
) -> Float[Tensor, "c h w f"]:
    """Composite feature vectors of the Gaussians like colours, over 0: sum of weight x feature. Differentiable."""
    draw = _features_cuda if gaussians.means.is_cuda else _features
    views = [_View(V, K, width, height) for V, K in zip(viewmats, Ks, strict=True)]
    return _stack([draw(gaussians, features, view) for view in views])


@torch.no_grad()
def visibility(
    gaussians: Gaussians,
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
) -> tuple[Int[Tensor, "h w"], Float[Tensor, "n"]]:
    """The Gaussian with the largest weight in each pixel (-1: none), and each Gaussian's total weight [px]."""
    view = _View(viewmat, K, width, height)
    if gaussians.means.is_cuda:
        return _visibility_cuda(gaussians, view)
    return dominant_splats(*_splats(gaussians, view))


class _View(NamedTuple):
    """One camera and its image size [px]."""

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int

    def for_gsplat(self, g: Gaussians) -> tuple[Tensor, Tensor, int, int]:
        """Camera arguments of gsplat's functions, on the device of the Gaussians."""
        return self.viewmat[None].to(g.means), self.K[None].to(g.means), self.width, self.height


def _stack(images: list[Tensor] | tuple[Tensor, ...]) -> Tensor:
    return images[0][None] if len(images) == 1 else torch.stack(tuple(images))


def _splats(g: Gaussians, view: _View) -> tuple[Tensor, Bins]:
    degree_of(g.sh.shape[1])
    camera = pack_camera(*view, NEAR)
    splats, keys, rects = project(camera, g.means, g.quats, g.scales, g.opacities, g.sh)
    return splats, bin_splats(keys, rects, view.width, view.height)


def _draw(g: Gaussians, view: _View, background: Tensor | None):
    """Image, alpha, depth, extents of one view, and a getter of its absolute gradients."""
    splats, bins = _splats(g, view)
    absgrad: list[Tensor] = []
    if splats.requires_grad:
        splats.register_hook(lambda grad: absgrad.append(grad[:, 10:12]))
    rgb, depth, alpha = composite(splats, bins, None if background is None else background.detach(), mean=True)
    return rgb, alpha, depth, splats.detach()[:, 11:13], lambda: absgrad


def _features(g: Gaussians, features: Tensor, view: _View):
    """Composite four features at a time in the columns of colour and depth."""
    splats, bins = _splats(g, view)
    count = features.shape[1]
    padded = torch.nn.functional.pad(features.float(), (0, -count % 4))
    images = []
    for four in padded.split(4, dim=1):
        rgb, fourth, _ = composite(torch.cat([splats[:, :6], four, splats[:, 10:]], 1), bins)
        images += [rgb, fourth[..., None]]
    return torch.cat(images, -1)[..., :count] if images else splats.new_zeros(view.height, view.width, 0)


def _draw_cuda(g: Gaussians, view: _View, background: Tensor | None):
    import gsplat

    image, alpha, info = gsplat.rasterization(
        g.means, g.quats, g.scales, g.opacities, g.sh, *view.for_gsplat(g), near_plane=NEAR,
        sh_degree=degree_of(g.sh.shape[1]), packed=False, render_mode="RGB+ED", absgrad=True,
    )  # fmt: skip
    centres = info["means2d"]
    rgb, alpha = image[0, ..., :3], alpha[0, ..., 0]
    if background is not None:
        rgb = rgb + (1 - alpha)[..., None] * background.detach().to(rgb)

    def absgrad() -> list[Tensor]:  # no hook: a hook that holds its own tensor would never be freed
        return [centres.absgrad[0]] if hasattr(centres, "absgrad") else []

    return rgb, alpha, image[0, ..., 3], info["radii"][0].float(), absgrad


def _features_cuda(g: Gaussians, features: Tensor, view: _View):
    import gsplat

    image, _, _ = gsplat.rasterization(
        g.means, g.quats, g.scales, g.opacities, features, *view.for_gsplat(g), near_plane=NEAR,
        packed=False,
    )  # fmt: skip
    return image[0]


def _visibility_cuda(g: Gaussians, view: _View):
    """Visibility from gsplat's projection and binning; gsplat does not return the dominant splat of a pixel."""
    import gsplat

    from stages.core.kernels.splat.compositing_pixel import composite_pixelwise

    radii, centres, depths, conics, _ = gsplat.fully_fused_projection(
        g.means, None, g.quats, g.scales, *view.for_gsplat(g), near_plane=NEAR,
        opacities=g.opacities,
    )  # fmt: skip
    tile, across, down = 16, -(-view.width // 16), -(-view.height // 16)
    _, keys, members = gsplat.isect_tiles(centres, radii, depths, tile, across, down)
    starts = gsplat.isect_offset_encode(keys, 1, across, down).flatten()
    starts = torch.cat([starts, starts.new_tensor([len(members)])])
    splats = torch.zeros(len(g), 16, device=centres.device)
    splats[:, :6] = torch.cat([centres[0], conics[0], g.opacities[:, None]], 1)
    _, _, index, weight = composite_pixelwise(splats, members, starts, tile, view.width, view.height)
    return index, weight
