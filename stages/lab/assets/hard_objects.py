"""Four hard objects: ball, bowl, can and duck."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from stages.core.scene.gaussians import Gaussians
from stages.lab.assets import signed_distance as sdf
from stages.lab.assets.field_sampling import PaintedPart, gaussians_from_parts
from stages.lab.assets.paint import BLACK, WHITE, cola_lettering, ellipse2d, mix, overlay, plain, stroke, union2d


def ball() -> Gaussians:
    """A capture ball: red above, white below, a black belt in a groove, a button at the front (-y)."""
    front = sdf.euler_rotation(x=90)  # maps the axis of a revolved shape to -y
    groove = sdf.revolved([(0.488, -0.02), (0.6, -0.02), (0.6, 0.02), (0.488, 0.02)], 0.012)
    shell = sdf.difference(sdf.sphere((0, 0, 0), 0.5), groove)
    ring = sdf.posed(sdf.revolved([(0, 0.4), (0.118, 0.4), (0.118, 0.488), (0, 0.488)], 0.01), front)
    button = sdf.posed(sdf.revolved([(0, 0.4), (0.062, 0.4), (0.062, 0.505), (0, 0.505)], 0.018), front)

    def paint(p: Tensor) -> Tensor:
        rgb = overlay(plain((0.86, 0.09, 0.08))(p), WHITE, p[:, 2])
        rgb = overlay(rgb, BLACK, p[:, 2].abs() - 0.042)
        away = torch.where(p[:, 1] < 0, p[:, [0, 2]].norm(dim=1), 1.0)
        return overlay(rgb, BLACK, away - 0.14)

    def knob(p: Tensor) -> Tensor:
        return overlay(plain((0.7, 0.71, 0.73))(p), WHITE, p[:, [0, 2]].norm(dim=1) - 0.058)

    parts = [PaintedPart(shell, paint, 0.7), PaintedPart(ring, plain(BLACK), 0.4), PaintedPart(button, knob, 0.5)]
    return gaussians_from_parts(parts, (0.52, 0.52, 0.52), 70_000)


CLOUDS = (
    (0.0, 0.06, 1.0),
    (1.15, -0.06, 0.8),
    (2.2, 0.07, 1.1),
    (3.3, -0.05, 0.85),
    (4.25, 0.08, 0.95),
    (5.3, -0.03, 1.05),
)  # clouds on the bowl: azimuth [rad], height, size
PUFFS = (
    (-0.085, 0.0, 0.034),
    (-0.04, 0.022, 0.046),
    (0.018, 0.034, 0.056),
    (0.068, 0.008, 0.04),
    (0.105, -0.006, 0.026),
)  # circles of a cloud: horizontal offset, vertical offset, radius


def clouds(along: Tensor, height: Tensor, radius: float) -> Tensor:
    """Distance to clouds with flat undersides around a wall of `radius`; `along` is the azimuth [rad]."""
    shapes = []
    for azimuth, up, size in CLOUDS:
        u = torch.remainder(along - azimuth + math.pi, 2 * math.pi) - math.pi
        q = torch.stack([u * radius, height - up], 1) / size
        puff = union2d(*(ellipse2d(q, (x, y), r) for x, y, r in PUFFS))
        shapes.append(torch.maximum(puff, -0.02 - q[:, 1]) * size)
    return union2d(*shapes)


def bowl() -> Gaussians:
    """An open bowl on a foot: sky blue with white clouds outside, paler inside, a white rim."""
    knots = [(0.0, -0.225), (0.12, -0.222), (0.27, -0.165), (0.39, -0.05), (0.455, 0.09), (0.49, 0.235)]
    wall = sdf.revolved_wall([(r, z) for r, z in sdf.curve_through(knots, 40).tolist()], 0.03)
    radii, heights = sdf.curve_through(knots, 200).T.numpy()
    foot = sdf.revolved([(0.17, -0.265), (0.2, -0.265), (0.2, -0.215), (0.17, -0.215)], 0.006)

    def paint(p: Tensor) -> Tensor:
        r, z, azimuth = p[:, :2].norm(dim=1), p[:, 2], torch.atan2(p[:, 0], -p[:, 1])
        outer = r > torch.from_numpy(np.interp(z.numpy(), heights, radii)).float()
        outside = mix((0.1, 0.33, 0.72), (0.32, 0.62, 0.93), (z + 0.25) / 0.48)
        outside = overlay(outside, WHITE, clouds(azimuth, z - 0.03, 0.43))
        inside = mix((0.66, 0.83, 0.96), (0.5, 0.74, 0.95), (z + 0.2) / 0.4)
        inside = overlay(inside, WHITE, clouds(azimuth + 0.5, z - 0.05, 0.4))
        rgb = torch.where(outer[:, None], outside, inside)
        return overlay(rgb, WHITE, 0.222 - z)

    parts = [PaintedPart(wall, paint, 0.8), PaintedPart(foot, plain((0.09, 0.3, 0.68)), 0.5)]
    return gaussians_from_parts(parts, (0.52, 0.52, 0.3), 60_000)


CAN = [(0.0, -0.44), (0.17, -0.455), (0.185, -0.49), (0.2, -0.49), (0.262, -0.4), (0.262, 0.36), (0.205, 0.455),
       (0.205, 0.485), (0.19, 0.485), (0.185, 0.455), (0.0, 0.455)]  # fmt: skip


def can() -> Gaussians:
    """A closed red drinks can with a domed foot, a rimmed lid with a tab, a white wave and lettering."""
    body = sdf.revolved(CAN, 0.007)
    loop = sdf.difference(
        sdf.ellipsoid((0, 0, 0), (0.05, 0.085, 0.012)), sdf.ellipsoid((0, 0.03, 0), (0.026, 0.03, 0.05))
    )
    tab = sdf.posed(loop, torch.eye(3), (0.0, -0.035, 0.474))

    def paint(p: Tensor) -> Tensor:
        r, z, azimuth = p[:, :2].norm(dim=1), p[:, 2], torch.atan2(p[:, 0], -p[:, 1])
        rgb = mix((0.62, 0.02, 0.04), (0.84, 0.05, 0.07), (z + 0.4) / 0.7)
        for side in (0.26, 0.26 + math.pi):  # one of the two sides faces the camera of view 0
            u = torch.remainder(azimuth - side + math.pi, 2 * math.pi) - math.pi
            q = torch.stack([u * 0.262, z], 1)
            crest = -0.2 + 0.07 * torch.sin(u * 2.0 + 0.6)
            facing = u.abs() - math.pi / 2
            rgb = overlay(
                rgb, WHITE, torch.maximum((z - crest).abs() - 0.05 * torch.cos(u * 0.9).clamp_min(0.1), facing)
            )
            rgb = overlay(rgb, (0.85, 0.85, 0.87), torch.maximum((z - crest + 0.085).abs() - 0.008, facing))
            lean = torch.stack([q[:, 0] - 0.18 * (z - 0.08), (z - 0.06) - 0.22 * q[:, 0]], 1)
            rgb = overlay(rgb, WHITE, cola_lettering(lean / 0.14, 0.24) * 0.14)
            rgb = overlay(rgb, WHITE, stroke(lean, [(-0.24, -0.115), (0.0, -0.13), (0.27, -0.105)], 0.016))
        steel = overlay(mix((0.72, 0.73, 0.75), (0.86, 0.87, 0.88), r / 0.2), (0.55, 0.56, 0.58),
                     ellipse2d(p[:, :2], (0, -0.1), (0.07, 0.055)).abs() - 0.004)  # fmt: skip
        return overlay(rgb, steel, torch.minimum(0.395 - z, z + 0.425))

    return gaussians_from_parts(
        [PaintedPart(body, paint, 0.75), PaintedPart(tab, plain((0.8, 0.81, 0.83)), 0.6)], (0.28, 0.28, 0.52), 60_000
    )


def duck() -> Gaussians:
    """A rubber duck facing -y: body, raised tail, head, wings, an orange beak and black eyes."""
    body = sdf.union(
        sdf.ellipsoid((0, 0.06, -0.17), (0.29, 0.37, 0.215)),
        sdf.capsule((0, 0.3, -0.06), (0, 0.47, 0.06), 0.12, 0.03),
        sdf.ellipsoid((0, -0.13, 0.0), (0.17, 0.16, 0.18)),
        smooth=0.12,
    )  # fmt: skip
    head = sdf.sphere((0, -0.17, 0.225), 0.215)
    wing = sdf.mirrored(sdf.ellipsoid((0.25, 0.1, -0.13), (0.055, 0.2, 0.1), sdf.euler_rotation(x=22, z=14)))
    yellow = sdf.union(body, head, wing, smooth=0.05)
    upper = sdf.ellipsoid((0, -0.4, 0.205), (0.105, 0.125, 0.032), sdf.euler_rotation(x=-12))
    lower = sdf.ellipsoid((0, -0.375, 0.165), (0.085, 0.095, 0.026), sdf.euler_rotation(x=10))
    beak = sdf.union(upper, lower, smooth=0.015)

    def paint(p: Tensor) -> Tensor:
        rgb = mix((0.93, 0.62, 0.05), (0.99, 0.84, 0.12), (p[:, 2] + 0.35) / 0.5)
        side = torch.stack([p[:, 0].abs(), p[:, 2]], 1)
        front = torch.where(p[:, 1] < -0.2, 0.0, 1.0)
        rgb = overlay(rgb, WHITE, ellipse2d(side, (0.098, 0.29), (0.052, 0.062)) + front)
        rgb = overlay(rgb, BLACK, ellipse2d(side, (0.096, 0.285), (0.038, 0.047)) + front)
        sparks = union2d(*(ellipse2d(p[:, [0, 2]], (x, 0.305), 0.013) for x in (-0.108, 0.084)))
        return overlay(rgb, WHITE, sparks + front)

    parts = [PaintedPart(yellow, paint, 0.7), PaintedPart(beak, plain((0.95, 0.38, 0.04)), 0.6)]
    return gaussians_from_parts(parts, (0.36, 0.56, 0.48), 50_000, smooth=0.01)
