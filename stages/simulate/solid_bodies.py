"""Bodies of the learned engine: keypoints with masses, and the volume and inertia of the filled object."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.kernels.threads import parallel_map
from stages.core.physics.particles import inliers, usable
from stages.core.physics.signed_distance import distance_grid, mass_properties
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.scene import Scene

SMALLEST_SHARE = 0.1  # least mass of a keypoint relative to the mean, when the centre of mass is matched


@dataclass(frozen=True)
class SolidBody:
    """The filled body of an object at its reconstructed position, in scene units."""

    volume: float
    centre: Float[Tensor, "3"]  # of mass
    inertia: Float[Tensor, "3 3"]  # about the centre of mass, per unit of mass


@cached_in_scene
def solid_bodies(scene: Scene, sheet: float, device: str = "cpu") -> list[SolidBody]:
    """The solid body of every object, from the centres of its Gaussians; open sheets get the thickness `sheet`.

    They are computed on `device`.
    """
    g = scene.gaussians.to("cpu")
    good = usable(g)

    def body(object_id: int) -> SolidBody:
        mine = (g.object_id == object_id) & g.means.isfinite().all(1)
        surface = g.means[mine & good] if bool((mine & good).any()) else g.means[mine]
        grid = distance_grid(surface[inliers(surface)].to(device), sheet)
        volume, centre, inertia = mass_properties(grid)
        return SolidBody(volume, centre.cpu(), inertia.cpu())

    return parallel_map(body, [o.id for o in scene.objects])


def mass_fractions(points: Float[Tensor, "k 3"], centre: Float[Tensor, "3"]) -> Float[Tensor, "k"]:
    """Fractions of the mass at points, as equal as possible and with the given centre of mass.

    Least squares; where that takes less than SMALLEST_SHARE at a point, the centre is approximated.
    """
    offset = (points - points.mean(0)).double()
    spread = offset.T @ offset / len(points)
    spread = spread + 1e-6 * spread.trace().clamp_min(1e-30) * torch.eye(3, dtype=spread.dtype)
    share = 1 + offset @ torch.linalg.solve(spread, (centre - points.mean(0)).double())
    share = share.clamp_min(SMALLEST_SHARE)
    return (share / share.sum()).to(points)
