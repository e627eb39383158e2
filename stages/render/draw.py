"""One picture: Gaussians through one camera, as colour, as depth or as object ids."""

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

SEEN = 0.5  # opacity a pixel needs to have a depth
GOLDEN = 0.6180339887498949  # steps of this part of the colour wheel keep hues apart for any number of objects
NEAR_TO_FAR = ((0.99, 0.93, 0.60), (0.98, 0.62, 0.30), (0.85, 0.27, 0.34), (0.49, 0.14, 0.45), (0.09, 0.07, 0.25))


class RenderedView(NamedTuple):
    """What one camera sees."""

    image: Tensor  # (h, w, 3) RGB over the backdrop
    depth: Tensor  # (h, w) [scene units], 0 where there is nothing


def render_view(gaussians: Gaussians, camera: Cameras, index: int, backdrop: RenderBackground) -> RenderedView:
    """The view of one of the cameras, on the CPU."""
    device = gaussians.means.device
    width, height = camera.sizes[index].tolist()
    with torch.no_grad():
        drawn = rasterise(
            gaussians, camera.viewmats[[index]].to(device), camera.Ks[[index]].to(device), width, height,
            background=backdrop.image(width, height),
        )  # fmt: skip
    image, alpha, depth = (x[0].float().cpu() for x in (drawn.rgb, drawn.alpha, drawn.depth))
    return RenderedView(image.clamp(0, 1), torch.where(alpha > SEEN, depth, 0.0))


def object_colours(ids: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """A lively colour for each object id, the same in every picture."""
    table = {i: colorsys.hsv_to_rgb(i * GOLDEN % 1, (0.85, 0.6)[i // 5 % 2], (0.95, 0.75)[i // 3 % 2])
             for i in ids.unique().tolist()}  # fmt: skip
    values, inverse = ids.unique(return_inverse=True)
    return torch.tensor([table[i] for i in values.tolist()]).to(ids.device)[inverse]


def colour_by_object(g: Gaussians) -> Gaussians:
    """The same Gaussians in one flat colour an object; the background in pale greys, so that it can be made out."""
    own = (g.sh[:, 0] * C0 + 0.5).clamp(0, 1).mean(1, keepdim=True)
    grey = (0.35 + 0.5 * own).expand(-1, 3)
    rgb = torch.where(g.object_id[:, None] > 0, object_colours(g.object_id).to(grey), grey)
    return replace(g, sh=rgb_to_sh(rgb))


def depth_range(depths: list[Float[Tensor, "h w"]]) -> tuple[float, float]:
    """From the nearest to the farthest depth that counts; the outer fiftieths do not."""
    values = torch.cat([d[d > 0].flatten() for d in depths])
    if not len(values):
        return 0.0, 1.0
    values = values[:: max(1, len(values) // 1_000_000)]
    low, high = torch.quantile(values, torch.tensor([0.02, 0.98])).tolist()
    return low, max(high, low + 1e-6)


def colour_depth(depth: Float[Tensor, "h w"], span: tuple[float, float]) -> Float[Tensor, "h w 3"]:
    """Bright is near, dark is far, black is nothing."""
    low, high = span
    stops = torch.tensor(NEAR_TO_FAR)
    at = ((depth - low) / (high - low)).clamp(0, 1) * (len(stops) - 1)
    first = at.floor().long().clamp(max=len(stops) - 2)
    image = torch.lerp(stops[first], stops[first + 1], (at - first)[..., None])
    return torch.where(depth[..., None] > 0, image, 0.0)
