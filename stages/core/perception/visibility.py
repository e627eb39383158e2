"""Visibility of Gaussians from the cameras of a scene."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import centres, resize
from stages.core.raster.rasterise import visibility
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians

MAX_VISIBILITY_SIDE = 320  # longest side of the images in which visibility is rendered [px]
MAX_VISIBILITY_VIEWS = 24  # maximum number of cameras for which visibility is rendered


def downscaled_views(
    cameras: Cameras, max_views: int = MAX_VISIBILITY_VIEWS, side: int = MAX_VISIBILITY_SIDE
) -> list[tuple[Tensor, Tensor, int, int]]:
    """(viewmat, K, width, height) of at most `max_views` evenly spaced cameras, images scaled down to `side`."""
    picked = torch.linspace(0, len(cameras) - 1, min(max_views, len(cameras))).round().long().tolist()
    views = []
    for i in picked:
        width, height = cameras.sizes[i].tolist()
        shrink = min(1.0, side / max(width, height))
        w, h = max(1, round(width * shrink)), max(1, round(height * shrink))
        views.append((cameras.viewmats[i], resize(cameras.Ks[i], w / width, h / height), w, h))
    return views


def summed_view_directions(g: Gaussians, cameras: Cameras) -> Float[Tensor, "n 3"]:
    """Sum over the cameras of the unit direction to the camera, weighted by the Gaussian's weight in its image [px].

    Zero if no camera sees the Gaussian. The direction estimates the outer side of a surface, the length how much of the
    Gaussian is visible.
    """
    toward = torch.zeros(len(g), 3)
    for viewmat, K, width, height in downscaled_views(cameras):
        weight = visibility(g, viewmat, K, width, height).weight
        eye = centres(viewmat[None])[0]
        toward += weight[:, None].cpu() * torch.nn.functional.normalize(eye - g.means, dim=1)
    return toward
