"""Shadows in the frames of a trajectory: find light and occluders once, then shade the Gaussians of each frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.physics.lighting import estimate_light
from stages.core.physics.occluders import Occluders, make_occluders
from stages.core.raster.shadows import Light, irradiance, shaded, shadow_factor
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Keypoints


@dataclass(frozen=True)
class ShadowCaster:
    """Shades Gaussians by the objects that have moved from where the photos show them."""

    light: Light
    occluders: Occluders

    def rest_irradiance(self, rest: Gaussians) -> Float[Tensor, "n"]:
        """Irradiance that is baked into the colours of the Gaussians at rest."""
        if not self.light.in_colours:
            return torch.ones_like(rest.opacities)
        return irradiance(rest.means, rest.object_id, self.occluders.rest, self.light)

    def shade(self, g: Gaussians, positions: Float[Tensor, "p 3"], at_rest: Float[Tensor, "n"]) -> Gaussians:
        """Shade the Gaussians of a frame for these keypoint positions; `at_rest` is the result of `rest_irradiance`."""
        spheres = self.occluders.moved(positions, fade=not self.light.in_colours)
        if bool((spheres.centres == self.occluders.rest.centres).all()):
            return g
        now = irradiance(g.means, g.object_id, spheres, self.light)
        return shaded(g, shadow_factor(now, at_rest, self.light))


def find_shadows(
    scene: Scene, keypoints: Keypoints, other_background: bool = False, device: str = "cpu"
) -> ShadowCaster | None:
    """Light and occluders of a scene at rest, for frames on `device`; None without objects that move.

    With `other_background` the background is not the one of the photos, so its colours contain no shadows.
    """
    occluders = make_occluders(scene, keypoints, device)
    if occluders is None:
        return None
    light = estimate_light(scene, occluders.rest, device)
    return ShadowCaster(replace(light, in_colours=light.in_colours and not other_background), occluders)
