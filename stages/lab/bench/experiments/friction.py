"""Experiments with bodies that slide, roll or lean on the floor, on a slope or on each other."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

from stages.core.scene.trajectory import Trajectory
from stages.lab.assets.shapes import box, ellipsoid
from stages.lab.bench.experiments.bodies import (
    Run,
    Specimen,
    about_z,
    block,
    compound,
    cylinder,
    on_slope,
    tilted,
    wedge,
)
from stages.lab.bench.experiments.experiment import SLIDES, TOLERANCES, Experiment, G
from stages.lab.bench.experiments.measures import path


def slides() -> Iterator[Experiment]:
    """Boxes sliding on the floor until friction stops them."""
    for mu in (0.0, 0.1, 0.3, 0.6, 1.0):
        run = Run((block((0.3, 0.2, 0.08), (0, 0, 0.04)),), {"velocity": ("object=1 2,0,0",), "friction": mu})
        time = 99 * 0.02
        stop = 4 / (2 * mu * G) if mu else math.inf
        value = min(stop, 2 * time - mu * G * time**2 / 2) if mu * G * time < 2 else stop
        yield Experiment(f"slide/friction={mu:g}", (run,), lambda t: float(path(t, 0)[-1, 0]), value,
                         "distance from 2 m/s in 2 s [m]", value, SLIDES)  # fmt: skip

    body = replace(block((0.3, 0.3, 0.15), (0, 0, 0.075)), loss=0.01)
    run = Run((body,), {"velocity": ("object=1 .3,0,0",), "friction": 0.1})  # the impact speed of a fall of 5 mm
    value = 0.09 / (2 * 0.1 * G)
    yield Experiment("slide/slow friction=0.1", (run,), lambda t: float(path(t, 0)[-1, 0]), value,
                     "distance from .3 m/s [m]", value, SLIDES)  # fmt: skip

    for mu in (0.1, 0.3, 0.6):  # a body that is compressed by 2.1 % under its own weight
        run = Run((block((0.3, 0.2, 0.08), (0, 0, 0.04), E=1e5, density=2700.0),),
                  {"velocity": ("object=1 1,0,0",), "friction": mu, "steps": 76})  # fmt: skip
        value = 1 / (2 * mu * G)
        yield Experiment(f"slide/soft friction={mu:g}", (run,), lambda t: float(path(t, 0)[-1, 0]), value,
                         "distance from 1 m/s [m]", value, SLIDES)  # fmt: skip


def compound_slides() -> Iterator[Experiment]:
    """Compound bodies that start at 1 m/s along x on other compound bodies, which are pinned."""
    stool = compound(0.008, ((0.3, 0.3, 0.04), (0, 0, 0.18)),
                     *(((0.04, 0.04, 0.16), (x, y, 0.08)) for x, y in product((-0.13, 0.13), repeat=2)))  # fmt: skip
    bridge = compound(0.01, ((0.3, 0.1, 0.04), (0, 0, 0.14)), ((0.04, 0.1, 0.12), (-0.13, 0, 0.06)),
                      ((0.04, 0.1, 0.12), (0.13, 0, 0.06)))  # fmt: skip
    tee = compound(0.01, ((0.24, 0.08, 0.05), (0, 0, 0.025)), ((0.06, 0.06, 0.14), (0, 0, 0.12)))
    shelf = compound(0.012, ((1.0, 0.4, 0.03), (0, 0, -0.015)), ((0.03, 0.4, 0.3), (-0.485, 0, -0.18)),
                     ((0.03, 0.4, 0.3), (0.485, 0, -0.18)))  # fmt: skip
    rail = compound(0.01, ((1.2, 0.2, 0.03), (0, 0, -0.015)), ((0.04, 0.2, 0.1), (-0.58, 0, 0.02)))
    pairs = {
        "stool on shelf": (stool, shelf, 0),
        "bridge on shelf": (bridge, shelf, 5),
        "tee on rail": (tee, rail, 10),
    }
    for (name, (above, below, degrees)), mu in product(pairs.items(), (0.2, 0.6)):
        bodies = below.moved((0, 0, 0.4)), about_z(above, degrees).moved((-0.3, 0, 0.4))
        value = 1 / (2 * mu * G)
        run = Run(tuple(map(Specimen, bodies)), {"pin": ("1",), "velocity": ("object=2 1,0,0",), "friction": mu,
                                                 "steps": 10 + math.ceil(1 / (mu * G * 0.02))})  # fmt: skip
        yield Experiment(f"slide/{name} friction={mu:g}", (run,), lambda t: float(path(t, 1)[-1, 0]), value,
                         "distance from 1 m/s [m]", value, SLIDES)  # fmt: skip


def slopes() -> Iterator[Experiment]:
    """A box released on a slope, which slides or sticks."""
    for degrees, mu in product((10, 25, 40), (0.0, 0.3, 0.8)):
        a, time = math.radians(degrees), 30 * 0.02
        pull = G * max(math.sin(a) - mu * math.cos(a), 0.0)
        run = on_slope(degrees, 0.15, {"friction": mu, "steps": 31})
        yield Experiment(f"slope/{degrees}deg friction={mu:g}", (run,), lambda t: float(path(t, 1)[-1].norm()),
                         pull * time**2 / 2, "distance in .6 s [m]", G * math.sin(a) * time**2 / 2, SLIDES)  # fmt: skip


def rolls() -> Iterator[Experiment]:
    """A solid ball rolling on a slope without slip: a = 5/7 g sin(slope), since its inertia is 2/5 m r^2."""
    radius, time = 0.1, 30 * 0.02
    for degrees in (10, 25):
        distance = 5 / 7 * G * math.sin(math.radians(degrees)) * time**2 / 2
        run = on_slope(
            degrees, 0.15, {"friction": 0.8, "steps": 31}, ellipsoid((radius,) * 3, 1500).moved((0, 0, radius))
        )
        yield Experiment(f"roll/{degrees}deg", (run,), lambda t: float(path(t, 1)[-1].norm()), distance,
                         "distance in .6 s [m]", distance, TOLERANCES)  # fmt: skip


def grooves() -> Iterator[Experiment]:
    """A ball in a groove of 90 degrees that slides until it rolls; the axis of its turn is r / sqrt(2) away."""
    radius, at = 0.05, (-0.21 + 0.05, -0.15, 0.04 + 0.05)
    wall = compound(0.012, ((0.5, 0.4, 0.04), (0.0, 0.0, 0.02)), ((0.04, 0.4, 0.36), (-0.23, 0.0, 0.22)))
    bodies = (tilted(body, -45).moved((0, 0, 0.5)) for body in (wall, ellipsoid((radius,) * 3, 1500).moved(at)))
    run = Run(tuple(Specimen(body, loss=0.02) for body in bodies),
              {"pin": ("1",), "friction": 0.8, "velocity": ("object=2 0,.4,0",), "steps": 31})  # fmt: skip
    yield Experiment("roll/groove", (run,), lambda t: float(t.com[-1, 1, 1] - t.com[-11, 1, 1]) / (0.2 * 0.4), 1 / 1.8,
                     "speed, 1 before", 1 / 1.8, TOLERANCES)  # fmt: skip


def rocking() -> Iterator[Experiment]:
    """A block released while leaning on a lower edge: it rotates about the edge like an inverted pendulum."""
    width, height, start, time = 0.2, 0.3, math.radians(12), 0.14
    # the corner points of a sampled box lie half a spacing inside it, here 3 % of the lever arm of its weight
    leaning = tilted(box((width, height, height), 0.004).moved((-width / 2, 0, height / 2)), math.degrees(start))
    left = leaning_angle(width, height, start, time)
    run = Run((Specimen(leaning),), {"friction": 1.0, "dt": 0.01, "steps": 15})

    def angle(t: Trajectory) -> float:
        return math.degrees(start + 2 * math.atan2(*t.rotation[-1, 0, [2, 0]].tolist()))

    yield Experiment("rocking/12deg", (run,), angle, math.degrees(left), "angle after .14 s [degrees]",
                     math.degrees(start - left), TOLERANCES)  # fmt: skip


def leaning_angle(width: float, height: float, start: float, time: float) -> float:
    """Angle [rad] of a rigid block leaning on an edge, `time` [s] after its release at the angle `start` [rad].

    Housner 1963, "The behavior of inverted pendulum structures during earthquakes", equation 2:
    4/3 m R^2 angle'' = -m g R sin(slenderness - angle), with half diagonal R; integrated by small leapfrog steps.
    """
    slenderness, half_diagonal = math.atan2(width, height), math.hypot(width, height) / 2
    steps = 10_000
    dt, angle, rate = time / steps, start, 0.0
    for k in range(steps):
        rate -= dt * (0.5 if k == 0 else 1) * 0.75 * G / half_diagonal * math.sin(slenderness - angle)
        angle += dt * rate
    return angle


def wedges() -> Iterator[Experiment]:
    """A block on a wedge of the same mass that can slide on the floor, without any friction."""
    degrees, length, width, side, time = 30.0, 0.4, 0.2, 0.16, 0.25
    below, block = wedge(length, width, degrees, 0.01), box((side,) * 3, 0.01).moved((0, 0, side / 2))
    block = tilted(block.moved((-0.08, 0, 0)), degrees).moved((0, 0, length / 2 * math.tan(math.radians(degrees))))
    heavy = length**2 * math.tan(math.radians(degrees)) / 2 * width  # volume of the wedge
    run = Run((Specimen(below), Specimen(block, density=540.0 * heavy / side**3)),
              {"friction": 0.0, "dt": 0.01, "steps": 26})  # fmt: skip
    sine, cosine = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    value = G * sine * cosine / (1 + sine**2) * time**2 / 2
    yield Experiment("slide/block on a loose wedge", (run,), lambda t: float(-path(t, 0)[-1, 0]), value,
                     "way of the wedge in .25 s [m]", value, SLIDES)  # fmt: skip


def ladders() -> Iterator[Experiment]:
    """A ladder between a wall and a floor without friction, until it has rotated 21 degrees; later it loses contact."""
    length, thick, spacing, start, time = 1.0, 0.06, 0.01, 60.0, 0.3
    ladder = tilted(box((length, 0.2, thick), spacing), start)
    low = ladder.points.amin(0).tolist()
    wall = box((0.1, 0.6, 1.2), 0.03).moved((-0.05, 0, 0.6))
    run = Run((Specimen(wall), Specimen(ladder.moved((-low[0], 0, -low[2])))),
              {"pin": ("1",), "friction": 0.0, "dt": 0.01, "steps": 31})  # fmt: skip
    left = ladder_angle(
        length - spacing, thick - spacing, math.radians(start), time
    )  # the edges of the sampled faces lie half a spacing inside

    def turned(t: Trajectory) -> float:
        return math.degrees(abs(2 * math.atan2(*t.rotation[-1, 1, [2, 0]].tolist())))

    yield Experiment("lean/ladder", (run,), turned, start - math.degrees(left), "turned in .3 s [degrees]",
                     start - math.degrees(left), TOLERANCES)  # fmt: skip


def ladder_angle(length: float, thick: float, start: float, time: float) -> float:
    """Angle [rad] of a board leaning on a wall, `time` [s] after its release at the angle `start` [rad].

    The edges of its lower side touch wall and floor without friction. Lagrange's equation per unit mass, with the
    centre at x, z and primes for derivatives by the angle:
    (I + x'^2 + z'^2) angle'' = -g z' - (x' x'' + z' z'') angle'^2; integrated by small steps.
    """
    steps = 10_000
    dt, angle, rate = time / steps, start, 0.0
    for _ in range(steps):
        sine, cosine = math.sin(angle), math.cos(angle)
        x1, z1 = (thick * cosine - length * sine) / 2, (length * cosine - thick * sine) / 2
        x2, z2 = -(thick * sine + length * cosine) / 2, -(length * sine + thick * cosine) / 2
        inertia = (length**2 + thick**2) / 12 + x1**2 + z1**2
        rate -= dt * (G * z1 + (x1 * x2 + z1 * z2) * rate**2) / inertia
        angle += dt * rate
    return angle


def levers() -> Iterator[Experiment]:
    """A board on a fixed round bar with a block on each arm, the right one with twice the mass of the left one."""
    radius, length, thick, side, arm, time = 0.15, 1.2, 0.03, 0.08, 0.4, 0.15
    top = 0.4 + radius
    board = box((length, 0.2, thick), 0.005).moved((0, 0, top + thick / 2))
    blocks = [(box((side,) * 3, 0.004).moved((x, 0, top + thick + side / 2)), rho)
              for x, rho in ((-arm, 1000.0), (arm, 2000.0))]  # fmt: skip
    run = Run((Specimen(cylinder(radius, 0.3, 0.0125).moved((0, 0, 0.4))), Specimen(board),
               *(Specimen(b, density=rho) for b, rho in blocks)),
              {"pin": ("1",), "friction": 0.8, "dt": 0.01, "steps": 16})  # fmt: skip
    mass, light = 540.0 * length * 0.2 * thick, 1000.0 * side**3
    up = thick + side / 2
    # moment of inertia about the contact line
    inertia = mass * (length**2 / 12 + thick**2 / 3) + 3 * light * (side**2 / 6 + arm**2 + up**2)
    value = math.degrees(light * arm * G / inertia * time**2 / 2)

    def turned(t: Trajectory) -> float:
        return math.degrees(2 * math.atan2(*t.rotation[-1, 1, [2, 0]].tolist()))

    yield Experiment("lean/see-saw", (run,), turned, value, "angle after .15 s [degrees]", value, TOLERANCES)


def creep() -> Iterator[Experiment]:
    """A box held by friction on a slope for ten seconds."""
    for loss in (0.02, 0.15):
        run = on_slope(15, loss, {"friction": 0.3, "steps": 501})  # tan 15 degrees is 0.268
        yield Experiment(f"creep/15deg friction=0.3 loss={loss:g}", (run,),
                         lambda t: 1e4 * float((t.com[-1, 1] - t.com[25, 1]).norm()) / 0.2, 0.0,
                         "distance from .5 to 10 s [1e-4 sides]", 1.0, dict.fromkeys(TOLERANCES, 1.0))  # fmt: skip
