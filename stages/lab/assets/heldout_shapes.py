"""Eight held-out objects that are never trained on, as signed distance fields.

Ids, Young's moduli and densities are those of GSCollision's held-out objects (source: public code of NGFF); shapes and
sizes are our own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stages.lab.assets.field_sampling import relax_points, sample_surface
from stages.lab.assets.shapes import single_threaded
from stages.lab.assets.signed_distance import (
    Field,
    capsule,
    curve_through,
    ellipsoid,
    mirrored,
    revolved_wall,
    slab,
    sphere,
    tube,
    union,
)

SURFACE_BAND = 0.008  # half width of the band sampled around the surface, less than half the thinnest wall


@dataclass(frozen=True)
class ShapeKind:
    """Shape, size and material of an object."""

    id: int
    scale: float  # longest side [m]
    E: float  # Young's modulus [Pa]
    density: float  # density [kg/m^3]
    shape: Callable[[], Field]  # within a cube of +-0.6, before normalisation to longest side 1


def bear() -> Field:
    """A seated bear with arms and legs forward."""
    arm = capsule((0.17, -0.06, 0.0), (0.33, -0.16, -0.08), 0.09)
    leg = capsule((0.12, -0.1, -0.32), (0.2, -0.32, -0.38), 0.1)
    head = union(sphere((0, -0.04, 0.27), 0.21), sphere((0, -0.24, 0.22), 0.09))
    ears = mirrored(sphere((0.17, -0.02, 0.45), 0.08))
    return union(head, ears, ellipsoid((0, 0, -0.12), (0.23, 0.2, 0.29)), mirrored(union(arm, leg)), smooth=0.04)


def towel() -> Field:
    """A wavy rectangle."""

    def field(p: Tensor) -> Tensor:
        wave = 0.04 * torch.sin(9 * p[:, 0]) * torch.cos(5 * p[:, 1])
        beyond = torch.stack([p[:, 0].abs() - 0.49, p[:, 1].abs() - 0.33], 1).clamp_min(0).norm(dim=1)
        return torch.hypot(beyond, p[:, 2] - wave) - 0.01

    return field


def skirt() -> Field:
    """A conical band, open at both ends."""
    return revolved_wall([(0.22, 0.3), (0.28, 0.1), (0.36, -0.1), (0.5, -0.3)], 0.03)


def goose() -> Field:
    """A bird with a long neck."""
    neck = capsule((0, -0.24, 0.02), (0, -0.36, 0.42), 0.085, 0.065)
    head = union(sphere((0, -0.38, 0.46), 0.1), capsule((0, -0.44, 0.44), (0, -0.55, 0.42), 0.045, 0.02))
    tail = capsule((0, 0.2, -0.1), (0, 0.42, 0.06), 0.12, 0.03)
    return union(ellipsoid((0, 0, -0.16), (0.24, 0.34, 0.2)), neck, head, tail, smooth=0.05)


def bolster() -> Field:
    """A long round cushion."""
    return slab((0, 0, 0), (0.14, 0.5, 0.14), 0.13, 0.06)


def knot() -> Field:
    """A closed rope, tied as a trefoil."""
    t = torch.linspace(0, 2 * math.pi, 25)[:-1]
    x, y, z = torch.sin(t) + 2 * torch.sin(2 * t), torch.cos(t) - 2 * torch.cos(2 * t), -torch.sin(3 * t)
    return tube(curve_through((0.17 * torch.stack([x, y, z], 1)).tolist(), 600, closed=True), 0.06)


def football() -> Field:
    """A sphere."""
    return sphere((0, 0, 0), 0.5)


def horse() -> Field:
    """Four legs, a neck and a head."""
    hind, fore = (capsule((0.11, y, -0.1), (0.14, 1.15 * y, -0.45), 0.06, 0.045) for y in (0.24, -0.24))
    neck, head = capsule((0, -0.3, 0.08), (0, -0.4, 0.34), 0.09), capsule((0, -0.4, 0.36), (0, -0.55, 0.28), 0.075)
    body = capsule((0, -0.28, 0), (0, 0.28, 0), 0.15)
    return union(body, mirrored(union(hind, fore)), neck, head, smooth=0.04)


HELDOUT_SHAPES = {
    "bear": ShapeKind(1, 0.65, 5e4, 500.0, bear), "cloth2": ShapeKind(5, 1.0, 3e3, 100.0, towel),
    "cloth3": ShapeKind(6, 0.6, 3e3, 100.0, skirt), "duck2": ShapeKind(8, 0.65, 5e5, 1200.0, goose),
    "pillow2": ShapeKind(13, 0.9, 1e4, 500.0, bolster), "rope2": ShapeKind(15, 0.65, 5e3, 500.0, knot),
    "soccer": ShapeKind(16, 0.4, 3e6, 700.0, football), "toy": ShapeKind(17, 0.7, 1e5, 500.0, horse),
}  # fmt: skip


def surface_points(kind: ShapeKind, n: int) -> Float[Tensor, "n 3"]:
    """`n` evenly distributed surface points of a shape with longest side 1, centred on its bounding box."""
    return surface_and_interior_points(kind, n, 0.5)[0]


def surface_and_interior_points(
    kind: ShapeKind, n: int, spacing: float
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "m 3"]]:
    """Surface points, and points of a cubic lattice at least half a `spacing` below the surface."""
    field = kind.shape()
    with single_threaded():
        points = relax_points(field, sample_surface(field, (0.6, 0.6, 0.6), n, SURFACE_BAND)).points
    low, high = points.amin(0), points.amax(0)
    middle, side = (low + high) / 2, (high - low).max()
    axis = torch.arange((spacing - 1) / 2, 0.5, spacing)
    lattice = torch.cartesian_prod(axis, axis, axis)
    return (points - middle) / side, lattice[field(lattice * side + middle) < -spacing * side / 2]
