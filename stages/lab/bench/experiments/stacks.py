"""Experiments with bodies that come to rest on each other."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

import numpy as np
import torch

from stages.lab.assets.shapes import box
from stages.lab.bench.experiments.bodies import Run, Specimen, ball, block, bowl, cube, cylinder, polyhedron
from stages.lab.bench.experiments.experiment import GAPS, TOLERANCES, Experiment
from stages.lab.bench.experiments.measures import gap, largest_shift, overlap, path


def towers() -> Iterator[Experiment]:
    """Upright towers of cubes, with the topmost dropped from 5 mm."""
    for count, seconds in ((3, 2), (6, 2), (10, 2), (6, 20)):
        cubes = tuple(cube(0.2, bottom=0.2 * i) for i in range(count))
        run = Run(cubes, {"steps": 50 * seconds, "lift": (f"{count}=.005",)})
        yield Experiment(f"tower/{count} for {seconds}s", (run,), lambda t: largest_shift(t) / 0.2, 0.0,
                         "largest shift [sides]", 1.0, {"rigid": 0.05, "mpm": 0.1, "ngff": 0.1})  # fmt: skip


def stacks() -> Iterator[Experiment]:
    """Stacked bodies of unequal stiffness or size."""
    soft = (cube(0.3, E=1e5, density=100.0), cube(0.15, bottom=0.31, E=1e9, density=2700.0))
    small = (cube(0.5), cube(0.05, bottom=0.505))
    rod = (cube(0.2, -0.3), cube(0.2, 0.3), block((1.0, 0.1, 0.1), (0, 0, 0.26)))
    card = (Specimen(box((0.09, 0.06, 0.002), 0.002).moved((0, 0, 0.001))), cube(0.12, 0.02, 0.002, density=2900.0))
    on_card = Run(card, {"steps": 50, "lift": ("2=.01",)})
    yield Experiment("stack/box on a card", (on_card,), lambda t: float(path(t, 1)[-1, 2] + 0.01) / 0.002, 0.0,
                     "height above it [cards of 2 mm]", 1.0, dict.fromkeys(TOLERANCES, 0.1))  # fmt: skip
    yield Experiment("stack/heavy on soft", (Run(soft),), gap, 0.0, "gap [heights]", 1.0, GAPS)
    yield Experiment("stack/size 1:10", (Run(small),), gap, 0.0, "gap [heights]", 1.0, GAPS)
    yield Experiment("stack/rod on two boxes", (Run(rod),), lambda t: gap(t, 3, 1), 0.0, "gap [heights]", 1.0, GAPS)


def arches() -> Iterator[Experiment]:
    """Half a ring of seven wedges, .12 thick: it stands from .107 mean radii, here .039, on (Heyman 1969)."""
    turn = np.pi / 7 * np.arange(8)
    ring, across = np.stack([np.cos(turn), np.zeros(8), np.sin(turn)], 1), np.array([0.0, 0.05, 0.0])
    corners = [np.array([r * ring[k] + y * across for r in (0.3, 0.42) for k in (i, i + 1) for y in (-1, 1)])
               for i in range(7)]  # fmt: skip
    wedges = tuple(Specimen(polyhedron(c, 1500, i)) for i, c in enumerate(corners))
    yield Experiment("stack/arch of wedges", (Run(wedges, {"friction": 0.7}),), lambda t: largest_shift(t) / 0.12, 0.0,
                     "largest shift [thicknesses]", 1.0, TOLERANCES)  # fmt: skip


def piles() -> Iterator[Experiment]:
    """Heaps of many balls, a pile of logs, and a ball in a bowl."""
    inside = Run((Specimen(bowl(0.25, 0.3), E=1e7), ball(0.08, (0.0, 0.0, 0.14), loss=0.4)), {"steps": 150})
    yield Experiment("pile/ball in a bowl", (inside,), lambda t: float(t.com[-1, 1, 2]) / 0.08, 0.13 / 0.08,
                     "height of its middle [radii]", 1.0, TOLERANCES)  # fmt: skip
    places = ((-0.1, 0.1), (0.1, 0.1), (0.0, 0.1 + 0.1 * math.sqrt(3)))
    logs = tuple(Specimen(cylinder(0.1, 0.3, 0.01).moved((x, 0, z)), loss=0.02) for x, z in places)
    # the contact forces between logs are 15 degrees from the normal; the tangent is 0.268
    yield Experiment("pile/three logs", (Run(logs, {"friction": 0.3}),), lambda t: float(-path(t, 2)[-1, 2]) / 0.1, 0.0,
                     "fall of the upper one in 2 s [radii]", 1.0, TOLERANCES)  # fmt: skip
    for count in (20, 40):
        random = torch.Generator().manual_seed(count)
        places = torch.cartesian_prod(torch.arange(2.0), torch.arange(2.0), torch.arange(count / 4))
        jitter = 0.02 * torch.rand(places.shape, generator=random)
        centres = (0.24 * places + jitter + torch.tensor([0.0, 0.0, 0.11])).tolist()
        heap = Run(tuple(ball(0.1, tuple(c), loss=0.4) for c in centres), {"steps": 150})
        yield Experiment(f"pile/heap of {count}", (heap,), lambda t: overlap(t, 0.1), 0.0,
                         "largest overlap [diameters]", 1.0, {"rigid": 0.03, "mpm": 0.03, "ngff": 0.03})  # fmt: skip


def boxes() -> Iterator[Experiment]:
    """A box that falls onto a larger one, with materials from foam to steel."""
    for side, density, E in product((0.03, 0.06, 0.15, 0.3), (50.0, 540.0, 1000.0, 2700.0, 7850.0), (1e5, 1e7, 1e9)):
        pair = (cube(5 / 3 * side, E=E, density=density), cube(side, bottom=5 / 3 * side, E=E, density=density))
        # the upper box is lifted, since a box at rest may be put to sleep at its initial position
        dropped = Run(pair, {"steps": 50, "lift": (f"2={0.1 * side:g}",)})
        yield Experiment(f"boxes/{side:g}m {density:g}kg/m3 {E:.0e}Pa", (dropped,), gap, 0.0, "gap after 1 s [heights]",
                         1.0, GAPS)  # fmt: skip
