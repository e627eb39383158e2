"""Mass properties for the learned engine: volume, centre of mass and inertia of filled objects; masses of keypoints."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.kernels.threads import parallel_map
from stages.core.physics.particles import connected, usable
from stages.core.physics.signed_distance import distance_grid, mass_properties
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.scene import Scene

SMALLEST_SHARE = 0.1  # lower bound of the mass of a keypoint, relative to the mean mass


@dataclass(frozen=True)
class SolidBody:
    """Mass properties of a filled object of uniform density at its reconstructed position, in scene units."""

    volume: float
    centre: Float[Tensor, "3"]  # centre of mass
    inertia: Float[Tensor, "3 3"]  # inertia tensor about the centre of mass, per unit mass


@cached_in_scene
def solid_bodies(scene: Scene, sheet: float, device: str = "cpu") -> list[SolidBody]:
    """The solid bodies of all objects, in their order, from the centres of their Gaussians.

    Open sheets get the thickness `sheet` [scene units]. The signed distance grids are computed on `device`.
    """
    g = scene.gaussians.to("cpu")
    good = usable(g)

    def body(object_id: int) -> SolidBody:
        mine = (g.object_id == object_id) & g.means.isfinite().all(1)
        surface = g.means[mine & good] if bool((mine & good).any()) else g.means[mine]
        grid = distance_grid(surface[connected(surface)].to(device), sheet)
        volume, centre, inertia = mass_properties(grid)
        return SolidBody(volume, centre.cpu(), inertia.cpu())

    return parallel_map(body, [o.id for o in scene.objects])


def mass_fractions(points: Float[Tensor, "k 3"], centre: Float[Tensor, "3"]) -> Float[Tensor, "k"]:
    """Mass fractions of points, as equal as possible in the least-squares sense, with the given centre of mass.

    Fractions are clamped to SMALLEST_SHARE of the mean; the centre of mass is then only approximate.
    """
    offset = (points - points.mean(0)).double()
    spread = offset.T @ offset / len(points)
    spread = spread + 1e-6 * spread.trace().clamp_min(1e-30) * torch.eye(3, dtype=spread.dtype)
    share = 1 + offset @ torch.linalg.solve(spread, (centre - points.mean(0)).double())
    share = share.clamp_min(SMALLEST_SHARE)
    return (share / share.sum()).to(points)
