"""Signed distance fields: primitives, transformations and boolean operations.

A field maps points (n, 3) to distances (n,), negative inside. Some fields are only approximate distances; the sampler
divides by the gradient norm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

Field = Callable[[Tensor], Tensor]
Vec = tuple[float, float, float]
TUBE_FAR_DISTANCE = 0.15  # value of tube fields far away, larger than the range of ambient occlusion


def _floats(values: Sequence) -> Tensor:
    """Float tensor of literals, which may be integers."""
    return torch.tensor(values, dtype=torch.float32)


def euler_rotation(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Float[Tensor, "3 3"]:
    """Rotation matrix Rz Ry Rx from angles [deg]."""
    R = torch.eye(3)
    for axis, angle in enumerate((x, y, z)):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        i, j = (axis + 1) % 3, (axis + 2) % 3
        A = torch.eye(3)
        A[i, i], A[i, j], A[j, i], A[j, j] = c, -s, s, c
        R = A @ R
    return R


def sphere(centre: Vec, radius: float) -> Field:
    """A sphere."""
    c = _floats(centre)
    return lambda p: (p - c).norm(dim=1) - radius


def ellipsoid(centre: Vec, radii: Vec, R: Tensor | None = None) -> Field:
    """An ellipsoid rotated by R about its centre; the zero set is exact, the distance accurate to first order."""
    c, r = _floats(centre), _floats(radii)

    def field(p: Tensor) -> Tensor:
        q = (p - c if R is None else (p - c) @ R) / r
        k = q.norm(dim=1)
        return k * (k - 1) / (q / r).norm(dim=1).clamp_min(1e-6)

    return field


def capsule(a: Vec, b: Vec, radius: float, end: float | None = None) -> Field:
    """A capsule from a to b, whose radius changes linearly from `radius` to `end`."""
    start, axis = _floats(a), _floats(b) - _floats(a)
    grow = 0.0 if end is None else end - radius

    def field(p: Tensor) -> Tensor:
        q = p - start
        t = (q @ axis / axis.square().sum()).clamp(0, 1)
        return (q - t[:, None] * axis).norm(dim=1) - radius - grow * t

    return field


def slab(centre: Vec, half: Vec, corner: float, edge: float) -> Field:
    """A box with half sides `half`: corners rounded by `corner` in the x-z plane, all edges rounded by `edge`."""
    c, h = _floats(centre), _floats(half)

    def field(p: Tensor) -> Tensor:
        q = (p - c).abs()
        flat = q[:, [0, 2]] - (h[[0, 2]] - corner)
        outline = flat.clamp_min(0).norm(dim=1) + flat.amax(1).clamp_max(0) - corner
        both = torch.stack([outline, q[:, 1] - h[1]], 1) + edge
        return both.clamp_min(0).norm(dim=1) + both.amax(1).clamp_max(0) - edge

    return field


def torus(centre: Vec, ring: float, tube: float) -> Field:
    """A torus around the vertical axis with ring radius `ring` and tube radius `tube`."""
    c = _floats(centre)

    def field(p: Tensor) -> Tensor:
        q = p - c
        return torch.hypot(q[:, :2].norm(dim=1) - ring, q[:, 2]) - tube

    return field


def revolved(profile: Sequence[tuple[float, float]], rounding: float = 0.0) -> Field:
    """Solid of revolution of a closed polygon of (radius, height) corners, enlarged by `rounding`."""
    outline = polygon(profile)
    return lambda p: outline(torch.stack([p[:, :2].norm(dim=1), p[:, 2]], 1)) - rounding


def revolved_wall(profile: Sequence[tuple[float, float]], thickness: float) -> Field:
    """Surface of revolution of an open polyline of (radius, height) corners, with the given wall thickness."""
    line = polyline(profile)
    return lambda p: line(torch.stack([p[:, :2].norm(dim=1), p[:, 2]], 1)) - thickness / 2


def tube(curve: Float[Tensor, "m 3"], radius: Float[Tensor, "m"] | float) -> Field:
    """A round tube along a finely sampled curve, with one radius or one per point; TUBE_FAR_DISTANCE far away."""
    radii = torch.as_tensor(radius).expand(len(curve))
    tree = cKDTree(curve.numpy())
    max_distance = float(radii.max()) + TUBE_FAR_DISTANCE  # a bounded search is several times faster

    def field(p: Tensor) -> Tensor:
        distance, index = tree.query(p.numpy(), distance_upper_bound=max_distance, workers=-1)
        far = index == len(curve)
        near = distance - radii.numpy()[np.where(far, 0, index)]
        return torch.from_numpy(np.where(far, TUBE_FAR_DISTANCE, near)).float()

    return field


def posed(field: Field, R: Float[Tensor, "3 3"], offset: Vec = (0.0, 0.0, 0.0)) -> Field:
    """The shape rotated by R about the origin, then translated by `offset`."""
    t = _floats(offset)
    return lambda p: field((p - t) @ R)


def mirrored(field: Field) -> Field:
    """The part of a shape at positive x, and its mirror image."""
    flip = torch.tensor([1.0, 0, 0])
    return lambda p: field(p + flip * (p[:, :1].abs() - p[:, :1]))


def union(*fields: Field, smooth: float = 0.0) -> Field:
    """Union of shapes; with `smooth`, creases are blended over about that width (polynomial smooth minimum)."""

    def field(p: Tensor) -> Tensor:
        total = fields[0](p)
        for other in fields[1:]:
            d = other(p)
            if smooth:
                h = (0.5 + 0.5 * (d - total) / smooth).clamp(0, 1)
                total = d + (total - d) * h - smooth * h * (1 - h)
            else:
                total = torch.minimum(total, d)
        return total

    return field


def difference(field: Field, *others: Field) -> Field:
    """The first shape minus the others."""

    def remaining(p: Tensor) -> Tensor:
        d = field(p)
        for other in others:
            d = torch.maximum(d, -other(p))
        return d

    return remaining


def polyline(corners: Sequence[tuple[float, float]]) -> Callable[[Tensor], Tensor]:
    """Distance function of an open polyline in the plane."""
    a = _floats(corners)
    start, along = a[:-1], a[1:] - a[:-1]

    def distance(q: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        best = torch.full((len(q),), math.inf)
        for s, e in zip(start, along, strict=True):
            t = ((q - s) @ e / e.square().sum()).clamp(0, 1)
            best = torch.minimum(best, (q - s - t[:, None] * e).norm(dim=1))
        return best

    return distance


def polygon(corners: Sequence[tuple[float, float]]) -> Callable[[Tensor], Tensor]:
    """Signed distance function of a closed polygon in the plane (even-odd rule)."""
    a = _floats(corners)
    edge = polyline([*corners, corners[0]])
    ends = list(zip(a, a.roll(-1, 0), strict=True))

    def distance(q: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        inside = torch.zeros(len(q), dtype=torch.bool)
        for (x0, y0), (x1, y1) in ends:
            spans = (y0 > q[:, 1]) != (y1 > q[:, 1])
            dy = y1 - y0
            inside ^= spans & (q[:, 0] < (x1 - x0) * (q[:, 1] - y0) / torch.where(dy == 0, 1.0, dy) + x0)
        return edge(q) * torch.where(inside, -1.0, 1.0)

    return distance


def curve_through(knots: Sequence[Sequence[float]], count: int, closed: bool = False) -> Float[Tensor, "m d"]:
    """`count` points at equal arc length along the Catmull-Rom spline through the knots."""
    k = _floats(knots)
    first, last = (k[-1], k[0]) if closed else (2 * k[0] - k[1], 2 * k[-1] - k[-2])
    padded = torch.cat([first[None], k, last[None], *([k[1][None]] if closed else [])])
    t = torch.linspace(0, 1, 65)[:-1, None]
    pieces = []
    for p0, p1, p2, p3 in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        cubic = 2 * p0 - 5 * p1 + 4 * p2 - p3, 3 * p1 - p0 - 3 * p2 + p3
        pieces.append(0.5 * (2 * p1 + (p2 - p0) * t + cubic[0] * t**2 + cubic[1] * t**3))
    fine = torch.cat([*pieces, (k[0] if closed else k[-1])[None]])
    length = torch.cat([torch.zeros(1), (fine[1:] - fine[:-1]).norm(dim=1).cumsum(0)])
    target = torch.linspace(0, float(length[-1]), count)
    i = torch.searchsorted(length, target).clamp(1, len(length) - 1)
    fraction = (target - length[i - 1]) / (length[i] - length[i - 1])
    return fine[i - 1] + (fine[i] - fine[i - 1]) * fraction[:, None]
