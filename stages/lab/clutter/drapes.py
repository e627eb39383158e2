"""Crumpled blankets, clothes and cushions under and among the objects: uneven ground that is not an object."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stages.lab.assets.shapes import Surface, noise

Rng = np.random.Generator
DRAPE_SHARE = 0.4  # fraction of scenes with drapes
CELLS = 48  # grid points along each side of the height field
RIM = 0.002  # height above which a point is covered by cloth [camera distances]


@dataclass(frozen=True)
class Drape:
    """A height field over a rectangle, zero where there is no cloth; lengths in camera distances."""

    heights: Float[Tensor, "CELLS CELLS"]  # height at each node, indexed by row (y) and column (x)
    half: tuple[float, float]  # half sides of the rectangle
    at: tuple[float, float]  # centre of the rectangle
    yaw: float  # rotation about z [rad]

    def local(self, xy: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """Coordinates in the rectangle, from -1 to 1."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        turned = (xy - torch.tensor(self.at)) @ torch.tensor([[c, -s], [s, c]])
        return turned / torch.tensor(self.half)

    def height(self, xy: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        """Heights at points of the plane, interpolated bilinearly; 0 outside the rectangle."""
        grid = self.local(xy)[None, None]
        return torch.nn.functional.grid_sample(
            self.heights[None, None], grid, padding_mode="zeros", align_corners=True
        ).flatten()

    def surface(self, spacing: float) -> Surface:
        """Points on the cloth with normals, on a grid of this spacing."""
        reach = math.hypot(*self.half)
        line = torch.arange(-reach, reach, spacing)
        xy = torch.cartesian_prod(line, line) + torch.tensor(self.at)
        z = self.height(xy)
        step = 0.5 * spacing
        slope = [(self.height(xy + d) - self.height(xy - d)) / (2 * step) for d in step * torch.eye(2)]
        normals = torch.nn.functional.normalize(torch.stack([-slope[0], -slope[1], torch.ones(len(z))], 1), dim=1)
        return Surface(torch.cat([xy, z[:, None]], 1), normals).kept(z > RIM)


def random_drapes(used: tuple[float, float], rng: Rng) -> list[Drape]:
    """No drapes in most scenes, otherwise one or two within `used`, the half sides of the area where objects drop."""
    if rng.uniform() > DRAPE_SHARE:
        return []
    return [_drape(used, rng) for _ in range(int(rng.integers(1, 3)))]


def _drape(used: tuple[float, float], rng: Rng) -> Drape:
    half = (rng.uniform(0.12, 0.5), rng.uniform(0.12, 0.4))
    line = torch.linspace(-1, 1, CELLS)
    v, u = torch.meshgrid(line, line, indexing="ij")
    flat = torch.stack([u * half[0], v * half[1], torch.zeros_like(u)], -1).view(-1, 3) + 5
    seed, power, stretch = int(rng.integers(1 << 30)), rng.uniform(2, 6), rng.uniform(0, math.pi)

    def waves(size: float, number: int, squeeze: float = 1.0) -> Tensor:
        c, s = math.cos(stretch), math.sin(stretch)
        along = torch.stack([c * flat[:, 0] + s * flat[:, 1], squeeze * (c * flat[:, 1] - s * flat[:, 0]), flat[:, 2]])
        return noise(along.T + 9, size, seed + number).view(CELLS, CELLS)

    outline = (u.abs() ** power + v.abs() ** power) ** (1 / power) + rng.uniform(0, 0.5) * (waves(0.15, 0) - 0.5)
    rim = ((0.92 - outline) / rng.uniform(0.1, 0.4)).clamp(0, 1)
    inner = rim * rim * (3 - 2 * rim)
    folds = sum(k * (1 - (2 * waves(size, n, 2.5) - 1).abs()) ** 2 for n, size, k in ((1, 0.16, 1.0), (2, 0.07, 0.4)))
    body = rng.uniform(0, 0.1) * (1 - 0.5 * (u * u + v * v)).clamp(0, 1)  # bulge of a cushion
    heights = inner * (0.006 + math.exp(rng.uniform(math.log(0.004), math.log(0.05))) * folds + body)
    at = (rng.uniform(-0.6, 0.6) * used[0], rng.uniform(-0.6, 0.6) * used[1])
    return Drape(heights.contiguous(), half, at, rng.uniform(0, 2 * math.pi))
