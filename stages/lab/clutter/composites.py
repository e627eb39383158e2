"""Random objects of several parts: figures, soft toys, brick vehicles, stands, devices, plants, boards.

They teach the segmentation network that parts joined by thin or bent pieces, or of different colours, can be one
object. The single-field shapes of props.py are mostly convex and have one texture.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages.core.geometry.rotations import matrix
from stages.lab.assets.field_sampling import PaintedPart
from stages.lab.assets.signed_distance import Field, capsule, ellipsoid, posed, revolved, slab, torus
from stages.lab.clutter.props import Prop, composite_prop, random_colour, random_paint

Rng = np.random.Generator
FIT = 0.5  # largest coordinate of the centre line of a part
UPRIGHT = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # rotates the y axis of a shape to the vertical


def make_composite(seed: int) -> Prop:
    """A random object of several parts, determined by the seed."""
    rng = np.random.default_rng([seed, 11])
    names, shares = list(FAMILIES), np.array([family.share for family in FAMILIES.values()])
    name = names[rng.choice(len(names), p=shares / shares.sum())]
    make, sizes, flat, _ = FAMILIES[name]
    return composite_prop(f"{name}{seed}", make(rng), sizes, flat)


def _paints(rng: Rng) -> Callable[[], Callable[[Tensor], Tensor]]:
    """A source of paints for the parts: one for all, a small palette, or a different one for each."""
    kind, count = rng.uniform(), int(rng.integers(2, 5))
    palette = [random_paint(rng) for _ in range(1 if kind < 0.4 else count)]
    if kind > 0.85:
        return lambda: random_paint(rng)
    return lambda: palette[rng.integers(len(palette))]


def _plain(rng: Rng) -> Callable[[Tensor], Tensor]:
    colour = random_colour(rng)
    return lambda p: colour.expand(len(p), 3)


def _box(centre: np.ndarray, half: np.ndarray, edge: float) -> Field:
    """A box with the given half sides along x, y, z and rounded edges."""
    return slab(centre.tolist(), half.tolist(), edge, edge)


def _limb(start: np.ndarray, length: float, thick: float, rng: Rng, drop: float) -> tuple[list[Field], np.ndarray]:
    """Two connected bones from `start` in random directions, and the end point."""
    fields, at = [], start
    for _ in range(2):
        step = rng.normal(size=3) * [1, 1, 0.6] - [0, 0, drop]
        end = np.clip(at + length * step / np.linalg.norm(step), -FIT, FIT)
        fields.append(capsule(at.tolist(), end.tolist(), thick, thick * rng.uniform(0.7, 1.1)))
        at = end
    return fields, at


def _figure(rng: Rng) -> list[PaintedPart]:
    """A plush animal or doll: trunk, head, four limbs with hands and feet, sometimes ears or a tail."""
    paint, trunk = _paints(rng), rng.uniform(0.08, 0.16)
    tall = rng.uniform(0.1, 0.2)
    parts = [PaintedPart(ellipsoid((0, 0, 0), (trunk, trunk * rng.uniform(0.7, 1.1), tall)), paint())]
    skull = rng.uniform(0.08, 0.16)
    head = np.array([rng.normal(0, 0.03), rng.normal(0, 0.03), tall + 0.8 * skull])
    parts.append(PaintedPart(ellipsoid(head.tolist(), (skull * np.exp(rng.normal(0, 0.2, 3))).tolist()), paint()))
    arms, legs = paint(), paint()
    for side in (-1, 1):
        for height, material, drop in ((0.6 * tall, arms, 0.3), (-0.8 * tall, legs, 0.6)):
            start = np.array([side * 0.8 * trunk, 0, height])
            thick = rng.uniform(0.018, 0.055)
            bones, end = _limb(start, rng.uniform(0.1, 0.3), thick, rng, drop)
            parts += [PaintedPart(bone, material) for bone in bones]
            if rng.uniform() < 0.7:
                grown = (thick * rng.uniform(1.1, 2.2, 3)).tolist()
                parts.append(PaintedPart(ellipsoid(end.tolist(), grown), material if rng.uniform() < 0.6 else paint()))
        if rng.uniform() < 0.5:
            ear = (head + [side * 0.7 * skull, 0, 0.7 * skull]).tolist()
            parts.append(PaintedPart(ellipsoid(ear, (rng.uniform(0.02, 0.05, 3)).tolist()), paint()))
    return parts


def _soft_toy(rng: Rng) -> list[PaintedPart]:
    """A plush animal that sits or sprawls: long limbs of one fabric, a large head with muzzle, mouth and eyes."""
    fabric = random_paint(rng) if rng.uniform() < 0.6 else _plain(rng)
    other = fabric if rng.uniform() < 0.6 else _plain(rng)
    trunk = np.array([rng.uniform(0.08, 0.15), rng.uniform(0.07, 0.13), rng.uniform(0.11, 0.2)])
    skull = rng.uniform(0.08, 0.15) * np.exp(rng.normal(0, 0.12, 3))
    head = np.array([rng.normal(0, 0.03), rng.uniform(-0.06, 0.03), trunk[2] + 0.8 * skull[2]])
    muzzle = head + [0, -0.8 * skull[1], -0.2 * skull[2]]
    parts = [PaintedPart(ellipsoid((0, 0, 0), trunk.tolist()), fabric),
             PaintedPart(ellipsoid(head.tolist(), skull.tolist()), fabric)]  # fmt: skip
    if rng.uniform() < 0.7:
        wide = skull * rng.uniform([0.5, 0.4, 0.3], [1.0, 0.9, 0.6])
        parts.append(PaintedPart(ellipsoid(muzzle.tolist(), wide.tolist()), fabric if rng.uniform() < 0.6 else other))
        inside = (muzzle - [0, 0.45 * wide[1], 0.1 * wide[2]]).tolist()
        parts.append(PaintedPart(ellipsoid(inside, (wide * [0.8, 0.6, 0.5]).tolist()), _plain(rng)))
    if rng.uniform() < 0.4:
        collar = [trunk[0] * 0.9, trunk[1] * 0.9, 0.02]
        parts.append(PaintedPart(ellipsoid((0, 0, 0.8 * trunk[2]), collar), _plain(rng)))
    thick, arm, leg = rng.uniform(0.02, 0.05), rng.uniform(0.2, 0.4), rng.uniform(0.25, 0.5)
    tip = other if rng.uniform() < 0.5 else fabric
    for side in (-1, 1):
        eye = (head + skull * [0.45 * side, -0.3, 0.85]).tolist()
        parts.append(PaintedPart(ellipsoid(eye, (rng.uniform(0.015, 0.04, 3)).tolist()), _plain(rng)))
        if rng.uniform() < 0.5:
            ear = (head + skull * [0.9 * side, 0.2, 0.7]).tolist()
            parts.append(PaintedPart(ellipsoid(ear, (rng.uniform(0.02, 0.07, 3)).tolist()), other))
        for start, length, toward in (
            (trunk * [0.8 * side, 0, 0.6], arm, rng.normal([0.7 * side, -0.4, -0.3], 0.5)),
            (trunk * [0.6 * side, 0, -0.8], leg, rng.normal([0.4 * side, -0.9, 0.0], 0.4)),
        ):
            at = start
            for _ in range(3):  # bends at a knee and an ankle
                end = np.clip(at + length / 3 * toward / np.linalg.norm(toward), -FIT, FIT)
                parts.append(
                    PaintedPart(capsule(at.tolist(), end.tolist(), thick, thick * rng.uniform(0.8, 1.0)), fabric)
                )
                at, toward = end, toward + rng.normal(0, 0.5, 3) * np.linalg.norm(toward)
            parts.append(PaintedPart(ellipsoid(at.tolist(), (thick * rng.uniform(0.8, 2.4, 3)).tolist()), tip))
    return parts


def _bricks(rng: Rng) -> list[PaintedPart]:
    """A vehicle or building of adjoining boxes, with wheels."""
    paints = [_plain(rng) for _ in range(int(rng.integers(1, 5)))]
    edge, boxes = rng.uniform(0.002, 0.015), []
    for _ in range(int(rng.integers(4, 11))):
        half = np.exp(rng.uniform(math.log(0.03), math.log(0.2), 3))
        if boxes:
            centre, old = boxes[rng.integers(len(boxes))]
            axis, side = rng.integers(3), rng.choice([-1, 1])
            shift = rng.uniform(-0.8, 0.8, 3) * old
            shift[axis] = side * (old[axis] + half[axis]) * 0.98
            centre = np.clip(centre + shift, -FIT + half, FIT - half)
        else:
            centre, half = np.zeros(3), half * [1.5, 1.0, 0.8]
        boxes.append((centre, half))
    parts = [PaintedPart(_box(c, h, min(edge, 0.4 * h.min())), paints[rng.integers(len(paints))]) for c, h in boxes]
    if rng.uniform() < 0.6:
        c, h = boxes[0]
        radius, dark = rng.uniform(0.04, 0.1), _plain(rng)
        for side in (-1, 1):
            for along in np.linspace(-0.8, 0.8, int(rng.integers(2, 4))):
                at = c + [along * h[0], side * (h[1] + 0.025), -h[2]]
                wheel = revolved([(0, -0.025), (radius, -0.025), (radius, 0.025), (0, 0.025)], 0.003)
                parts.append(PaintedPart(posed(wheel, UPRIGHT, at.tolist()), dark))
    return parts


def _stand(rng: Rng) -> list[PaintedPart]:
    """A foot, a thin pole, and a panel, ball, ring or shade on top: screens, lamps, globes, tools on a stand."""
    paint, low, high = _paints(rng), -0.45, rng.uniform(-0.1, 0.25)
    foot, thick = rng.uniform(0.1, 0.25), rng.uniform(0.01, 0.035)
    base = revolved([(0, low), (foot, low), (foot, low + 0.03), (0, low + 0.03)], 0.005)
    if rng.uniform() < 0.3:
        base = _box(np.array([0, 0, low]), np.array([foot, foot * rng.uniform(0.3, 1), 0.015]), 0.005)
    lean = rng.normal(0, 0.06, 2)
    parts = [PaintedPart(base, paint()),
             PaintedPart(capsule((0, 0, low), (lean[0], lean[1], high), thick, thick), paint())]  # fmt: skip
    kind = rng.integers(5)
    top = np.array([lean[0], lean[1], high + 0.1])
    if kind <= 1:  # a screen in a frame
        half = np.array([rng.uniform(0.2, 0.45), rng.uniform(0.012, 0.03), rng.uniform(0.12, 0.3)])
        top[2] = min(high + 0.5 * half[2], FIT - half[2])
        parts.append(PaintedPart(_box(top, half, 0.01), paint()))
        screen = half * [0.92, 1, 0.9]
        parts.append(PaintedPart(_box(top - [0, 0.004, 0], screen, 0.003), _plain(rng)))
    elif kind == 2:
        parts.append(PaintedPart(ellipsoid(top.tolist(), (rng.uniform(0.08, 0.25, 3)).tolist()), paint()))
    elif kind == 3:
        ring = rng.uniform(0.06, 0.15)
        field = posed(torus((0, 0, 0), ring, rng.uniform(0.015, 0.04)), UPRIGHT, (top + [0, 0, ring - 0.1]).tolist())
        parts.append(PaintedPart(field, paint()))
    else:
        wide, narrow, tall = rng.uniform(0.12, 0.25), rng.uniform(0.04, 0.12), rng.uniform(0.08, 0.18)
        shade = revolved([(0, -tall), (wide, -tall), (narrow, tall), (0, tall)], 0.01)
        parts.append(PaintedPart(posed(shade, torch.eye(3), top.tolist()), paint()))
    return parts


def _device(rng: Rng) -> list[PaintedPart]:
    """A housing with knobs, keys, a handle or a handset: telephones, clocks, tools, toys."""
    paint, half = _paints(rng), np.array([rng.uniform(0.2, 0.45), rng.uniform(0.15, 0.4), rng.uniform(0.03, 0.15)])
    parts = [PaintedPart(_box(np.zeros(3), half, rng.uniform(0.005, 0.025)), paint())]
    for _ in range(int(rng.integers(1, 9))):
        size = np.exp(rng.uniform(math.log(0.02), math.log(0.12), 3)) * [1, 1, 0.5]
        at = np.array([*(rng.uniform(-0.8, 0.8, 2) * half[:2]), half[2] + 0.6 * size[2]])
        field = _box(at, size, 0.3 * size.min()) if rng.uniform() < 0.6 else ellipsoid(at.tolist(), size.tolist())
        parts.append(PaintedPart(field, paint() if rng.uniform() < 0.5 else _plain(rng)))
    if rng.uniform() < 0.5:
        end, thick = 0.8 * half[0], rng.uniform(0.025, 0.05)
        high = half[2] + rng.uniform(0.05, 0.12)
        parts.append(PaintedPart(capsule((-end, 0, high), (end, 0, high), thick, thick), paint()))
        parts += [PaintedPart(capsule((s * end, 0, 0), (s * end, 0, high), thick, thick), paint()) for s in (-1, 1)]
    return parts


def _plant(rng: Rng) -> list[PaintedPart]:
    """A pot with leaves."""
    wide, low = rng.uniform(0.1, 0.2), -0.45
    pot = revolved([(0, low), (0.7 * wide, low), (wide, low + 0.25), (0, low + 0.25)], 0.01)
    parts, green = [PaintedPart(pot, random_paint(rng))], random_paint(rng)
    long = rng.uniform(0.2, 0.4)
    for _ in range(int(rng.integers(6, 13))):
        turn = matrix(torch.from_numpy(rng.normal(size=4)).float())
        azimuth, rise = rng.uniform(0, 2 * math.pi), rng.uniform(0.3, 1.4)
        reach = np.array([math.cos(azimuth) * math.cos(rise), math.sin(azimuth) * math.cos(rise), math.sin(rise)])
        end = np.clip([0, 0, low + 0.25] + 2 * long * reach, -FIT, FIT)
        stem = capsule((0, 0, low + 0.22), end.tolist(), 0.012, 0.008)
        leaf = ellipsoid(end.tolist(), (rng.uniform(0.03, 0.1), rng.uniform(0.03, 0.1), 0.012), turn)
        parts += [PaintedPart(stem, green), PaintedPart(leaf, green)]
    return parts


def _board(rng: Rng) -> list[PaintedPart]:
    """A flat plate with many small blocks: circuit boards, keyboards, trays, boxes of tools."""
    half = np.array([0.48, rng.uniform(0.15, 0.4), rng.uniform(0.008, 0.03)])
    parts, key = [PaintedPart(_box(np.zeros(3), half, 0.004), random_paint(rng))], _plain(rng)
    alike = rng.uniform() < 0.4
    for _ in range(int(rng.integers(4, 13))):
        size = np.array([rng.uniform(0.02, 0.15), rng.uniform(0.02, 0.12), rng.uniform(0.008, 0.03)])
        at = np.array([*(rng.uniform(-0.85, 0.85, 2) * half[:2]), half[2] + 0.7 * size[2]])
        parts.append(PaintedPart(_box(at, size, 0.003), key if alike else _plain(rng)))
    return parts


class Family(NamedTuple):
    """A kind of object: its generator and how it is used."""

    make: Callable[[Rng], list[PaintedPart]]
    sizes: tuple[float, float]  # range of the longest side [camera distances]
    flat: bool  # lies on its largest side
    share: float  # relative frequency


FAMILIES = {
    "figure": Family(_figure, (0.15, 0.6), False, 1), "soft toy": Family(_soft_toy, (0.15, 0.6), False, 2),
    "bricks": Family(_bricks, (0.1, 0.6), False, 1), "stand": Family(_stand, (0.15, 0.5), False, 1),
    "device": Family(_device, (0.1, 0.4), False, 1), "plant": Family(_plant, (0.15, 0.5), False, 1),
    "board": Family(_board, (0.12, 0.4), False, 1),
}  # fmt: skip
