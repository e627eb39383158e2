"""Procedural textures of table tops, floors and walls: points on the surface (n, 2) [m] -> RGB (n, 3) in 0..1."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from stages.lab.assets.paint import RGB, mix, overlay, plain
from stages.lab.assets.shapes import noise

PlanePoints = Float[Tensor, "n 2"]  # [m]
TABLE_EDGE, ROOM_EDGE = 0.02, 0.12  # blur width of texture edges, about the spacing of the Gaussians [m]


def fractal_noise(q: PlanePoints, size: float, seed: int) -> Float[Tensor, "n"]:
    """Noise in 0..1: three octaves of value noise with features from `size` [m] down."""
    flat = torch.nn.functional.pad(q, (0, 1), value=0.37)
    return sum(noise(flat, size * 0.45**i, seed + i) * weight for i, weight in enumerate((0.55, 0.3, 0.15)))


def stretch(q: PlanePoints, along: float) -> PlanePoints:
    """Coordinates with x divided by `along`, which stretches a pattern along x."""
    return q * torch.tensor([1 / along, 1.0])


def line_distance(x: Float[Tensor, "n"], period: float) -> Float[Tensor, "n"]:
    """Distance to the nearest multiple of `period`."""
    return (torch.remainder(x / period + 0.5, 1.0) - 0.5).abs() * period


def wood_planks(
    q: PlanePoints, width: float, colours: tuple[RGB, RGB], edge: float, seed: int = 1, spread: float = 0.3
) -> Tensor:
    """Planks of `width` [m] along x with wood grain between a dark and a light colour, random shades and dark joints.

    `edge` is the blur width of the joints [m], `spread` the weight of the shades.
    """
    number = (q[:, 1] / width).floor()
    shade = torch.frac(torch.sin(number * 12.9898 + seed) * 43758.5453).abs()
    lane = stretch(q, 9.0) + torch.stack([number * 3.7, number * 0.0], 1)
    rings = torch.sin(40 * lane[:, 1] + 9 * fractal_noise(lane, 0.3, seed)) * 0.5 + 0.5
    grain = 0.45 * rings + 0.55 * fractal_noise(lane, 3 * edge, seed + 5)
    rgb = mix(*colours, grain * (1 - spread) + shade * spread)
    return overlay(rgb, 0.45 * rgb, line_distance(q[:, 1], width) - 0.3 * edge, edge)


def oak(q: PlanePoints) -> Tensor:
    """Oak planks."""
    return wood_planks(q, 0.52, ((0.42, 0.26, 0.13), (0.8, 0.6, 0.38)), TABLE_EDGE)


def marble(q: PlanePoints) -> Tensor:
    """White marble with grey veins along distorted level lines of noise."""
    rgb = mix((0.8, 0.8, 0.82), (0.95, 0.94, 0.93), fractal_noise(q, 0.6, 3))
    bent = stretch(q, 1.7) @ torch.tensor([[0.8, 0.6], [-0.6, 0.8]])
    bent = bent + 0.7 * torch.stack([fractal_noise(q, 0.8, 11), fractal_noise(q, 0.8, 17)], 1)
    for size, seed, depth in ((1.3, 21, 0.8), (0.5, 31, 0.4)):
        vein = (fractal_noise(bent, size, seed) - 0.5).abs()
        fade = depth * fractal_noise(q, 0.6, seed + 3) ** 2 * 2
        rgb = rgb + (torch.tensor([0.45, 0.46, 0.5]) - rgb) * (fade * torch.exp(-vein / 0.025)).clamp(0, 1)[:, None]
    return rgb


def gingham(q: PlanePoints) -> Tensor:
    """Red and white chequered cloth: two sets of stripes, darker where they cross."""
    stripes = [(0.5 - (line_distance(q[:, i], 0.32) - 0.08) / TABLE_EDGE).clamp(0, 1) for i in (0, 1)]
    rgb = mix((0.95, 0.93, 0.9), (0.76, 0.08, 0.1), 0.5 * (stripes[0] + stripes[1]))
    return rgb * (0.94 + 0.12 * fractal_noise(q, 0.05, 8))[:, None]


def voronoi_cells(q: PlanePoints, size: float, seed: int) -> tuple[Tensor, Tensor]:
    """Voronoi cells of about `size` [m]: distance to the cell border [m], and a random number in 0..1 per cell."""
    generator = torch.Generator().manual_seed(seed)
    shift = torch.rand(32, 32, 2, generator=generator) * 0.7 + 0.15
    tone = torch.rand(32, 32, generator=generator)
    home, found = (q / size).floor().long(), []
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            cell = home + torch.tensor([i, j])
            a, b = (cell % 32).unbind(1)
            found.append(((q / size - cell - shift[a, b]).norm(dim=1), tone[a, b]))
    distance, order = torch.stack([d for d, _ in found], 1).sort(1)
    own = torch.stack([t for _, t in found], 1).gather(1, order[:, :1])[:, 0]
    return (distance[:, 1] - distance[:, 0]) * size / 2, own


def flagstones(q: PlanePoints) -> Tensor:
    """Irregular grey stones with dark joints."""
    border, tone = voronoi_cells(q + 0.08 * fractal_noise(q, 0.3, 4)[:, None], 0.62, 5)
    rgb = mix((0.4, 0.39, 0.37), (0.68, 0.65, 0.59), 0.5 * tone + 0.5 * fractal_noise(q, 0.12, 6))
    return overlay(rgb, (0.27, 0.26, 0.24), border - 0.022, 1.5 * TABLE_EDGE)


def worn_paint(q: PlanePoints) -> Tensor:
    """Worn blue-green paint on planks."""
    wood = wood_planks(q, 0.42, ((0.45, 0.32, 0.2), (0.72, 0.56, 0.38)), TABLE_EDGE, 7)
    coat = mix((0.2, 0.5, 0.52), (0.38, 0.68, 0.67), fractal_noise(stretch(q, 6), 0.12, 9))
    rubbed = 0.43 - fractal_noise(stretch(q, 5), 0.16, 13) - 0.16 * torch.exp(-line_distance(q[:, 1], 0.42) / 0.03)
    painted = overlay(wood, coat, rubbed * 0.2, TABLE_EDGE)
    return overlay(painted, 0.4 * painted, line_distance(q[:, 1], 0.42) - 0.007, TABLE_EDGE)


def slate(q: PlanePoints) -> Tensor:
    """Dark layered slate with pale cracks."""
    layers = fractal_noise(stretch(q, 3.0) + 0.2 * fractal_noise(q, 0.8, 2)[:, None], 0.3, 14)
    rgb = mix((0.13, 0.15, 0.17), (0.34, 0.36, 0.39), layers * 1.5 - 0.25)
    step = torch.remainder(layers * 5, 1.0)
    rgb = overlay(rgb, (0.45, 0.46, 0.47), (step - 0.06) * 0.1, TABLE_EDGE)
    return rgb * (0.88 + 0.24 * fractal_noise(q, 0.045, 19))[:, None]


def azulejo(q: PlanePoints) -> Tensor:
    """Glazed tiles: blue petals and corner arcs on white, with grout."""
    side = 0.42
    t = (torch.remainder(q / side, 1.0) - 0.5) * side
    r, angle = t.norm(dim=1), torch.atan2(t[:, 1], t[:, 0])
    blue, pale = (0.1, 0.24, 0.58), (0.45, 0.65, 0.88)
    rgb = plain((0.93, 0.93, 0.9))(q)
    rgb = overlay(rgb, pale, r - 0.155 - 0.02 * torch.cos(8 * angle), TABLE_EDGE)
    rgb = overlay(rgb, (0.94, 0.94, 0.91), r - 0.125 - 0.03 * torch.cos(4 * angle), TABLE_EDGE)
    rgb = overlay(rgb, blue, r - 0.085 - 0.05 * torch.cos(4 * angle), TABLE_EDGE)
    rgb = overlay(rgb, (0.93, 0.75, 0.25), r - 0.034, TABLE_EDGE)
    corner = (t.abs() - side / 2).norm(dim=1)
    rgb = overlay(rgb, blue, (corner - 0.085).abs() - 0.014, TABLE_EDGE)
    rgb = overlay(rgb, blue, corner - 0.04, TABLE_EDGE)
    return overlay(
        rgb,
        (0.62, 0.6, 0.56),
        torch.minimum(line_distance(q[:, 0], side), line_distance(q[:, 1], side)) - 0.009,
        TABLE_EDGE,
    )


def felt(q: PlanePoints) -> Tensor:
    """Green baize with a pale line, inside a rim of dark wood."""
    inset = 2.1 - q.abs().amax(1)
    rgb = mix((0.05, 0.3, 0.17), (0.1, 0.42, 0.25), 0.5 * fractal_noise(q, 0.03, 23) + 0.5 * fractal_noise(q, 0.7, 24))
    rgb = overlay(rgb, (0.75, 0.72, 0.5), (inset - 0.42).abs() - 0.008, TABLE_EDGE)
    along_rim = torch.where((q[:, 0].abs() > q[:, 1].abs())[:, None], q.flip(1), q)
    rim = wood_planks(along_rim, 3.0, ((0.2, 0.09, 0.05), (0.42, 0.21, 0.11)), TABLE_EDGE, 3)
    return overlay(rgb, rim, inset - 0.22, TABLE_EDGE)


def wooden_floor(q: PlanePoints) -> Tensor:
    """Brown floorboards."""
    return wood_planks(q, 0.6, ((0.3, 0.19, 0.11), (0.55, 0.38, 0.24)), ROOM_EDGE, 4, 0.5)


def dark_floor(q: PlanePoints) -> Tensor:
    """Dark floorboards."""
    return wood_planks(q, 0.7, ((0.13, 0.1, 0.09), (0.28, 0.22, 0.18)), ROOM_EDGE, 9, 0.5)


def paving(pale: RGB, dark: RGB, side: float):
    """Texture of square slabs of side `side` [m] with slightly different shades."""

    def paint(q: PlanePoints) -> Tensor:
        number = (q / side).floor()
        shade = torch.frac(torch.sin(number @ torch.tensor([12.9898, 78.233])) * 437.585).abs()
        rgb = mix(dark, pale, 0.5 * shade + 0.5 * fractal_noise(q, 0.5, 3))
        joint = torch.minimum(line_distance(q[:, 0], side), line_distance(q[:, 1], side))
        return overlay(rgb, 0.6 * rgb, joint - 0.02, ROOM_EDGE)

    return paint


def mottled(dark: RGB, pale: RGB, size: float, seed: int = 0):
    """Texture of mottled colour with features of `size` [m]: plaster, concrete, sand, carpet or grass."""
    return lambda q: mix(dark, pale, fractal_noise(q, size, seed) * 1.6 - 0.3)


def panelled(upper: RGB, lower: RGB, rail: float = -1.2):
    """Texture of a plain wall above a rail at height `rail` and panels below; the second coordinate is height [m]."""

    def paint(q: PlanePoints) -> Tensor:
        rgb = mix(upper, upper, q[:, 1] * 0) * (0.97 + 0.06 * fractal_noise(q, 0.8, 2))[:, None]
        board = plain(lower)(q)
        frame = torch.maximum(line_distance(q[:, 0], 1.3).neg() + 0.13, ((q[:, 1] - rail + 0.65).abs() - 0.4))
        board = overlay(board, 0.86 * board, frame.abs() - 0.05, ROOM_EDGE)
        rgb = overlay(rgb, board, q[:, 1] - rail, ROOM_EDGE)
        return overlay(rgb, 0.93 * board, (q[:, 1] - rail).abs() - 0.04, ROOM_EDGE)

    return paint


def bricks(q: PlanePoints) -> Tensor:
    """A brick wall."""
    tall, long = 0.3, 0.9
    row = (q[:, 1] / tall).floor()
    x = q[:, 0] + 0.5 * long * torch.remainder(row, 2)
    shade = torch.frac(torch.sin(row * 78.233 + (x / long).floor() * 12.9898) * 437.585).abs()
    rgb = mix((0.42, 0.19, 0.14), (0.68, 0.36, 0.27), 0.6 * shade + 0.4 * fractal_noise(q, 0.2, 5))
    return overlay(
        rgb, (0.66, 0.62, 0.57), torch.minimum(line_distance(q[:, 1], tall), line_distance(x, long)) - 0.015, ROOM_EDGE
    )


def striped(a: RGB, b: RGB, period: float):
    """Texture of vertical stripes of two colours."""
    return lambda q: overlay(plain(a)(q), b, line_distance(q[:, 0], period) - period / 4, ROOM_EDGE)


def garden(q: PlanePoints) -> Tensor:
    """A hedge in front of a pale sky."""
    leaves = mix((0.07, 0.2, 0.06), (0.3, 0.48, 0.16), fractal_noise(q, 0.5, 7) * 1.6 - 0.3)
    top = 0.9 + 0.35 * fractal_noise(q * torch.tensor([1.0, 0.0]), 0.9, 12) + 0.1 * torch.sin(q[:, 0] * 2 * math.pi / 3)
    return overlay(
        leaves, mix((0.86, 0.9, 0.94), (0.55, 0.74, 0.93), (q[:, 1] - 0.8) / 1.2), top - q[:, 1], 2 * ROOM_EDGE
    )
