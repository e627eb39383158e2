"""What the cameras saw through, and so know to be empty."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.geometry.cameras import depths, project
from stages.core.perception.visibility import downscaled_views
from stages.core.raster.rasterise import rasterise, visibility
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene

FAR = 1e9


@dataclass(frozen=True)
class ObservedSpace:
    """Views with the depth of the nearest surface in each pixel: FAR where nothing is, 0 where it is not known."""

    views: list[tuple[Tensor, Tensor, int, int]]  # viewmat, K, width, height
    depth: list[Float[Tensor, "h w"]]
    weight: Float[Tensor, "n"]  # of each Gaussian in the view where it weighs most [px]; empty without views

    @staticmethod
    @torch.no_grad()
    def of(scene: Scene) -> ObservedSpace:
        """Depths drawn from the scene itself; each pixel takes the least of its neighbours, to be careful."""
        if scene.cameras is None or not len(scene.cameras):
            return ObservedSpace([], [], torch.zeros(0))
        views, maps = downscaled_views(scene.cameras), []
        weight = torch.zeros(len(scene.gaussians))
        for viewmat, K, width, height in views:
            drawn = rasterise(scene.gaussians, viewmat[None], K[None], width, height)
            depth = torch.where(drawn.alpha[0] > 0.9, drawn.depth[0], 0.0)
            depth = torch.where(drawn.alpha[0] < 0.05, FAR, depth)
            maps.append(-torch.nn.functional.max_pool2d(-depth[None], 3, 1, 1)[0])
            weight = torch.maximum(weight, visibility(scene.gaussians, viewmat, K, width, height)[1])
        return ObservedSpace(views, maps, weight)

    def empty(self, points: Float[Tensor, "n 3"], margin: float) -> Bool[Tensor, "n"]:
        """Points that a camera sees more than `margin` in front of the surface behind them.

        Of six cameras or more two must agree, since one may have a floater's depth.
        """
        count = torch.zeros(len(points), dtype=torch.int64)
        for inside, z, depth in self._depths(points):
            count[inside] += (z < depth - margin).long()
        return count >= (2 if len(self.views) >= 6 else 1)

    def share(self, points: Float[Tensor, "n 3"], margin: float) -> Float[Tensor, "n"]:
        """Of the cameras that have a point in their picture, how many see it: nothing is `margin` in front of it."""
        seen, framed = torch.zeros(len(points)), torch.zeros(len(points))
        for inside, z, depth in self._depths(points):
            framed += inside
            seen[inside] += (depth > z - margin).float()
        return seen / framed.clamp_min(1)

    def _depths(self, points: Float[Tensor, "n 3"]) -> Iterator[tuple[Bool[Tensor, "n"], Tensor, Tensor]]:
        """For each view which points are in its picture, their depth, and that of the surface drawn there."""
        for (viewmat, K, width, height), depth in zip(self.views, self.depth, strict=True):
            z = depths(points, viewmat)
            pixel = project(points, viewmat, K).nan_to_num(-1).clamp(-1, 1e6).floor().long()
            inside = (z > 0.01) & (pixel >= 0).all(1) & (pixel[:, 0] < width) & (pixel[:, 1] < height)
            x, y = pixel[inside].T
            yield inside, z[inside], depth[y, x]

    def hidden(self, scene: Gaussians, more: Gaussians, most: float = 0.3, leak: float = 0.1) -> Bool[Tensor, "m"]:
        """Which of the Gaussians that might be added to the scene hardly change what the cameras see.

        One may weigh `most` pixels (of the small images) in a view; or, since fur lets a little through and a patch
        behind it is wide, the share `leak` of what it would weigh with nothing in front.
        """
        keep = torch.ones(len(more), dtype=torch.bool)
        joint = concatenate([scene, more])
        for viewmat, K, width, height in self.views:
            weight = visibility(joint, viewmat, K, width, height)[1][len(scene) :]
            bare = visibility(more, viewmat, K, width, height)[1]
            keep &= weight <= (leak * bare).clamp_min(most)
        return keep


@torch.no_grad()
def object_psnr(before: Scene, after: Scene, most: int = 4) -> float | None:
    """PSNR [dB] between two states of a scene in the pixels where the objects are, over a few of its cameras."""
    if before.cameras is None or not len(before.cameras):
        return None
    error = count = 0.0
    for viewmat, K, width, height in downscaled_views(before.cameras, most):
        one, two = (rasterise(s.gaussians, viewmat[None], K[None], width, height).rgb[0] for s in (before, after))
        index, _ = visibility(before.gaussians, viewmat, K, width, height)
        on = (index >= 0) & (before.gaussians.object_id[index.clamp_min(0)] > 0)
        error += float((one.clamp(0, 1) - two.clamp(0, 1))[on].square().sum())
        count += 3 * float(on.sum())
    return None if not count else -10 * math.log10(max(error / count, 1e-10))
