"""The three soft objects: cloth, pillow and rope."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.scene.gaussians import Gaussians
from stages.lab.assets import paint as layers
from stages.lab.assets.field_sampling import PaintedPart, gaussians_from_parts
from stages.lab.assets.shapes import noise
from stages.lab.assets.signed_distance import curve_through, polygon, tube, union

SHIRT = [(-0.28, -0.45), (0.28, -0.45), (0.275, -0.2), (0.27, 0.14), (0.43, 0.03), (0.5, 0.17), (0.33, 0.35),
         (0.14, 0.43), (0.0, 0.4), (-0.14, 0.43), (-0.33, 0.35), (-0.5, 0.17), (-0.43, 0.03), (-0.27, 0.14),
         (-0.275, -0.2)]  # fmt: skip


def folds(q: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
    """Height of the cloth: raised in the middle, long soft folds from the armpits, and small ones on the sleeves."""
    x, y = q.unbind(1)
    flat = torch.nn.functional.pad(q, (0, 1))
    drift = noise(flat, 0.35, 7)
    long = 0.011 * torch.sin(11 * x + 5 * y + 6 * drift) * (1 - 0.6 * torch.exp(-((x / 0.2) ** 2) - (y / 0.25) ** 2))
    sleeves = 0.005 * torch.sin(38 * (x.abs() - 0.6 * y) + 3 * drift) * ((x.abs() - 0.2) / 0.1).clamp(0, 1)
    rise = 0.03 * torch.exp(-((x / 0.3) ** 2) - (y / 0.4) ** 2)
    return long + sleeves + rise + 0.02 * (noise(flat, 0.16, 5) - 0.5)


def cloth() -> Gaussians:
    """A yellow T-shirt lying in soft folds: one closed sheet, 1 % thick, with an owl printed on its upper side."""
    outline = polygon(rounded(SHIRT))

    def field(p: Tensor) -> Tensor:
        across = torch.hypot((outline(p[:, :2]) + 0.005).clamp_min(0), p[:, 2] - folds(p[:, :2]))
        return across - 0.005

    def paint(p: Tensor) -> Tensor:
        q = p[:, :2]
        rgb = layers.fabric(p, layers.fabric(p, layers.plain((0.97, 0.76, 0.12))(p), 3, 0.006, 0.06), 4, 0.05, 0.05)
        m = torch.stack([q[:, 0].abs(), q[:, 1]], 1)
        cuff = layers.stroke(m, [(0.4, 0.05), (0.465, 0.19)], 0.006)
        armhole = layers.stroke(m, [(0.27, 0.14), (0.262, 0.25), (0.275, 0.375)], 0.006)
        rgb = layers.overlay(
            rgb,
            (0.74, 0.53, 0.06),
            layers.union2d(cuff, armhole, layers.stroke(m, [(0.0, -0.418), (0.28, -0.418)], 0.006)),
        )
        neck = layers.ellipse2d(q, (0, 0.44), (0.125, 0.095))
        rgb = layers.overlay(
            layers.overlay(rgb, (0.88, 0.62, 0.06), neck - 0.022), (0.74, 0.53, 0.06), (neck - 0.022).abs() - 0.003
        )
        rgb = layers.overlay(rgb, (0.6, 0.4, 0.05), neck)
        top = p[:, 2] > folds(q)
        return torch.where(top[:, None], owl((q - torch.tensor([0.0, -0.03])) / 1.05, rgb), rgb)

    return gaussians_from_parts([PaintedPart(field, paint)], (0.52, 0.48, 0.08), 80_000, skin=0.004)


def rounded(corners: list) -> list[tuple[float, float]]:
    """The polygon with its corners rounded by two iterations of corner cutting (Chaikin 1974, with narrower cuts)."""
    points = torch.tensor(corners)
    for _ in range(2):
        nxt = points.roll(-1, 0)
        points = torch.stack([0.88 * points + 0.12 * nxt, 0.12 * points + 0.88 * nxt], 1).reshape(-1, 2)
    return points.tolist()


def owl(q: Float[Tensor, "n 2"], rgb: Tensor) -> Tensor:
    """A round owl about 0.36 wide and 0.45 high on a branch, printed over the given colours."""
    brown, dark, cream = (0.45, 0.25, 0.12), (0.27, 0.14, 0.07), (0.96, 0.86, 0.66)
    rgb = layers.overlay(rgb, dark, layers.stroke(q, [(-0.2, -0.215), (0.0, -0.205), (0.2, -0.22)], 0.022))
    ears = layers.union2d(
        *(layers.filled_polygon(q, [(s * 0.15, 0.235), (s * 0.035, 0.16), (s * 0.15, 0.09)]) for s in (-1.0, 1.0))
    )
    rgb = layers.overlay(rgb, brown, layers.union2d(layers.ellipse2d(q, (0, -0.015), (0.17, 0.195)), ears))
    rgb = layers.overlay(rgb, cream, layers.ellipse2d(q, (0, -0.085), (0.105, 0.115)))
    for row in range(3):
        for column in range(-1 - row % 2, 2):
            x, y = 0.055 * (column + 0.5 * (row % 2)), -0.05 - 0.045 * row
            rgb = layers.overlay(
                rgb, brown, layers.stroke(q, [(x - 0.017, y + 0.01), (x, y - 0.008), (x + 0.017, y + 0.01)], 0.01)
            )
    for s in (-1, 1):
        rgb = layers.overlay(rgb, dark, layers.ellipse2d(q, (s * 0.145, -0.05), (0.042, 0.115), s * 0.2))
        rgb = layers.overlay(rgb, cream, layers.ellipse2d(q, (s * 0.072, 0.075), 0.082))
        rgb = layers.overlay(rgb, layers.WHITE, layers.ellipse2d(q, (s * 0.07, 0.075), 0.06))
        rgb = layers.overlay(rgb, layers.BLACK, layers.ellipse2d(q, (s * 0.064, 0.072), 0.037))
        rgb = layers.overlay(rgb, layers.WHITE, layers.ellipse2d(q, (s * 0.064 - 0.012, 0.087), 0.011))
        toes = layers.union2d(
            *(layers.ellipse2d(q, (s * 0.055 + k * 0.02, -0.205), (0.011, 0.022)) for k in (-1, 0, 1))
        )
        rgb = layers.overlay(rgb, (0.93, 0.5, 0.1), toes)
    return layers.overlay(
        rgb, (0.95, 0.5, 0.08), layers.filled_polygon(q, [(-0.03, 0.052), (0.03, 0.052), (0.0, -0.005)])
    )


def pillow() -> Gaussians:
    """A stuffed square with pointed corners, blue and white stripes, and piping around its seam."""

    def edge(angle: Tensor) -> Tensor:
        """Radius of the seam by azimuth: a square with concave sides."""
        c, s = angle.cos(), angle.sin()
        square = 0.46 / (c.abs() ** 7 + s.abs() ** 7) ** (1 / 7)
        return square * (1 + 0.05 * ((2 * angle).sin().abs() ** 3) - 0.02)

    def field(p: Tensor) -> Tensor:
        angle = torch.atan2(p[:, 1], p[:, 0])
        q = p[:, :2].norm(dim=1) / edge(angle)
        crease = 1 + 0.1 * torch.sin(angle * 17 + 3 * noise(p, 0.2, 2)) * q**4 + 0.06 * (noise(p, 0.16, 4) - 0.5)
        return (q**3.2 + (p[:, 2] / (0.17 * crease)) ** 2 - 1) * 0.12

    angle = torch.linspace(0, 2 * math.pi, 1500)[:-1]
    seam = torch.stack([edge(angle) * angle.cos(), edge(angle) * angle.sin(), torch.zeros_like(angle)], 1)

    def paint(p: Tensor) -> Tensor:
        wide = (torch.remainder(p[:, 0] / 0.13 + 0.25, 1.0) - 0.5).abs() * 0.13 - 0.0325
        return layers.fabric(p, layers.overlay(layers.plain(layers.WHITE)(p), (0.12, 0.27, 0.62), wide), 9, 0.007, 0.06)

    parts = [PaintedPart(field, paint), PaintedPart(tube(seam, 0.013), layers.plain((0.1, 0.2, 0.5)))]
    return gaussians_from_parts(parts, (0.53, 0.53, 0.2), 50_000, smooth=0.008)


KNOTS = [(-0.46, 0.02, 0.0), (-0.4, 0.2, 0.0), (-0.14, 0.28, 0.0), (0.14, 0.24, 0.0), (0.24, 0.02, 0.0),
         (0.06, -0.13, 0.0), (-0.13, -0.02, 0.03), (-0.08, 0.2, 0.14), (0.12, 0.34, 0.09), (0.36, 0.28, 0.0),
         (0.52, 0.02, 0.0)]  # fmt: skip


def rope() -> Gaussians:
    """A rope of three twisted strands in a loose, self-crossing loop, whipped with cord near both ends."""
    pitch, m = 0.17, 1500
    line = curve_through(KNOTS, m)
    length = float((line[1:] - line[:-1]).norm(dim=1).sum())
    tangent = torch.nn.functional.normalize(torch.gradient(line, dim=0)[0], dim=1)
    up = torch.tensor([[0.0, 0, 1]]).expand_as(tangent)
    side = torch.nn.functional.normalize(torch.linalg.cross(up, tangent), dim=1)
    up = torch.linalg.cross(tangent, side)
    phase = torch.linspace(0, 2 * math.pi * length / pitch, m)
    spokes = [(phase + 2 * math.pi * k / 3).cos()[:, None] * side + (phase + 2 * math.pi * k / 3).sin()[:, None] * up
              for k in range(3)]  # fmt: skip
    strands = torch.cat([line + 0.036 * spoke for spoke in spokes])

    def paint(p: Tensor) -> Tensor:
        _, index = knn(strands, p, 1)
        i = index[:, 0] % m
        spoke = p - strands[index[:, 0]]
        around = torch.atan2((spoke * up[i]).sum(1), (spoke * side[i]).sum(1))
        yarn = torch.sin(7 * around - phase[i] * 5) * 0.5 + 0.5
        rgb = layers.mix((0.5, 0.33, 0.16), (0.9, 0.74, 0.48), 0.55 * yarn + 0.45 * noise(p, 0.012, 8))
        return rgb * torch.tensor([1.0, 0.93, 1.05])[index[:, 0] // m][:, None]

    def cord(p: Tensor) -> Tensor:
        _, index = knn(line, p, 1)
        wound = torch.sin(index[:, 0] * 0.85) * 0.5 + 0.5
        return layers.mix((0.4, 0.07, 0.06), (0.72, 0.16, 0.12), wound)

    whipping = tube(torch.cat([line[34:71], line[-71:-34]]), 0.0775)
    fillet = tube(line, 0.03)  # fills the space between the strands
    return gaussians_from_parts(
        [PaintedPart(union(tube(strands, 0.041), fillet), paint), PaintedPart(whipping, cord)],
        (0.64, 0.5, 0.28),
        60_000,
    )
