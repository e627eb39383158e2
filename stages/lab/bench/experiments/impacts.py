"""Experiments on free motion, its invariance to units, and impacts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import torch
from torch import Tensor

from stages.core.geometry.rotations import matrix
from stages.core.scene.trajectory import Trajectory
from stages.lab.bench.experiments.bodies import Run, ball, block, cube
from stages.lab.bench.experiments.experiment import TOLERANCES, Experiment, G
from stages.lab.bench.experiments.measures import largest_difference, largest_shift, path, rebound, spin


def falls() -> Iterator[Experiment]:
    """Free fall."""
    for g in (1.62, 9.81, 25.0):
        frames = round(math.sqrt(2 * 0.2 / g) / 0.02)
        run = Run((cube(0.2, bottom=0.4),), {"gravity": g, "steps": frames + 1})
        value = g * (0.02 * frames) ** 2 / 2
        yield Experiment(f"fall/gravity={g:g}", (run,), lambda t: float(-path(t, 0)[-1, 2]), value, "fall [m]", value,
                         TOLERANCES)  # fmt: skip


def torques() -> Iterator[Experiment]:
    """A torque and a force, each applied for 0.2 s, on a box and a ball in free space."""
    density, side, radius = 540.0, 0.3, 0.15
    mass = {"box": density * side**3, "ball": density * 4 / 3 * math.pi * radius**3}
    inertia = {"box": mass["box"] * side**2 / 6, "ball": 0.4 * mass["ball"] * radius**2}
    bodies = {"box": cube(side, bottom=0.6), "ball": ball(radius, (0, 0, 0.75))}
    for name, body in bodies.items():
        options = {"gravity": 0.0, "force": (f"object=1 torque=0,0,{5 * inertia[name]:.6g} to=0.2",), "steps": 26}
        yield Experiment(f"torque/{name}", (Run((body,), options),), spin, 1.0, "angular speed [rad/s]", 1.0,
                         TOLERANCES)  # fmt: skip
        options = {"gravity": 0.0, "force": (f"object=1 force={5 * mass[name]:.6g},0,0 to=0.2",), "steps": 26}
        yield Experiment(f"push/{name}", (Run((body,), options),),
                         lambda t: float(path(t, 0)[-1, 0] - path(t, 0)[-2, 0]) / t.info.dt, 1.0, "speed [m/s]", 1.0,
                         TOLERANCES)  # fmt: skip


def tumbling() -> Iterator[Experiment]:
    """A box in free space that a push of 10 ms turns about its middle axis, and 5 % about its longest one: it flips."""
    sides, push = torch.tensor([0.3, 0.2, 0.1]), 0.01
    moments = 540.0 * sides.prod() / 12 * (sides.square().sum() - sides.square())
    turn = moments * torch.tensor([0.5, 10.0, 0.0])
    torque = ",".join(f"{float(v):.6g}" for v in turn / push)
    body = block(tuple(sides.tolist()), (0.0, 0.0, 0.5))
    run = Run((body,), {"gravity": 0.0, "force": (f"object=1 torque={torque} to={push}",), "dt": push, "steps": 101})

    def flip(t: Trajectory) -> float:
        middle = matrix(t.rotation[:, 0])[:, :, 1] @ (turn / turn.norm())
        k = int((middle[1:] < 0).nonzero()[0])
        return t.info.dt * (k + float(middle[k] / (middle[k] - middle[k + 1])))

    value = push / 2 + flip_time(moments, turn)
    yield Experiment("free space/flip", (run,), flip, value, "time [s]", value, TOLERANCES)


def flip_time(moments: Tensor, momentum: Tensor) -> float:
    """Time [s] after which a body has turned its middle axis across its angular momentum [kg m^2 / s].

    Euler's equations, by the midpoint rule.
    """
    moments, x, step, time = moments.double(), momentum.double(), 1e-4, 0.0
    while x[1] > 0:
        middle = x + step / 2 * torch.linalg.cross(x, x / moments)
        x = x + step * torch.linalg.cross(middle, middle / moments)
        time += step
    return time


def invariance() -> Iterator[Experiment]:
    """The same motion in other units of length and mass."""

    def stack(s: float = 1.0, factor: float = 1.0) -> Run:
        more = {"density": 540.0 * factor, "E": 1e7 * factor * s}  # keeps E / (density g size) constant
        return Run((cube(0.3 * s, **more), cube(0.18 * s, 0.02 * s, 0.33 * s, **more)),
                   {"steps": 40, "dt": 0.02 * math.sqrt(s),
                    "velocity": (f"object=2 {0.5 * math.sqrt(s)},0,0",)})  # fmt: skip

    for s in (0.01, 0.1, 10.0, 100.0):
        yield Experiment(f"scale/{s:g}", (stack(), stack(s)), lambda a, b, s=s: largest_difference(a, b, s, 0.18), 0.0,
                         "difference of motion [sizes]", 1.0, TOLERANCES)  # fmt: skip
    for factor in (0.1, 10.0):
        yield Experiment(f"mass and E/{factor:g}", (stack(), stack(factor=factor)),
                         lambda a, b: largest_difference(a, b, 1.0, 0.18), 0.0, "difference of motion [sizes]", 1.0,
                         TOLERANCES)  # fmt: skip


def collisions() -> Iterator[Experiment]:
    """Collisions in free space and of a row of balls, and two boxes at rest beside each other."""
    pair = Run((ball(0.15, (0, 0, 0.5)), ball(0.15, (0.6, 0, 0.5), density=1080.0)),
               {"gravity": 0.0, "velocity": ("object=1 1,0,0",), "steps": 50})  # fmt: skip
    mass = torch.tensor([1.0, 2.0])

    def speeds(t: Trajectory) -> Tensor:
        return (t.com[-1, :, 0] - t.com[-6, :, 0]) / (5 * t.info.dt)

    yield Experiment("collision/momentum", (pair,), lambda t: float(mass @ speeds(t)), 1.0, "momentum, 1 before", 1.0,
                     TOLERANCES)  # fmt: skip
    e = math.exp(-math.pi * 0.15 / 2)
    yield Experiment("collision/restitution", (pair,), lambda t: float(speeds(t) @ torch.tensor([-1.0, 1.0])), e,
                     "speed of separation, 1 of approach", 1.0, TOLERANCES)  # fmt: skip
    row = tuple(ball(0.1, (0.2 * i - 0.1 * (i == 0), 0, 0.1)) for i in range(5))
    hit = Run(row, {"friction": 0.0, "velocity": ("object=1 1,0,0",), "dt": 0.01, "steps": 41})
    yield Experiment("collision/row of five", (hit,), lambda t: float(path(t, 4)[-1, 0] - path(t, 4)[-6, 0]) / 0.05,
                     ((1 + e) / 2) ** 4, "speed of the last one, 1 of the first", 1.0, TOLERANCES)  # fmt: skip
    still = Run((cube(0.3, bottom=0.5), cube(0.3, 0.5, 0.5)), {"gravity": 0.0})
    yield Experiment("free space/two at rest", (still,), lambda t: largest_shift(t) / 0.3, 0.0, "largest shift [sides]",
                     1.0, TOLERANCES)  # fmt: skip


def rebounds() -> Iterator[Experiment]:
    """Balls and boxes that fall onto the floor from half a metre."""
    for (name, body), loss in product((("ball", ball(0.15, (0, 0, 0.15))), ("box", cube(0.3))), (0.05, 0.15, 0.4)):
        run = Run((replace(body, loss=loss),), {"lift": ("0.5",), "dt": 0.01, "steps": 100})
        yield Experiment(f"rebound/{name} loss={loss:g}", (run,), lambda t: rebound(t, 0.5),
                         math.exp(-math.pi * loss / 2), "restitution", 1.0, TOLERANCES)  # fmt: skip

    soft = replace(ball(0.15, (0, 0, 0.15)), E=2e5, density=600.0)  # compressed by a sixth in the impact
    run = Run((soft,), {"lift": ("0.5",), "dt": 0.01, "steps": 100})
    yield Experiment("rebound/soft ball loss=0.15", (run,), lambda t: rebound(t, 0.5), math.exp(-math.pi * 0.15 / 2),
                     "restitution", 1.0, TOLERANCES)  # fmt: skip


def bounces() -> Iterator[Experiment]:
    """A ball falls 0.5 m with a horizontal speed: friction takes mu (1 + e) times its normal speed, until it rolls."""
    for loss, mu in product((0.02, 0.15), (0.1, 0.5)):
        body = replace(ball(0.15, (0, 0, 0.15)), loss=loss)
        run = Run((body,), {"lift": ("0.5",), "velocity": ("object=1 3,0,0",), "friction": mu, "dt": 0.01, "steps": 61})
        lost = mu * (1 + math.exp(-math.pi * loss / 2)) * math.sqrt(2 * G * 0.5)
        yield Experiment(f"bounce/friction={mu:g} loss={loss:g}", (run,),
                         lambda t: float(path(t, 0)[-1, 0] - path(t, 0)[-11, 0]) / (10 * t.info.dt),
                         max(3 - lost, 15 / 7), "horizontal speed, 3 before [m/s]", 3.0, TOLERANCES)  # fmt: skip
