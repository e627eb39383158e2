"""Point clouds for registration: smoothed, thinned points with normals and colours, normalised to diameter 1."""

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

MAX_RAW_POINTS = 30_000  # most points before smoothing
TARGET_POINTS = 3000  # approximate number of smoothed points
SMOOTHING_RADIUS = 0.03  # radius of the neighbourhood for smoothing [diameter of the whole object]
MAX_NEIGHBOURS = 32  # most neighbours from which a point is smoothed
MIN_NEIGHBOURS = 4  # fewest neighbours of a point that is kept, as its normal needs them
COLOUR_WEIGHT = 1 / 400  # diameters per CIELAB unit: 20 units, such as red against orange, are 0.05
LIGHTNESS_WEIGHT = 0.6  # weight of lightness relative to hue, since shading changes lightness


@dataclass(frozen=True)
class RegistrationCloud:
    """Points of an object after x -> (x - centre) / diameter, smoothed and raw.

    Random numbers are drawn on the CPU, so that a seed gives the same cloud on every device.
    """

    points: Float[Tensor, "n 3"]  # smoothed
    normals: Float[Tensor, "n 3"]  # of arbitrary sign
    colours: Float[Tensor, "n 3"]  # CIELAB with weighted lightness, see `cloud_colours` [diameter]
    raw: Float[Tensor, "m 3"]  # points before smoothing
    raw_colours: Float[Tensor, "m 3"]
    centre: Float[Tensor, "3"]  # [scene units]
    diameter: float  # [scene units]

    @staticmethod
    def of(g: Gaussians, seed: int = 0) -> RegistrationCloud:
        """The cloud of the means and base colours of Gaussians; at least two means must differ."""
        generator = torch.Generator().manual_seed(seed)
        centre, across = g.means.median(0).values, diameter(g.means)
        sample = torch.randperm(len(g), generator=generator)[:MAX_RAW_POINTS].to(g.means.device)
        points = (g.means[sample] - centre) / across
        colours = cloud_colours(g.sh[sample, 0] * C0 + 0.5)
        return RegistrationCloud(*smooth_points(points, colours, SMOOTHING_RADIUS), points, colours, centre, across)

    def as_seen(self, sigma: float, tint: Float[Tensor, "3"], radius: float, seed: int = 0) -> RegistrationCloud:
        """The same object with position noise of standard deviation `sigma` [diameter] and a colour offset `tint`.

        Points are smoothed within `radius` [diameter].
        """
        error = sigma * torch.randn(self.raw.shape, generator=torch.Generator().manual_seed(seed))
        points, normals, colours = smooth_points(self.raw + error.to(self.raw), self.raw_colours + tint, radius)
        return replace(self, points=points, normals=normals, colours=colours)

    def tree(self) -> KDTree | BruteForce:
        """Search structure for nearest points in the joint space of position and colour."""
        return neighbour_index(torch.cat([self.points, self.colours], 1))


def cloud_colours(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """CIELAB colours times COLOUR_WEIGHT and LIGHTNESS_WEIGHT [diameter]; computed on the CPU."""
    pixels = rgb.clamp(0, 1).float().cpu().numpy()[None]
    values = torch.from_numpy(cv2.cvtColor(pixels, cv2.COLOR_RGB2LAB)[0])
    return (values * torch.tensor([LIGHTNESS_WEIGHT, 1.0, 1.0]) * COLOUR_WEIGHT).to(rgb.device)


def diameter(points: Float[Tensor, "n 3"]) -> float:
    """Approximate largest distance between two points, by four steps from a point to the farthest point."""
    at, best = points[0], 0.0
    for _ in range(4):
        distance = (points - at).norm(dim=1)
        at, best = points[distance.argmax()], max(best, float(distance.max()))
    return best


def smooth_points(
    points: Float[Tensor, "n 3"], colours: Float[Tensor, "n 3"], radius: float
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Smooth and thin a cloud; returns points, normals and mean colours.

    Evenly spaced points are projected onto the fitted plane of their neighbours within `radius`.
    """
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
    """Indices of one point per cell of a grid; the cell size is iterated so that about `count` points are left.

    The number of cells of a surface is proportional to size^-2.
    """
    low, cell = points.amin(0), float((points.amax(0) - points.amin(0)).max()) / 40
    for _ in range(3):
        cells = ((points - low) / cell).long()
        _, owner = torch.unique((cells[:, 0] * 4096 + cells[:, 1]) * 4096 + cells[:, 2], return_inverse=True)
        filled = int(owner.max()) + 1
        cell = max(cell * (filled / count) ** 0.5, 1e-3)
    first = owner.new_full((filled,), len(points))
    return first.scatter_reduce_(0, owner, torch.arange(len(points), device=owner.device), "amin")
