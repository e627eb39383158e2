"""Observed space: which points camera rays passed through, and which lie on observed surfaces, from depth maps."""

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

FAR = 1e9  # depth of pixels without a surface
MIN_OPAQUE_ALPHA, MAX_EMPTY_ALPHA = 0.9, 0.05  # minimum alpha of a surface, maximum of an empty pixel; else unknown
MAX_HIDDEN_WEIGHT = 0.3  # largest weight in any view of a Gaussian that counts as hidden [px of the downscaled images]
MIN_VIEWS_FOR_TWO = 6  # minimum number of cameras for which two must agree that a point is free


@dataclass(frozen=True)
class ObservedSpace:
    """Depth maps of the scene's views: the nearest surface, FAR in empty pixels, 0 in unknown ones."""

    views: list[tuple[Tensor, Tensor, int, int]]  # viewmat, K, width, height
    depth: list[Float[Tensor, "h w"]]
    weight: Float[Tensor, "n"]  # largest weight of each Gaussian over the views [px]; empty without views
    device: str = "cpu"  # on which views are rendered; the maps are on the CPU

    @staticmethod
    @torch.no_grad()
    def of(scene: Scene, device: str = "cpu") -> ObservedSpace:
        """Depth maps rendered from the scene; each pixel takes the minimum over 3 x 3 pixels, to be conservative."""
        if scene.cameras is None or not len(scene.cameras):
            return ObservedSpace([], [], torch.zeros(0))
        views, maps, g = downscaled_views(scene.cameras), [], scene.gaussians.to(device)
        weight = torch.zeros(len(g), device=g.means.device)
        for viewmat, K, width, height in views:
            seen = visibility(g, viewmat, K, width, height)
            depth = torch.where(seen.alpha > MIN_OPAQUE_ALPHA, seen.depth, 0.0)
            depth = torch.where(seen.alpha < MAX_EMPTY_ALPHA, FAR, depth)
            maps.append(-torch.nn.functional.max_pool2d(-depth[None], 3, 1, 1)[0].cpu())
            weight = torch.maximum(weight, seen.weight)
        return ObservedSpace(views, maps, weight.cpu(), device)

    def is_free(self, points: Float[Tensor, "n 3"], margin: float) -> Bool[Tensor, "n"]:
        """Mask of points more than `margin` in front of the surface in the depth map of a camera [scene units].

        With MIN_VIEWS_FOR_TWO cameras or more, two must agree, since a floater may corrupt one depth map.
        """
        count = torch.zeros(len(points), dtype=torch.int64)
        for inside, z, depth in self.surface_depths(points):
            count[inside] += (z < depth - margin).long()
        return count >= (2 if len(self.views) >= MIN_VIEWS_FOR_TWO else 1)

    def visible_fraction(self, points: Float[Tensor, "n 3"], margin: float) -> Float[Tensor, "n"]:
        """Fraction of the cameras with a point in their image that see it: no surface is `margin` or more before it."""
        seen, framed = torch.zeros(len(points)), torch.zeros(len(points))
        for inside, z, depth in self.surface_depths(points):
            framed += inside
            seen[inside] += (depth > z - margin).float()
        return seen / framed.clamp_min(1)

    def surface_depths(self, points: Float[Tensor, "n 3"]) -> Iterator[tuple[Bool[Tensor, "n"], Tensor, Tensor]]:
        """For each view: which points are in its image, their depths, and the depths of the surface there."""
        for (viewmat, K, width, height), depth in zip(self.views, self.depth, strict=True):
            z = depths(points, viewmat)
            pixel = project(points, viewmat, K).nan_to_num(-1).clamp(-1, 1e6).floor().long()
            inside = (z > 0.01) & (pixel >= 0).all(1) & (pixel[:, 0] < width) & (pixel[:, 1] < height)
            x, y = pixel[inside].T
            yield inside, z[inside], depth[y, x]

    def is_hidden(
        self, scene: Gaussians, added: Gaussians, max_weight: float = MAX_HIDDEN_WEIGHT, max_leak: float = 0.1
    ) -> Bool[Tensor, "m"]:
        """Mask of the `added` Gaussians that could be added to the scene with almost no change of its images.

        In each view, a Gaussian's weight must not exceed the larger of `max_weight` [px of the downscaled images] and
        `max_leak` times its unoccluded weight: a large disc behind a slightly transparent surface has some weight.
        """
        joint, added = concatenate([scene, added]).to(self.device), added.to(self.device)
        keep = torch.ones(len(added), dtype=torch.bool, device=self.device)
        for viewmat, K, width, height in self.views:
            weight = visibility(joint, viewmat, K, width, height).weight[len(scene) :]
            bare = visibility(added, viewmat, K, width, height).weight
            keep &= weight <= (max_leak * bare).clamp_min(max_weight)
        return keep.cpu()


@torch.no_grad()
def object_psnr(before: Scene, after: Scene, max_views: int = 4, device: str = "cpu") -> float | None:
    """PSNR [dB] between two states of a scene over the pixels of objects in at most `max_views` views, or None."""
    if before.cameras is None or not len(before.cameras):
        return None
    error = count = 0.0
    states = [scene.gaussians.to(device) for scene in (before, after)]
    for viewmat, K, width, height in downscaled_views(before.cameras, max_views):
        one, *_, index, _ = visibility(states[0], viewmat, K, width, height)
        two = rasterise(states[1], viewmat[None], K[None], width, height).rgb[0]
        on = (index >= 0) & (states[0].object_id[index.clamp_min(0)] > 0)
        error += float((one.clamp(0, 1) - two.clamp(0, 1))[on].square().sum())
        count += 3 * float(on.sum())
    return None if not count else -10 * math.log10(max(error / count, 1e-10))
