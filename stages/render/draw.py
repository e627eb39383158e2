"""Rendering of one view: Gaussians through one camera, as colour, depth or object ids."""

from __future__ import annotations

import colorsys
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import C0, rgb_to_sh
from stages.core.raster.rasterise import rasterise
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.render.background import RenderBackground

MIN_DEPTH_OPACITY = 0.5  # accumulated opacity above which a pixel has a depth
HUE_STEP = 0.6180339887498949  # golden ratio - 1, which separates the hues of any number of objects
MAX_QUANTILE_SAMPLES = 1_000_000  # about the most depths from which quantiles are computed
DEPTH_QUANTILES = (0.02, 0.98)  # quantiles of depth at the ends of the colour range
DEPTH_COLOURS = ((0.99, 0.93, 0.60), (0.98, 0.62, 0.30), (0.85, 0.27, 0.34), (0.49, 0.14, 0.45), (0.09, 0.07, 0.25))


class RenderedView(NamedTuple):
    """Image and depth of one camera, on the device of the Gaussians."""

    image: Tensor  # (h, w, 3) RGB over the background
    depth: Tensor  # (h, w) [scene units], 0 where there is no surface


def render_view(gaussians: Gaussians, camera: Cameras, index: int, background: RenderBackground) -> RenderedView:
    """Render one of the cameras."""
    device = gaussians.means.device
    width, height = camera.sizes[index].tolist()
    with torch.no_grad():
        drawn = rasterise(
            gaussians, camera.viewmats[[index]].to(device), camera.Ks[[index]].to(device), width, height,
            background=background.image(width, height),
        )  # fmt: skip
    image, alpha, depth = (x[0].float() for x in (drawn.rgb, drawn.alpha, drawn.depth))
    return RenderedView(image.clamp(0, 1), torch.where(alpha > MIN_DEPTH_OPACITY, depth, 0.0))


def object_colours(ids: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """RGB of each object id, a function of the id alone."""
    table = {i: colorsys.hsv_to_rgb(i * HUE_STEP % 1, (0.85, 0.6)[i // 5 % 2], (0.95, 0.75)[i // 3 % 2])
             for i in ids.unique().tolist()}  # fmt: skip
    values, inverse = ids.unique(return_inverse=True)
    return torch.tensor([table[i] for i in values.tolist()]).to(ids.device)[inverse]


def colour_by_object(g: Gaussians) -> Gaussians:
    """Recolour Gaussians with one flat colour per object; the background gets light greys that keep its contrast."""
    brightness = (g.sh[:, 0] * C0 + 0.5).clamp(0, 1).mean(1, keepdim=True)
    grey = (0.35 + 0.5 * brightness).expand(-1, 3)
    rgb = torch.where(g.object_id[:, None] > 0, object_colours(g.object_id).to(grey), grey)
    return replace(g, sh=rgb_to_sh(rgb))


def depth_range(depths: list[Float[Tensor, "h w"]]) -> tuple[float, float]:
    """DEPTH_QUANTILES of all depths above 0, as the range for `colour_depth`; (0, 1) if there are none."""
    values = torch.cat([d[d > 0].flatten() for d in depths])
    if not len(values):
        return 0.0, 1.0
    values = values[:: max(1, len(values) // MAX_QUANTILE_SAMPLES)]
    low, high = torch.quantile(values, torch.tensor(DEPTH_QUANTILES).to(values)).tolist()
    return low, max(high, low + 1e-6)


def colour_depth(depth: Float[Tensor, "h w"], span: tuple[float, float]) -> Float[Tensor, "h w 3"]:
    """Colour-coded depth: bright is near, dark is far, black is no surface; `span` is the depth range."""
    low, high = span
    colours = torch.tensor(DEPTH_COLOURS).to(depth)
    position = ((depth - low) / (high - low)).clamp(0, 1) * (len(colours) - 1)
    first = position.floor().long().clamp(max=len(colours) - 2)
    image = torch.lerp(colours[first], colours[first + 1], (position - first)[..., None])
    return torch.where(depth[..., None] > 0, image, 0.0)
