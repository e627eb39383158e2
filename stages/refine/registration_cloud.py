"""Gaussians as a thinned point cloud for registration: smoothed points, normals and colours, of diameter 1."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import C0
from stages.core.geometry.neighbours import BruteForce, KDTree, neighbour_index
from stages.core.geometry.symmetric_matrices import eigh
from stages.core.scene.gaussians import Gaussians

MAX_RAW_POINTS = 30_000  # that points are smoothed from
TARGET_POINTS = 3000  # approximate number of smoothed points
SMOOTHING_RADIUS = 0.03  # [diameters of the whole object]
MAX_NEIGHBOURS = 32  # that one point is smoothed from
MIN_NEIGHBOURS = 4  # of a point with a normal; others are dropped
COLOUR_WEIGHT = 1 / 400  # diameters per CIELAB unit: 20 units, red against orange, are 0.05
LIGHTNESS_WEIGHT = 0.6  # relative to hue, since shading changes lightness


@dataclass(frozen=True)
class RegistrationCloud:
    """Points of an object after x -> (x - centre) / diameter, smoothed and raw.

    Random numbers are drawn on the CPU, so that a seed gives the same cloud on every device.
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]  # of either sign
    colours: Float[Tensor, "n 3"]  # CIELAB, lightness times LIGHTNESS_WEIGHT [diameters]
    raw: Float[Tensor, "m 3"]  # not smoothed
    raw_colours: Float[Tensor, "m 3"]
    centre: Float[Tensor, "3"]
    diameter: float  # [units of the scene]

    @staticmethod
    def of(g: Gaussians, seed: int = 0) -> RegistrationCloud:
        """The cloud of Gaussians, by means and base colours; at least two means must differ."""
        generator = torch.Generator().manual_seed(seed)
        centre, across = g.means.median(0).values, diameter(g.means)
        sample = torch.randperm(len(g), generator=generator)[:MAX_RAW_POINTS].to(g.means.device)
        points = (g.means[sample] - centre) / across
        colours = cloud_colours(g.sh[sample, 0] * C0 + 0.5)
        return RegistrationCloud(*smooth_points(points, colours, SMOOTHING_RADIUS), points, colours, centre, across)

    def as_seen(self, sigma: float, tint: Float[Tensor, "3"], radius: float, seed: int = 0) -> RegistrationCloud:
        """The same object with position noise of standard deviation `sigma` [diameters] and a colour offset `tint`."""
        error = sigma * torch.randn(self.raw.shape, generator=torch.Generator().manual_seed(seed))
        points, normals, colours = smooth_points(self.raw + error.to(self.raw), self.raw_colours + tint, radius)
        return replace(self, points=points, normals=normals, colours=colours)

    def tree(self) -> KDTree | BruteForce:
        """Search structure for nearest points in joint position and colour."""
        return neighbour_index(torch.cat([self.points, self.colours], 1))


def cloud_colours(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Weighted CIELAB colours [diameters]; computed on the CPU."""
    pixels = rgb.clamp(0, 1).float().cpu().numpy()[None]
    values = torch.from_numpy(cv2.cvtColor(pixels, cv2.COLOR_RGB2LAB)[0])
    return (values * torch.tensor([LIGHTNESS_WEIGHT, 1.0, 1.0]) * COLOUR_WEIGHT).to(rgb.device)


def diameter(points: Float[Tensor, "n 3"]) -> float:
    """Approximate largest distance of two points: four steps from a point to the one farthest from it."""
    at, best = points[0], 0.0
    for _ in range(4):
        distance = (points - at).norm(dim=1)
        at, best = points[distance.argmax()], max(best, float(distance.max()))
    return best


def smooth_points(
    points: Float[Tensor, "n 3"], colours: Float[Tensor, "n 3"], radius: float
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Evenly spaced points projected onto the plane of their neighbours within `radius`, normals, mean colours."""
    picked = thin_indices(points, TARGET_POINTS)
    distance, index = neighbour_index(points).query(points[picked], MAX_NEIGHBOURS, radius)
    near = distance.isfinite()[..., None].float()
    count = near.sum(1)
    middle = (points[index] * near).sum(1) / count
    centred = (points[index] - middle[:, None]) * near
    normals = eigh(centred.mT @ centred)[1][..., 0]
    at = points[picked]
    moved = at + ((middle - at) * normals).sum(1, keepdim=True) * normals
    colour = (colours[index] * near).sum(1) / count
    keep = count[:, 0] >= MIN_NEIGHBOURS
    return moved[keep], normals[keep], colour[keep]


def thin_indices(points: Float[Tensor, "n 3"], count: int) -> Int[Tensor, "m"]:
    """Indices of one point per cell, with a cell size that leaves about `count` (the number of cells ~ size^-2)."""
    low, cell = points.amin(0), float((points.amax(0) - points.amin(0)).max()) / 40
    for _ in range(3):
        cells = ((points - low) / cell).long()
        _, owner = torch.unique((cells[:, 0] * 4096 + cells[:, 1]) * 4096 + cells[:, 2], return_inverse=True)
        filled = int(owner.max()) + 1
        cell = max(cell * (filled / count) ** 0.5, 1e-3)
    first = owner.new_full((filled,), len(points))
    return first.scatter_reduce_(0, owner, torch.arange(len(points), device=owner.device), "amin")
