"""Objects that lie around on tables, as Gaussians: procedural shapes with random colours, and textured meshes.

Lengths are relative to the distance of the cameras, the unit of length of clutter scenes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.scene.gaussians import Gaussians, transformed
from stages.lab.assets.field_sampling import (
    PaintedPart,
    ambient_occlusion,
    diffuse_light,
    normalise_size,
    sample_parts,
    sample_surface,
)
from stages.lab.assets.paint import overlay
from stages.lab.assets.random_shapes import FAMILIES
from stages.lab.assets.shapes import noise, single_threaded, to_gaussians
from stages.lab.assets.signed_distance import (
    Field,
    capsule,
    curve_through,
    posed,
    revolved,
    revolved_wall,
    slab,
    tube,
    union,
)

Rng = np.random.Generator
POINTS = 9000  # Gaussians per object
EXTENT = 0.62  # half side of a cube that contains every shape before normalisation
SKIN = 0.004  # half width of the band sampled around a surface, less than half the thickness of the thinnest sheet


@dataclass(frozen=True)
class Prop:
    """An object with longest side 1, centred on the origin, and how it is used."""

    name: str
    gaussians: Gaussians  # all have object_id 1
    sizes: tuple[float, float]  # range of the longest side [camera distances]
    flat: bool = False  # lies on its largest side, which is horizontal in this orientation
    clutter: bool = False  # too thin to be an object that a user would move; labelled as background
    parts: Int[Tensor, "n"] | None = None  # convex part of each Gaussian; None: collides as one convex hull


def _book(rng: Rng) -> Field:
    return slab((0, 0, 0), (0.5, rng.uniform(0.04, 0.16), rng.uniform(0.28, 0.48)), 0.01, 0.008)


def _carton(rng: Rng) -> Field:
    sides = np.exp(rng.uniform(math.log(0.2), math.log(0.5), 3))
    return slab((0, 0, 0), (0.5 * sides / sides.max()).tolist(), 0.012, 0.01)


def _sheet(rng: Rng) -> Field:
    """A flat object such as a magazine, a phone, a keyboard or a mat."""
    thick = math.exp(rng.uniform(math.log(0.012), math.log(0.05)))
    return slab((0, 0, 0), (0.5, thick, rng.uniform(0.15, 0.5)), rng.uniform(0.005, 0.1), 0.4 * thick)


def _bottle(rng: Rng) -> Field:
    radius, neck = rng.uniform(0.1, 0.19), rng.uniform(0.03, 0.06)
    shoulder, top = rng.uniform(-0.05, 0.25), 0.48
    outline = [(0, -0.5), (radius, -0.5), (radius, shoulder), (neck, shoulder + rng.uniform(0.05, 0.2)),
               (neck, top), (0, top)]  # fmt: skip
    return revolved(outline, 0.01)


def _can(rng: Rng) -> Field:
    radius, height = rng.uniform(0.2, 0.5), rng.uniform(0.15, 0.5)
    return revolved([(0, -height), (radius, -height), (radius, height), (0, height)], rng.uniform(0.002, 0.03))


def _cup(rng: Rng) -> Field:
    height, low = rng.uniform(0.2, 0.45), rng.uniform(0.18, 0.35)
    high = low * rng.uniform(0.9, 1.5)
    wall = revolved_wall([(0, -height), (low, -height), (high, height)], 0.035)
    if rng.uniform() < 0.5:
        return wall
    reach = (low + high) / 2
    knots = [[reach - 0.02, 0, 0.5 * height], [reach + 0.16, 0, 0.4 * height], [reach + 0.16, 0, -0.3 * height],
             [reach - 0.03, 0, -0.5 * height]]  # fmt: skip
    return union(wall, tube(curve_through(knots, 60), 0.03), smooth=0.02)


def _plush(rng: Rng) -> Field:
    """A soft toy: body, head, limbs."""
    limbs = FAMILIES["doll"](rng)
    return union(limbs, *(capsule((0, 0, 0.2), (float(x), 0, 0.36), 0.1, 0.08) for x in (-0.1, 0.1)), smooth=0.06)


def _pen(rng: Rng) -> Field:
    thick = rng.uniform(0.018, 0.035)
    return capsule((-0.48, 0, 0), (0.48, 0, 0), thick, thick)


def _cable(rng: Rng) -> Field:
    knots = np.cumsum(rng.normal(size=(7, 3)) * [1, 1, 0.0], 0)
    knots = 0.48 * (knots - knots.mean(0)) / np.abs(knots - knots.mean(0)).max()
    return tube(curve_through(knots.tolist(), 300), rng.uniform(0.012, 0.02))


SHAPES: dict[str, tuple[Callable[[Rng], Field], tuple[float, float], float]] = {  # field, sizes, relative frequency
    "book": (_book, (0.1, 0.32), 2.0), "carton": (_carton, (0.05, 0.32), 3.0), "sheet": (_sheet, (0.08, 0.35), 3.0),
    "bottle": (_bottle, (0.1, 0.35), 2.0), "can": (_can, (0.05, 0.22), 2.0), "cup": (_cup, (0.07, 0.25), 2.0),
    "plush": (_plush, (0.12, 0.45), 1.0), "pen": (_pen, (0.08, 0.15), 1.0), "cable": (_cable, (0.2, 0.5), 0.6),
    "egg": (FAMILIES["egg"], (0.06, 0.3), 1.0), "lump": (FAMILIES["lump"], (0.06, 0.3), 1.0),
    "vessel": (FAMILIES["vessel"], (0.08, 0.3), 1.0), "ring": (FAMILIES["ring"], (0.06, 0.2), 0.4),
    "doll": (FAMILIES["doll"], (0.1, 0.4), 1.0), "box": (FAMILIES["box"], (0.05, 0.3), 1.0),
}  # fmt: skip
LEVEL = ("sheet", "book")  # shapes that lie on their largest side, which is perpendicular to their y axis
CLUTTER = ("pen", "cable")  # shapes labelled as background


def make_prop(seed: int) -> Prop:
    """A random shape with random colours, determined by the seed."""
    rng = np.random.default_rng([seed, 7])
    names = list(SHAPES)
    weight = np.array([SHAPES[name][2] for name in names])
    name = names[rng.choice(len(names), p=weight / weight.sum())]
    make, sizes, _ = SHAPES[name]
    field, flat = make(rng), name in (*LEVEL, "cable", "pen")
    if name in LEVEL:
        field = posed(field, torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    with single_threaded():
        surface = sample_surface(field, (EXTENT,) * 3, POINTS, SKIN)
        light = diffuse_light(surface) * ambient_occlusion(field, surface)
        rgb = random_paint(rng)(surface.points) * light[:, None]
        g = to_gaussians(surface, rgb, 1, width=0.75)
    return Prop(f"{name}{seed}", normalise_size(g), sizes, flat, name in CLUTTER)


def mesh_prop(files: Sequence[Path], name: str) -> Prop:
    """A textured mesh; trays and other flat objects lie on their largest side."""
    from stages.lab.assets.meshes import read_mesh

    g = read_mesh(files, POINTS, up="y")
    sides = g.means.amax(0) - g.means.amin(0)
    return Prop(name, g, (0.1, 0.4), bool(sides[2] < 0.15 * sides.max()))


def composite_prop(name: str, parts: list[PaintedPart], sizes: tuple[float, float], flat: bool = False) -> Prop:
    """An object of several convex parts."""
    with single_threaded():
        g, owner = sample_parts(parts, (EXTENT,) * 3, POINTS, smooth=0.004, skin=SKIN)
    return Prop(name, normalise_size(replace(g, sh=g.sh[:, :1])), sizes, flat, parts=owner)


def random_colour(rng: Rng) -> Float[Tensor, "3"]:
    """A random colour: a shade of grey in about a third of the cases, otherwise a hue of random saturation."""
    if rng.uniform() < 0.35:
        return torch.full((3,), float(rng.choice([0.04, 0.08, 0.3, 0.6, 0.85, 0.93]))) + 0.02 * torch.from_numpy(
            rng.normal(size=3)
        ).float().clamp(-2, 2)
    grey, rgb = rng.uniform(0.1, 0.8), torch.from_numpy(rng.uniform(0.02, 0.95, 3)).float()
    return rgb + (grey - rgb) * float(rng.uniform(0, 0.6))


def random_paint(rng: Rng) -> Callable[[Tensor], Tensor]:
    """A random surface colour: uniform, or with up to four layers of spots, stripes, bands and print."""
    base = random_colour(rng)
    layers = [_layer(rng) for _ in range(int(rng.integers(0, 5)))]

    def paint(p: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        rgb = base.expand(len(p), 3)
        for colour, distance in layers:
            rgb = overlay(rgb, colour, distance(p), 0.01)
        return rgb

    return paint


def _layer(rng: Rng) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """A colour, and the signed distance to the region that has it."""
    kind, seed, axis = rng.integers(4), int(rng.integers(1 << 30)), torch.from_numpy(rng.normal(size=3)).float()
    axis = torch.nn.functional.normalize(axis * torch.tensor([0.4, 0.4, 1.0]), dim=0)
    at, wide, size = float(rng.uniform(-0.35, 0.35)), float(rng.uniform(0.02, 0.2)), float(rng.uniform(0.03, 0.4))
    if kind == 0:
        return random_colour(rng), lambda p: 0.3 * size * (0.62 - noise(p + 5, size, seed))
    if kind == 1:
        return random_colour(rng), lambda p: (p @ axis - at).abs() - wide
    if kind == 2:
        return random_colour(rng), lambda p: (torch.remainder(p @ axis, 2 * wide) - wide).abs() - 0.5 * wide
    fine = float(rng.uniform(0.015, 0.04))
    return random_colour(rng), lambda p: torch.maximum(
        fine * (0.55 - noise(p + 5, fine, seed)), (p @ axis - at).abs() - wide
    )


def recoloured(g: Gaussians, rng: Rng) -> Gaussians:
    """The object in other colours: channels permuted and brightness scaled."""
    order = torch.from_numpy(rng.permutation(3))
    return replace(g, sh=g.sh[:, :, order] * float(rng.uniform(0.8, 1.15)))


def random_turn(rng: Rng, flat: bool) -> Float[Tensor, "3 3"]:
    """A rotation about the vertical, or in one case of four, unless `flat`, any rotation."""
    angle = rng.uniform(0, 2 * math.pi)
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float32)
    if not flat and rng.uniform() < 0.25:
        turn = matrix(torch.from_numpy(rng.normal(size=4)).float())
    return turn


def placed(g: Gaussians, scale: float, R: Float[Tensor, "3 3"], at: Float[Tensor, "3"]) -> Gaussians:
    """The object scaled, rotated and moved."""
    return transformed(g, Similarity(scale, R, at))
