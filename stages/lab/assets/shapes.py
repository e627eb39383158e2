"""Sampled surfaces (points with normals), value noise, and their conversion to Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.harmonics import rgb_to_sh
from stages.core.geometry.rotations import quaternion
from stages.core.scene.gaussians import Gaussians


@contextmanager
def single_threaded() -> Iterator[None]:
    """Run PyTorch on one thread inside the context, so that results are bitwise reproducible.

    The vectorised and scalar versions of sin or pow differ in the last bit, and the number of threads that process a
    tensor determines which version computes an element.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@dataclass(frozen=True)
class Surface:
    """Evenly spaced points on a surface, with outward unit normals."""

    points: Float[Tensor, "n 3"]  # [m]
    normals: Float[Tensor, "n 3"]

    def moved(self, offset: tuple[float, float, float]) -> Surface:
        """The surface translated by `offset` [m]."""
        return Surface(self.points + torch.tensor(offset), self.normals)

    def kept(self, mask: Tensor) -> Surface:
        """The points where `mask` (n,) is true."""
        return Surface(self.points[mask], self.normals[mask])


def ellipsoid(radii: tuple[float, float, float], n: int) -> Surface:
    """Fewer than `n` points on an ellipsoid: a stretched Fibonacci spiral, subsampled to uniform density."""
    i = torch.arange(n) + 0.5
    z = 1 - 2 * i / n
    phi = i * torch.pi * (1 + 5**0.5)
    flat = (1 - z * z).sqrt()
    unit = torch.stack([flat * phi.cos(), flat * phi.sin(), z], 1)
    r = torch.tensor(radii)
    normals = torch.nn.functional.normalize(unit / r, dim=1)
    area = (unit / r).norm(dim=1)  # area per point after stretching, up to a constant factor
    keep = torch.rand(n, generator=torch.Generator().manual_seed(n)) < area / area.max()
    return Surface(unit * r, normals).kept(keep)


def superellipsoid(radii: tuple[float, float, float], power: float, n: int) -> Surface:
    """Points on |x/a|^p + |y/b|^p + |z/c|^2 = 1, which is a cushion for p > 2."""
    rng = torch.Generator().manual_seed(n)
    r = torch.tensor(radii)
    xy = (torch.rand(n, 2, generator=rng) * 2 - 1) * r[:2]
    inside = 1 - (xy / r[:2]).abs().pow(power).sum(1)
    xy, inside = xy[inside > 0], inside[inside > 0]
    z = r[2] * inside.sqrt() * torch.where(torch.arange(len(xy)) % 2 == 0, 1.0, -1.0)
    slope = power / r[:2] * (xy / r[:2]).abs().pow(power - 1) * xy.sign()
    normals = torch.nn.functional.normalize(torch.cat([slope, (2 * z / r[2] ** 2)[:, None]], 1), dim=1)
    return Surface(torch.cat([xy, z[:, None]], 1), normals)


def box(sides: tuple[float, float, float], spacing: float) -> Surface:
    """Grid points on the six faces of a box centred on the origin."""
    half = torch.tensor(sides) / 2
    points, normals = [], []
    for axis in range(3):
        u, v = [a for a in range(3) if a != axis]
        cells = [max(int(2 * half[a] / spacing), 2) for a in (u, v)]
        grid = [(torch.arange(c) + 0.5) / c * 2 - 1 for c in cells]
        face = torch.cartesian_prod(*grid) * half[[u, v]]
        for side in (-1.0, 1.0):
            p, normal = torch.zeros(len(face), 3), torch.zeros(len(face), 3)
            p[:, [u, v]], p[:, axis], normal[:, axis] = face, side * half[axis], side
            points.append(p)
            normals.append(normal)
    return Surface(torch.cat(points), torch.cat(normals))


def sheet(width: float, depth: float, spacing: float) -> Surface:
    """Grid points on a horizontal rectangle at z = 0, with normals up."""
    xs, ys = (torch.arange(0, side, spacing) - side / 2 for side in (width, depth))
    points = torch.nn.functional.pad(torch.cartesian_prod(xs, ys), (0, 1))
    return Surface(points, torch.tensor([[0.0, 0, 1]]).expand_as(points).clone())


def union(*parts: Callable[[], tuple[Surface, Callable[[Tensor], Tensor]]]) -> Surface:
    """Union of (surface, inside test) pairs: the points of each surface that are not inside another."""
    pieces = []
    for i, (surface, _) in enumerate(parts):
        hidden = torch.zeros(len(surface.points), dtype=torch.bool)
        for j, (_, inside) in enumerate(parts):
            hidden |= inside(surface.points) if i != j else False
        pieces.append(surface.kept(~hidden))
    return Surface(torch.cat([p.points for p in pieces]), torch.cat([p.normals for p in pieces]))


def noise(points: Float[Tensor, "n 3"], size: float, seed: int) -> Float[Tensor, "n"]:
    """Smooth value noise in 0..1 with features of the given size [m]; deterministic for a seed."""
    lattice = torch.rand(64, 64, 64, generator=torch.Generator().manual_seed(seed))
    cell = (points / size).floor()
    f = points / size - cell
    f = f * f * (3 - 2 * f)
    total = torch.zeros(len(points))
    for corner in range(8):
        bits = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1])
        weight = torch.where(bits.bool(), f, 1 - f).prod(1)
        i, j, k = (cell.long() + bits).remainder(64).unbind(1)
        total += weight * lattice[i, j, k]
    return total


def to_gaussians(
    surface: Surface, rgb: Float[Tensor, "n 3"], object_id: int, opacity: float = 0.95, width: float = 0.7,
    widest: float = 0.05,
) -> Gaussians:  # fmt: skip
    """Flat Gaussians that cover the surface: discs with a standard deviation of `width` times the local point spacing.

    The spacing is limited to `widest` [m], which concerns isolated points.
    """
    from stages.core.geometry.neighbours import spacing

    n = len(surface.points)
    normal = surface.normals
    tangent = torch.where((normal[:, :1].abs() < 0.9), torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]))
    u = torch.nn.functional.normalize(torch.linalg.cross(tangent, normal), dim=1)
    R = torch.stack([u, torch.linalg.cross(normal, u), normal], -1)
    s = spacing(surface.points, 4).clamp_max(widest)
    return Gaussians(
        surface.points.contiguous(), quaternion(R), torch.stack([width * s, width * s, 0.15 * s], 1),
        torch.full((n,), opacity), rgb_to_sh(rgb.clamp(0.02, 0.98)), torch.full((n,), object_id),
    )  # fmt: skip
