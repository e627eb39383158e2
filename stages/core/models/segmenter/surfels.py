"""Surfels of a scene's Gaussians: the inputs of the segmentation network."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import C0
from stages.core.models.segmenter.voxels import ScenePoints, shortest_axes, within_reach
from stages.core.perception.support import ViewExtent, view_extent
from stages.core.perception.visibility import summed_view_directions
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene

NO_FLOOR_QUANTILE = 0.05  # quantile of the heights in reach that is taken as the floor if the scene has none


def scene_surfels(scene: Scene) -> tuple[ScenePoints, Int[Tensor, "n"], ViewExtent]:
    """Return the surfels of a scene within reach of the cameras' focus, their Gaussians' indices, and the view extent.

    The view extent gives the origin (`focus`) and the unit of length (`radius`) of the surfels.
    """
    g, view = scene.gaussians, view_extent(scene)
    local = (g.means - view.focus) / view.radius
    size = g.scales.amax(1) / view.radius
    index = torch.nonzero(within_reach(local, g.opacities, size) & g.quats.isfinite().all(1))[:, 0]
    local, near = local[index], g[index]
    if scene.floor is not None:
        local[:, 2] = (near.means[:, 2] - scene.floor) / view.radius
    elif len(local):
        local[:, 2] -= local[:, 2].quantile(NO_FLOOR_QUANTILE) if len(local) < 1_000_000 else local[:, 2].min()
    seen = scene.cameras is not None and len(scene.cameras)
    toward = summed_view_directions(g, scene.cameras)[index] if seen else torch.zeros(len(index), 3)
    lengths = near.scales.sort(1).values
    flatness = (1 - lengths[:, 0] / lengths[:, 1].clamp_min(1e-12)).clamp_min(0)
    surfels = ScenePoints(local, cielab(near), shortest_axes(near.quats, near.scales), flatness, toward)
    return surfels, index, view


def cielab(g: Gaussians) -> Float[Tensor, "n 3"]:
    """Convert base colours (degree 0 of the spherical harmonics) to CIELAB."""
    return cielab_of((g.sh[:, 0] * C0 + 0.5).nan_to_num(0.5))


def cielab_of(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Convert sRGB in 0..1 to CIELAB."""
    return torch.from_numpy(cv2.cvtColor(rgb.clamp(0, 1).numpy().astype(np.float32)[None], cv2.COLOR_RGB2LAB)[0])
