"""Images of Gaussians: gsplat on CUDA, our own kernels elsewhere, behind one interface with the same conventions.

Pixel centres at +0.5, 0.3 px^2 of blur, splats in order of camera depth, alpha from 1/255 to 0.999, a pixel finished at
a transmittance of 1e-4. Gradients reach means, quats, scales, opacities, sh and features, not cameras or background.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import degree_of
from stages.core.kernels.splat.binning import Bins, bin_splats
from stages.core.kernels.splat.compositing import composite, dominant_splats
from stages.core.kernels.splat.projection import pack_camera, project
from stages.core.scene.gaussians import Gaussians


@dataclass(frozen=True)
class Rendering:
    """Images of c cameras, and what growing and pruning of Gaussians goes by."""

    rgb: Float[Tensor, "c h w 3"]
    alpha: Float[Tensor, "c h w"]
    depth: Float[Tensor, "c h w"]  # along the viewing axis [m], mean over what is seen; 0 where nothing is
    extents: Float[Tensor, "c n 2"]  # half width and height on the image [px]; 0: not in view
    pulls: tuple[Callable[[], list[Tensor]], ...]  # one a camera; known after backward()

    @property
    def visible(self) -> Bool[Tensor, "c n"]:
        return self.extents[..., 0] > 0

    @property
    def absgrad(self) -> Float[Tensor, "c n 2"]:
        """After backward(), for every Gaussian the sum over pixels of |dL / d centre on the image| [1/px]."""
        return _stack([sum(pull(), torch.zeros_like(self.extents[0])) for pull in self.pulls])


def rasterise(
    gaussians: Gaussians,
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    background: Float[Tensor, "3"] | Float[Tensor, "h w 3"] | None = None,
    near: float = 0.01,
) -> Rendering:
    """Draw the Gaussians in each of one or more cameras, before a background colour or picture (black when None).

    Gaussians nearer than `near` [m] to a camera's plane are left out.
    """
    draw = _draw_cuda if gaussians.means.is_cuda else _draw
    views = [draw(gaussians, V, K, width, height, background, near) for V, K in zip(viewmats, Ks, strict=True)]
    *images, pulls = zip(*views, strict=True)
    return Rendering(*(_stack(image) for image in images), pulls)


def rasterise_features(
    gaussians: Gaussians,
    features: Float[Tensor, "n f"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    near: float = 0.01,
) -> Float[Tensor, "c h w f"]:
    """Composite any numbers per Gaussian as if they were colours: sum of w times feature. Differentiable."""
    draw = _features_cuda if gaussians.means.is_cuda else _features
    return _stack([draw(gaussians, features, V, K, width, height, near) for V, K in zip(viewmats, Ks, strict=True)])


@torch.no_grad()
def visibility(
    gaussians: Gaussians,
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    near: float = 0.01,
) -> tuple[Int[Tensor, "h w"], Float[Tensor, "n"]]:
    """For every pixel the Gaussian that weighs most (-1: none), for every Gaussian its weight over all pixels [px]."""
    if gaussians.means.is_cuda:
        return _visibility_cuda(gaussians, viewmat, K, width, height, near)
    return dominant_splats(*_splats(gaussians, viewmat, K, width, height, near))


def _stack(images: list[Tensor] | tuple[Tensor, ...]) -> Tensor:
    return images[0][None] if len(images) == 1 else torch.stack(tuple(images))


def _splats(g: Gaussians, viewmat: Tensor, K: Tensor, width: int, height: int, near: float) -> tuple[Tensor, Bins]:
    degree_of(g.sh.shape[1])
    camera = pack_camera(viewmat, K, width, height, near)
    splats, keys, rects = project(camera, g.means, g.quats, g.scales, g.opacities, g.sh)
    return splats, bin_splats(keys, rects, width, height)


def _draw(g: Gaussians, viewmat: Tensor, K: Tensor, width: int, height: int, background: Tensor | None, near: float):
    """Image, alpha, depth, extents, and a list for the absolute gradients, of one view."""
    splats, bins = _splats(g, viewmat, K, width, height, near)
    pull: list[Tensor] = []
    if splats.requires_grad:
        splats.register_hook(lambda grad: pull.append(grad[:, 10:12]))
    rgb, depth, alpha = composite(splats, bins, None if background is None else background.detach(), mean=True)
    return rgb, alpha, depth, splats.detach()[:, 11:13], lambda: pull


def _features(g: Gaussians, features: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, near: float):
    """Four features at a time in the place of colour and depth."""
    splats, bins = _splats(g, viewmat, K, width, height, near)
    count = features.shape[1]
    padded = torch.nn.functional.pad(features.float(), (0, -count % 4))
    images = []
    for four in padded.split(4, dim=1):
        rgb, fourth, _ = composite(torch.cat([splats[:, :6], four, splats[:, 10:]], 1), bins)
        images += [rgb, fourth[..., None]]
    return torch.cat(images, -1)[..., :count] if images else splats.new_zeros(height, width, 0)


def _camera(g: Gaussians, viewmat: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    return viewmat[None].to(g.means), K[None].to(g.means)


def _draw_cuda(
    g: Gaussians, viewmat: Tensor, K: Tensor, width: int, height: int, background: Tensor | None, near: float
):
    import gsplat

    image, alpha, info = gsplat.rasterization(
        g.means, g.quats, g.scales, g.opacities, g.sh, *_camera(g, viewmat, K), width, height, near_plane=near,
        sh_degree=degree_of(g.sh.shape[1]), packed=False, render_mode="RGB+ED", absgrad=True,
    )  # fmt: skip
    centres = info["means2d"]
    rgb, alpha = image[0, ..., :3], alpha[0, ..., 0]
    if background is not None:
        rgb = rgb + (1 - alpha)[..., None] * background.detach().to(rgb)

    def pulls() -> list[Tensor]:  # asked for, not hooked: a hook on what it holds would keep all of a step for ever
        return [centres.absgrad[0]] if hasattr(centres, "absgrad") else []

    return rgb, alpha, image[0, ..., 3], info["radii"][0].float(), pulls


def _features_cuda(g: Gaussians, features: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, near: float):
    import gsplat

    image, _, _ = gsplat.rasterization(
        g.means, g.quats, g.scales, g.opacities, features, *_camera(g, viewmat, K), width, height, near_plane=near,
        packed=False,
    )  # fmt: skip
    return image[0]


def _visibility_cuda(g: Gaussians, viewmat: Tensor, K: Tensor, width: int, height: int, near: float):
    """gsplat's splats and bins, walked by our kernel: gsplat itself does not say which splat weighs most."""
    import gsplat

    from stages.core.kernels.splat.compositing_pixel import composite_pixelwise

    radii, centres, depths, conics, _ = gsplat.fully_fused_projection(
        g.means, None, g.quats, g.scales, *_camera(g, viewmat, K), width, height, near_plane=near,
        opacities=g.opacities,
    )  # fmt: skip
    tile, across, down = 16, -(-width // 16), -(-height // 16)
    _, keys, members = gsplat.isect_tiles(centres, radii, depths, tile, across, down)
    starts = gsplat.isect_offset_encode(keys, 1, across, down).flatten()
    starts = torch.cat([starts, starts.new_tensor([len(members)])])
    splats = torch.zeros(len(g), 16, device=centres.device)
    splats[:, :6] = torch.cat([centres[0], conics[0], g.opacities[:, None]], 1)
    _, _, index, weight = composite_pixelwise(splats, members, starts, tile, width, height)
    return index, weight
