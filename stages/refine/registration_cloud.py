"""Gaussians as a thin cloud for registration: smoothed points with normals and colours, of diameter 1."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import C0
from stages.core.geometry.neighbours import BruteForce, KDTree, neighbour_index
from stages.core.scene.gaussians import Gaussians

MOST = 30_000  # points that are smoothed from
TARGET_POINTS = 3000  # points that are kept, about
SMOOTHING_RADIUS = 0.03  # radius of smoothing [diameters of the whole object]
NEIGHBOURS = 32  # most that one point is smoothed from
COLOUR_WEIGHT = 1 / 400  # diameters that a CIELAB unit counts as: 20 units, red beside orange, are 0.05
LIGHT = 0.6  # weight of lightness, which shading changes, beside hue


@dataclass(frozen=True)
class RegistrationCloud:
    """Points of an object after x -> (x - centre) / diameter, and the same object with all its noise.

    What is drawn at random is drawn on the CPU, so that a seed gives the same cloud on every device.
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]  # of either sign
    colours: Float[Tensor, "n 3"]  # CIELAB, lightness times LIGHT, in diameters
    raw: Float[Tensor, "m 3"]  # not smoothed
    raw_colours: Float[Tensor, "m 3"]
    centre: Float[Tensor, "3"]
    diameter: float  # [units of the scene]

    @staticmethod
    def of(g: Gaussians, seed: int = 0) -> RegistrationCloud:
        """Opacities, sizes and view dependence do not count; g must have at least two points apart."""
        generator = torch.Generator().manual_seed(seed)
        centre, across = g.means.median(0).values, diameter(g.means)
        some = torch.randperm(len(g), generator=generator)[:MOST].to(g.means.device)
        points = (g.means[some] - centre) / across
        colours = cloud_colours(g.sh[some, 0] * C0 + 0.5)
        return RegistrationCloud(*smooth_points(points, colours, SMOOTHING_RADIUS), points, colours, centre, across)

    def as_seen(self, sigma: float, tint: Float[Tensor, "3"], reach: float, seed: int = 0) -> RegistrationCloud:
        """The same object by a sensor with errors of standard deviation `sigma` [diameters], in a tinted light."""
        error = sigma * torch.randn(self.raw.shape, generator=torch.Generator().manual_seed(seed))
        points, normals, colours = smooth_points(self.raw + error.to(self.raw), self.raw_colours + tint, reach)
        return replace(self, points=points, normals=normals, colours=colours)

    def tree(self) -> KDTree | BruteForce:
        """For nearest points in place and colour together."""
        return neighbour_index(torch.cat([self.points, self.colours], 1))


def cloud_colours(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """CIELAB in diameters; worked out on the CPU."""
    pixels = rgb.clamp(0, 1).float().cpu().numpy()[None]
    values = torch.from_numpy(cv2.cvtColor(pixels, cv2.COLOR_RGB2LAB)[0])
    return (values * torch.tensor([LIGHT, 1.0, 1.0]) * COLOUR_WEIGHT).to(rgb.device)


def diameter(points: Float[Tensor, "n 3"]) -> float:
    """Largest distance of two points, or nearly: from the farthest to the one farthest from it, four times."""
    at, best = points[0], 0.0
    for _ in range(4):
        distance = (points - at).norm(dim=1)
        at, best = points[distance.argmax()], max(best, float(distance.max()))
    return best


def smooth_points(
    points: Float[Tensor, "n 3"], colours: Float[Tensor, "n 3"], reach: float
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Evenly spread points moved onto the plane of their neighbours, its normals, and mean colours."""
    picked = thin_indices(points, TARGET_POINTS)
    distance, index = neighbour_index(points).query(points[picked], NEIGHBOURS, reach)
    near = distance.isfinite()[..., None].float()
    count = near.sum(1)
    middle = (points[index] * near).sum(1) / count
    centred = (points[index] - middle[:, None]) * near
    normals = torch.linalg.eigh(centred.mT @ centred).eigenvectors[..., 0]
    at = points[picked]
    moved = at + ((middle - at) * normals).sum(1, keepdim=True) * normals
    colour = (colours[index] * near).sum(1) / count
    keep = count[:, 0] >= 4  # fewer have no plane
    return moved[keep], normals[keep], colour[keep]


def thin_indices(points: Float[Tensor, "n 3"], count: int) -> Int[Tensor, "m"]:
    """One point a cell, of cells so large that about `count` are left: the number of filled ones goes as cell^-2."""
    low, cell = points.amin(0), float((points.amax(0) - points.amin(0)).max()) / 40
    for _ in range(3):
        cells = ((points - low) / cell).long()
        _, owner = torch.unique((cells[:, 0] * 4096 + cells[:, 1]) * 4096 + cells[:, 2], return_inverse=True)
        filled = int(owner.max()) + 1
        cell = max(cell * (filled / count) ** 0.5, 1e-3)
    first = owner.new_full((filled,), len(points))
    return first.scatter_reduce_(0, owner, torch.arange(len(points), device=owner.device), "amin")
