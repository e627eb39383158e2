"""Colours of a surface as functions of the point: layers over layers, each with a soft edge."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from stages.lab.assets.shapes import noise
from stages.lab.assets.signed_distance import polygon, polyline

RGB = tuple[float, float, float]
WHITE, BLACK = (0.95, 0.95, 0.94), (0.05, 0.05, 0.06)
EDGE_WIDTH = 0.005  # width over which a layer fades, about the spacing of the Gaussians


def plain(colour: RGB) -> Callable[[Tensor], Tensor]:
    """One colour everywhere."""
    return lambda p: torch.tensor(colour).expand(len(p), 3)


def overlay(
    rgb: Float[Tensor, "n 3"], colour: RGB | Tensor, distance: Float[Tensor, "n"], edge: float = EDGE_WIDTH
) -> Float[Tensor, "n 3"]:
    """`colour` laid over `rgb` where the distance is negative, fading over the width `edge`."""
    c = torch.as_tensor(colour)
    return rgb + (c - rgb) * (0.5 - distance / edge).clamp(0, 1)[:, None]


def mix(a: RGB, b: RGB, t: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Colour a where t is 0, b where it is 1."""
    return torch.tensor(a) + (torch.tensor(b) - torch.tensor(a)) * t.clamp(0, 1)[:, None]


def fabric(p: Tensor, rgb: Tensor, seed: int, size: float = 0.012, depth: float = 0.1) -> Tensor:
    """Brightness varied by noise, as cloth and plush vary."""
    return rgb * (1 + depth * (2 * noise(p, size, seed) - 1))[:, None]


def ellipse2d(
    q: Float[Tensor, "n 2"], centre: Sequence[float], radii: float | Sequence[float], angle: float = 0.0
) -> Float[Tensor, "n"]:
    """Distance in the plane to an ellipse (first order), turned counterclockwise by `angle` radians."""
    r = torch.as_tensor(radii, dtype=torch.float32).expand(2)
    a = torch.tensor(angle)
    R = torch.stack([torch.stack([a.cos(), -a.sin()]), torch.stack([a.sin(), a.cos()])])
    u = ((q - torch.tensor(centre)) @ R) / r
    k = u.norm(dim=1)
    return k * (k - 1) / (u / r).norm(dim=1).clamp_min(1e-6)


def box2(q: Float[Tensor, "n 2"], centre: Sequence[float], half: Sequence[float], corner: float = 0.0) -> Tensor:
    """Distance in the plane to a rectangle with rounded corners."""
    d = (q - torch.tensor(centre)).abs() - (torch.tensor(half) - corner)
    return d.clamp_min(0).norm(dim=1) + d.amax(1).clamp_max(0) - corner


def stroke(q: Float[Tensor, "n 2"], corners: Sequence[tuple[float, float]], width: float) -> Tensor:
    """Distance in the plane to a round-ended line of that width through the corners."""
    return polyline(corners)(q) - width / 2


def filled_polygon(q: Float[Tensor, "n 2"], corners: Sequence[tuple[float, float]]) -> Tensor:
    """Distance in the plane to a filled polygon."""
    return polygon(corners)(q)


def union2d(*distances: Tensor) -> Tensor:
    """Distance to the nearest of several shapes."""
    return torch.stack(distances).amin(0)


def cola_lettering(q: Float[Tensor, "n 2"], width: float) -> Tensor:
    """Distance in the plane to the letters "cola", a round hand of x-height 1 that spans -2 to 2."""

    def ring(x: float) -> Tensor:
        return ((q - torch.tensor([x, 0.0])).norm(dim=1) - 0.5).abs() - width / 2

    c = torch.maximum(ring(-1.45), q[:, 0] + 1.45 - 0.12 - 0.55 * q[:, 1].abs())
    l, stem = stroke(q, [(0.55, -0.5), (0.5, 1.0)], width), stroke(q, [(1.8, 0.5), (1.85, -0.5)], width)
    return union2d(c, ring(-0.3), l, ring(1.3), stem)
