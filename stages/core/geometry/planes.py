"""Planes normal . x = offset: least-squares fit and RANSAC."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor


class Plane(NamedTuple):
    """The points x with normal . x = offset; `normal` has unit length."""

    normal: Tensor  # (3,)
    offset: float

    def heights(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distances, positive on the side to which the normal points."""
        return points @ self.normal - self.offset


def fit_plane(points: Float[Tensor, "n 3"], weights: Float[Tensor, "n"] | None = None) -> Plane:
    """Weighted least-squares plane through at least three points; the sign of its normal is arbitrary."""
    w = torch.ones_like(points[:, 0]) if weights is None else weights
    centre = (points * w[:, None]).sum(0) / w.sum()
    centred = points - centre
    normal = torch.linalg.eigh((centred * w[:, None]).mT @ centred).eigenvectors[:, 0]
    return Plane(normal, float(normal @ centre))


def planes_through(triples: Float[Tensor, "k 3 3"]) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k"]]:
    """Unit normals and offsets of the planes through triples of points; collinear points give a zero normal."""
    a, b, c = triples.unbind(1)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a))
    return normals, (normals * a).sum(1)


def _count_within(
    points: Float[Tensor, "n 3"], normals: Float[Tensor, "k 3"], offsets: Float[Tensor, "k"], threshold: float
) -> Float[Tensor, "k"]:
    """Number of points within `threshold` of each plane, in place; call it with so few planes that all fit in cache."""
    distance = (points @ normals.mT).sub_(offsets).abs_()
    return torch.lt(distance, threshold, out=distance).sum(0)


def ransac(
    points: Float[Tensor, "n 3"],
    threshold: float,
    weights: Float[Tensor, "n"] | None = None,
    allowed: Callable[[Float[Tensor, "k 3"]], Bool[Tensor, "k"]] | None = None,
    trials: int = 2000,
    seed: int = 0,
) -> tuple[Plane, Bool[Tensor, "n"]] | None:
    """The plane with the largest total weight of inliers, and their mask; None if there is no plane.

    Inliers are points within `threshold` of the plane. `allowed` maps unit normals to a mask of acceptable ones; each
    candidate is tested with both signs of its normal, and an accepted sign is kept. The best sample is refined by three
    least-squares fits to its inliers.
    Source: Fischler and Bolles 1981, "Random sample consensus".
    """
    if len(points) < 3:
        return None
    weights = torch.ones_like(points[:, 0]) if weights is None else weights
    generator = torch.Generator().manual_seed(seed)
    count = min(len(points), 20_000)
    sample = torch.multinomial(weights.cpu().double(), count, replacement=True, generator=generator).to(points.device)
    draw = torch.randint(len(sample), (trials, 3), generator=generator).to(points.device)
    normals, offsets = planes_through(points[sample][draw])
    normals, offsets = torch.cat([normals, -normals]), torch.cat([offsets, -offsets])
    good = normals.norm(dim=1) > 0.5
    if allowed is not None:
        good &= allowed(normals)
    if not good.any():
        return None
    normals, offsets = normals[good], offsets[good]
    drawn = points[sample]  # drawn by weight, so counts of them are weighted
    counts = [_count_within(drawn, n, d, threshold) for n, d in zip(normals.split(64), offsets.split(64), strict=True)]
    best = int(torch.cat(counts).argmax())
    plane = Plane(normals[best], float(offsets[best]))
    for _ in range(3):
        inside = plane.heights(points).abs() < threshold
        if int(inside.sum()) < 3:
            break
        better = fit_plane(points[inside], weights[inside])
        flip = -1.0 if float(better.normal @ plane.normal) < 0 else 1.0
        plane = Plane(better.normal * flip, better.offset * flip)
    return plane, plane.heights(points).abs() < threshold
