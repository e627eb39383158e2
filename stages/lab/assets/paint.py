"""Procedural surface colours as functions of position: 2D shapes composited in layers with soft edges."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from stages.lab.assets.shapes import noise
from stages.lab.assets.signed_distance import polygon, polyline

RGB = tuple[float, float, float]
WHITE, BLACK = (0.95, 0.95, 0.94), (0.05, 0.05, 0.06)
EDGE_WIDTH = 0.005  # blur width of layer edges, about the spacing of the Gaussians


def plain(colour: RGB) -> Callable[[Tensor], Tensor]:
    """A constant colour."""
    return lambda p: torch.tensor(colour).expand(len(p), 3)


def overlay(
    rgb: Float[Tensor, "n 3"], colour: RGB | Tensor, distance: Float[Tensor, "n"], edge: float = EDGE_WIDTH
) -> Float[Tensor, "n 3"]:
    """`colour` composited over `rgb` where the signed distance is negative, blurred over the width `edge`."""
    c = torch.as_tensor(colour)
    return rgb + (c - rgb) * (0.5 - distance / edge).clamp(0, 1)[:, None]


def mix(a: RGB, b: RGB, t: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Linear interpolation between colours a (t = 0) and b (t = 1), t clamped to 0..1."""
    return torch.tensor(a) + (torch.tensor(b) - torch.tensor(a)) * t.clamp(0, 1)[:, None]


def fabric(p: Tensor, rgb: Tensor, seed: int, size: float = 0.012, depth: float = 0.1) -> Tensor:
    """Colours with brightness noise of relative amplitude `depth` and features of `size`, like fabric."""
    return rgb * (1 + depth * (2 * noise(p, size, seed) - 1))[:, None]


def ellipse2d(
    q: Float[Tensor, "n 2"], centre: Sequence[float], radii: float | Sequence[float], angle: float = 0.0
) -> Float[Tensor, "n"]:
    """First-order signed distance to an ellipse in the plane, rotated counterclockwise by `angle` [rad]."""
    r = torch.as_tensor(radii, dtype=torch.float32).expand(2)
    a = torch.tensor(angle)
    R = torch.stack([torch.stack([a.cos(), -a.sin()]), torch.stack([a.sin(), a.cos()])])
    u = ((q - torch.tensor(centre)) @ R) / r
    k = u.norm(dim=1)
    return k * (k - 1) / (u / r).norm(dim=1).clamp_min(1e-6)


def box2(q: Float[Tensor, "n 2"], centre: Sequence[float], half: Sequence[float], corner: float = 0.0) -> Tensor:
    """Signed distance to a rectangle in the plane, with corners rounded by the radius `corner`."""
    d = (q - torch.tensor(centre)).abs() - (torch.tensor(half) - corner)
    return d.clamp_min(0).norm(dim=1) + d.amax(1).clamp_max(0) - corner


def stroke(q: Float[Tensor, "n 2"], corners: Sequence[tuple[float, float]], width: float) -> Tensor:
    """Signed distance to a polyline of `width` with round ends in the plane."""
    return polyline(corners)(q) - width / 2


def filled_polygon(q: Float[Tensor, "n 2"], corners: Sequence[tuple[float, float]]) -> Tensor:
    """Signed distance to a filled polygon in the plane."""
    return polygon(corners)(q)


def union2d(*distances: Tensor) -> Tensor:
    """Signed distance to the union of several shapes."""
    return torch.stack(distances).amin(0)


def cola_lettering(q: Float[Tensor, "n 2"], width: float) -> Tensor:
    """Signed distance to the letters "cola" in a round script: x-height 1, strokes of `width`, x from -2 to 2."""

    def ring(x: float) -> Tensor:
        return ((q - torch.tensor([x, 0.0])).norm(dim=1) - 0.5).abs() - width / 2

    c = torch.maximum(ring(-1.45), q[:, 0] + 1.45 - 0.12 - 0.55 * q[:, 1].abs())
    l, stem = stroke(q, [(0.55, -0.5), (0.5, 1.0)], width), stroke(q, [(1.8, 0.5), (1.85, -0.5)], width)
    return union2d(c, ring(-0.3), l, ring(1.3), stem)
