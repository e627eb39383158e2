"""Textbook experiments for the engines of `ngff simulate`: scene, prompts, what is measured, and its analytic value.

Bodies are closed surfaces of Gaussians, as a perfect reconstruction would give them. What is measured is read from the
trajectory alone. Tolerances are relative to `scale`: what the engines are required to reach, not what they do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from types import MappingProxyType

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.trajectory import Trajectory
from stages.lab.assets.shapes import Surface, box, ellipsoid, to_gaussians, union

G = 9.81
POINTS_ALONG = 28  # Gaussians along the side of a cube
TOLERANCES = {"rigid": 0.05, "mpm": 0.1, "ngff": 0.1}
SLIDES = TOLERANCES | {"ngff": 0.15}
GAPS = {"rigid": (-0.03, 0.05), "mpm": (-0.1, 0.1), "ngff": (-0.03, 0.05)}  # penetration, gap in heights


@dataclass(frozen=True)
class Specimen:
    """A body and its material."""

    surface: Surface
    E: float = 1e7  # [Pa]
    density: float = 540.0  # [kg/m^3]
    loss: float = 0.15

    def material(self) -> dict:
        """The material in the form that `ngff simulate --materials` reads."""
        return {"E": self.E, "density": self.density, "loss": self.loss, "friction": 0.5}


@dataclass(frozen=True)
class Run:
    """A scene in metres with its floor at z = 0, and options of `ngff simulate` that are not the default."""

    bodies: tuple[Specimen, ...]
    options: Mapping = field(default_factory=dict)

    def scene(self) -> Scene:
        """The scene with the bodies as objects 1, 2, ..., of grey Gaussians."""
        parts = [to_gaussians(t.surface, torch.full((len(t.surface.points), 3), 0.5), i + 1, widest=math.inf)
                 for i, t in enumerate(self.bodies)]  # fmt: skip
        objects = tuple(SceneObject(i + 1, f"body{i + 1}") for i in range(len(parts)))
        return Scene(concatenate(parts), objects, None, 0.0, {"metres_per_unit": 1.0, "source": "made in code"})


@dataclass(frozen=True)
class Experiment:
    """Runs, what is measured in their trajectories, and the value that theory gives."""

    name: str  # group/case
    runs: tuple[Run, ...]
    measure: Callable[..., float]  # of the trajectories of the runs
    value: float
    what: str  # name and unit of what is measured
    scale: float  # error that counts as 1
    tolerance: Mapping  # by engine: largest error, or lowest and highest

    def passes(self, engine: str, measured: float) -> bool:
        """Whether a value agrees with theory within the tolerance of the engine."""
        allowed = self.tolerance[engine]
        low, high = allowed if isinstance(allowed, tuple) else (-allowed, allowed)
        return low <= (measured - self.value) / self.scale <= high


@cache
def experiments() -> Mapping[str, Experiment]:
    """All experiments by name."""
    groups = (_slides, _compound_slides, _slopes, _rolls, _rocking, _creep, _falls, _torques, _towers, _invariance,
              _collisions, _rebounds, _bounces, _stacks, _piles, _boxes)  # fmt: skip
    return MappingProxyType({e.name: e for group in groups for e in group()})


def cube(side: float, x: float = 0.0, bottom: float = 0.0, **material) -> Specimen:
    """A cube of this side [m] over (x, 0), its lower face at the height `bottom` [m]."""
    return block((side,) * 3, (x, 0.0, bottom + side / 2), **material)


def block(sides: tuple[float, float, float], centre: tuple[float, float, float], **material) -> Specimen:
    """An upright box; its Gaussians are a twenty-eighth of its longest side apart, or less."""
    spacing = max(sides) / POINTS_ALONG if min(sides) > max(sides) / 4 else min(sides) / 7
    return Specimen(box(sides, spacing).moved(centre), **material)


def ball(radius: float, centre: tuple[float, float, float], **material) -> Specimen:
    """A ball of this radius and centre [m]."""
    return Specimen(ellipsoid((radius,) * 3, 1500).moved(centre), **material)


def tilted(surface: Surface, degrees: float) -> Surface:
    """Turned about the y axis through the origin, so that +x points downhill."""
    a = math.radians(degrees)
    R = torch.tensor([[math.cos(a), 0.0, math.sin(a)], [0.0, 1.0, 0.0], [-math.sin(a), 0.0, math.cos(a)]])
    return Surface(surface.points @ R.mT, surface.normals @ R.mT)


def on_slope(degrees: float, loss: float, options: Mapping, body: Surface | None = None) -> Run:
    """A body at rest at the origin, else a box of .2 x .2 x .1 m, on a pinned slope of 2 m."""
    ramp = tilted(box((2.0, 0.6, 0.2), 0.025).moved((0, 0, -0.1)), degrees).moved((0, 0, 1.2))
    body = box((0.2, 0.2, 0.1), 0.008).moved((0, 0, 0.05)) if body is None else body
    body = tilted(body.moved((-0.5, 0, 0)), degrees).moved((0, 0, 1.2))
    return Run((Specimen(ramp, loss=loss), Specimen(body, loss=loss)), {"pin": ("1",), **options})


def bowl(inner: float, outer: float) -> Surface:
    """Half a spherical shell, open above, its lowest point at z = 0."""
    centre = torch.tensor([0.0, 0.0, outer])
    shells = [ellipsoid((r,) * 3, n) for r, n in ((outer, 4000), (inner, 3000))]
    halves = [(s.points[s.points[:, 2] < 0], sign * s.normals[s.points[:, 2] < 0])
              for s, sign in zip(shells, (1, -1), strict=True)]  # fmt: skip
    angle, radius = torch.arange(0, 2 * math.pi, 0.06), torch.linspace(inner, outer, 4)
    a, r = torch.meshgrid(angle, radius, indexing="ij")
    rim = torch.stack([r * a.cos(), r * a.sin(), torch.zeros_like(a)], -1).reshape(-1, 3)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(rim), 3)
    points, normals = (torch.cat(parts) for parts in zip(*halves, (rim, up), strict=True))
    return Surface(points + centre, normals)


def path(t: Trajectory, row: int) -> Float[Tensor, "t 3"]:
    """Centre of mass of an object relative to its start [m]."""
    return t.com[:, row] - t.com[0, row]


def gap(t: Trajectory, above: int = 2, below: int = 1) -> float:
    """Height of the lower face of a box above the upper face of another at the end, in heights of the former."""
    upper, lower = (t.keypoints.object_id == i for i in (above, below))
    rest, end = t.keypoints.rest, t.positions[-1]
    high, low = float(rest[upper, 2].max()), float(rest[upper, 2].min())
    margin = 0.02 * (high - low)
    face = upper & (rest[:, 2] < low + margin)
    reach = (rest[face, :2].amax(0) - rest[face, :2].amin(0)).max() / 2
    over = (rest[:, :2] - rest[face, :2].mean(0)).norm(dim=1) < 1.5 * reach
    top = lower & (rest[:, 2] > float(rest[lower, 2].max()) - margin)
    top = top & over if bool((top & over).any()) else top
    return float(end[face, 2].mean() - end[top, 2].mean()) / (high - low)


def spin(t: Trajectory, row: int = 0) -> float:
    """Angular speed about z at the end [rad/s]."""
    turned = 2 * torch.atan2(t.rotation[-2:, row, 3], t.rotation[-2:, row, 0])
    return float((turned[1] - turned[0] + math.pi) % (2 * math.pi) - math.pi) / t.info.dt


def rebound(t: Trajectory, drop: float) -> float:
    """Coefficient of restitution from the height after the first bounce."""
    z = path(t, 0)[:, 2] + drop
    hit = int((z < 0.1 * drop).nonzero()[0]) if bool((z < 0.1 * drop).any()) else len(z) - 1
    return math.sqrt(max(float(z[hit:].max()), 0.0) / drop)


def largest_shift(t: Trajectory) -> float:
    """Distance that an object has moved at the end, the largest of all [m]."""
    return float((t.com[-1] - t.com[0]).norm(dim=1).max())


def largest_difference(one: Trajectory, other: Trajectory, scale: float, size: float) -> float:
    """Largest distance of centres of mass at any time in two scenes, the other `scale` times as large, in `size`."""
    return float((other.com / scale - one.com).norm(dim=-1).max()) / size


def overlap(t: Trajectory, radius: float) -> float:
    """Largest overlap of balls with each other and with the floor at the end, in diameters."""
    closest = torch.pdist(t.com[-1]).min() / (2 * radius)
    lowest = (t.com[-1, :, 2].min() + radius) / (2 * radius)
    return max(1 - float(torch.minimum(closest, lowest)), 0.0)


def _slides() -> Iterator[Experiment]:
    for mu in (0.0, 0.1, 0.3, 0.6, 1.0):
        run = Run((block((0.3, 0.2, 0.08), (0, 0, 0.04)),), {"velocity": ("object=1 2,0,0",), "friction": mu})
        time = 99 * 0.02
        stop = 4 / (2 * mu * G) if mu else math.inf
        value = min(stop, 2 * time - mu * G * time**2 / 2) if mu * G * time < 2 else stop
        yield Experiment(f"slide/friction={mu:g}", (run,), lambda t: float(path(t, 0)[-1, 0]), value,
                         "distance from 2 m/s in 2 s [m]", value, SLIDES)  # fmt: skip

    body = replace(block((0.3, 0.3, 0.15), (0, 0, 0.075)), loss=0.01)
    run = Run((body,), {"velocity": ("object=1 .3,0,0",), "friction": 0.1})  # the speed of a fall of 5 mm
    value = 0.09 / (2 * 0.1 * G)
    yield Experiment("slide/slow friction=0.1", (run,), lambda t: float(path(t, 0)[-1, 0]), value,
                     "distance from .3 m/s [m]", value, SLIDES)  # fmt: skip

    for mu in (0.1, 0.3, 0.6):  # a body that its weight compresses by 2.1 %
        run = Run((block((0.3, 0.2, 0.08), (0, 0, 0.04), E=1e5, density=2700.0),),
                  {"velocity": ("object=1 1,0,0",), "friction": mu, "steps": 76})  # fmt: skip
        value = 1 / (2 * mu * G)
        yield Experiment(f"slide/soft friction={mu:g}", (run,), lambda t: float(path(t, 0)[-1, 0]), value,
                         "distance from 1 m/s [m]", value, SLIDES)  # fmt: skip


def _compound_slides() -> Iterator[Experiment]:
    """Bodies of several boxes that start at 1 m/s along x on others of several boxes, which do not move."""
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


def compound(spacing: float, *boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Surface:
    """The union of upright boxes of these sides and centres [m]."""

    def part(sides: tuple[float, float, float], centre: tuple[float, float, float]):
        half = torch.tensor(sides) / 2 - 1e-4
        return box(sides, spacing).moved(centre), lambda p: ((p - torch.tensor(centre)).abs() < half).all(1)

    return union(*(part(*each) for each in boxes))


def about_z(surface: Surface, degrees: float) -> Surface:
    """Turned about the z axis."""
    a = math.radians(degrees)
    R = torch.tensor([[math.cos(a), -math.sin(a), 0.0], [math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]])
    return Surface(surface.points @ R.mT, surface.normals @ R.mT)


def _slopes() -> Iterator[Experiment]:
    for degrees, mu in product((10, 25, 40), (0.0, 0.3, 0.8)):
        a, time = math.radians(degrees), 30 * 0.02
        pull = G * max(math.sin(a) - mu * math.cos(a), 0.0)
        run = on_slope(degrees, 0.15, {"friction": mu, "steps": 31})
        yield Experiment(f"slope/{degrees}deg friction={mu:g}", (run,), lambda t: float(path(t, 1)[-1].norm()),
                         pull * time**2 / 2, "distance in .6 s [m]", G * math.sin(a) * time**2 / 2, SLIDES)  # fmt: skip


def _rolls() -> Iterator[Experiment]:
    """A solid ball on a slope that grips: a = 5/7 g sin(slope), as its inertia is 2/5 m r^2."""
    radius, time = 0.1, 30 * 0.02
    for degrees in (10, 25):
        distance = 5 / 7 * G * math.sin(math.radians(degrees)) * time**2 / 2
        run = on_slope(
            degrees, 0.15, {"friction": 0.8, "steps": 31}, ellipsoid((radius,) * 3, 1500).moved((0, 0, radius))
        )
        yield Experiment(f"roll/{degrees}deg", (run,), lambda t: float(path(t, 1)[-1].norm()), distance,
                         "distance in .6 s [m]", distance, TOLERANCES)  # fmt: skip


def _rocking() -> Iterator[Experiment]:
    """A block let go while it leans on a lower edge: it turns about the edge as a pendulum upside down."""
    width, height, start, time = 0.2, 0.3, math.radians(12), 0.14
    # the corners of a sampled box are half a spacing inside it, here 3 % of the lever arm of its weight
    leaning = tilted(box((width, height, height), 0.004).moved((-width / 2, 0, height / 2)), math.degrees(start))
    left = leaning_angle(width, height, start, time)
    run = Run((Specimen(leaning),), {"friction": 1.0, "dt": 0.01, "steps": 15})

    def angle(t: Trajectory) -> float:
        return math.degrees(start + 2 * math.atan2(*t.rotation[-1, 0, [2, 0]].tolist()))

    yield Experiment("rocking/12deg", (run,), angle, math.degrees(left), "angle after .14 s [degrees]",
                     math.degrees(start - left), TOLERANCES)  # fmt: skip


def leaning_angle(width: float, height: float, start: float, time: float) -> float:
    """Angle [rad] of a rigid block that leans on an edge, `time` [s] after it was let go at the angle `start`.

    Housner 1963, "The behavior of inverted pendulum structures during earthquakes", equation 2:
    4/3 m R^2 angle'' = -m g R sin(slenderness - angle), with the half diagonal R; integrated by small leapfrog steps.
    """
    slenderness, half_diagonal = math.atan2(width, height), math.hypot(width, height) / 2
    steps = 10_000
    dt, angle, rate = time / steps, start, 0.0
    for k in range(steps):
        rate -= dt * (0.5 if k == 0 else 1) * 0.75 * G / half_diagonal * math.sin(slenderness - angle)
        angle += dt * rate
    return angle


def _creep() -> Iterator[Experiment]:
    for loss in (0.02, 0.15):
        run = on_slope(15, loss, {"friction": 0.3, "steps": 501})  # tan 15 degrees is .268
        yield Experiment(f"creep/15deg friction=0.3 loss={loss:g}", (run,),
                         lambda t: 1e4 * float((t.com[-1, 1] - t.com[25, 1]).norm()) / 0.2, 0.0,
                         "distance from .5 to 10 s [1e-4 sides]", 1.0, dict.fromkeys(TOLERANCES, 1.0))  # fmt: skip


def _falls() -> Iterator[Experiment]:
    for g in (1.62, 9.81, 25.0):
        frames = round(math.sqrt(2 * 0.2 / g) / 0.02)
        run = Run((cube(0.2, bottom=0.4),), {"gravity": g, "steps": frames + 1})
        value = g * (0.02 * frames) ** 2 / 2
        yield Experiment(f"fall/gravity={g:g}", (run,), lambda t: float(-path(t, 0)[-1, 2]), value, "fall [m]", value,
                         TOLERANCES)  # fmt: skip


def _torques() -> Iterator[Experiment]:
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


def _towers() -> Iterator[Experiment]:
    for count, seconds in ((3, 2), (6, 2), (10, 2), (6, 20)):
        cubes = tuple(cube(0.2, bottom=0.2 * i) for i in range(count))
        run = Run(cubes, {"steps": 50 * seconds, "lift": (f"{count}=.005",)})
        yield Experiment(f"tower/{count} for {seconds}s", (run,), lambda t: largest_shift(t) / 0.2, 0.0,
                         "largest shift [sides]", 1.0, {"rigid": 0.05, "mpm": 0.1, "ngff": 0.1})  # fmt: skip


def _invariance() -> Iterator[Experiment]:
    def stack(s: float = 1.0, factor: float = 1.0) -> Run:
        more = {"density": 540.0 * factor, "E": 1e7 * factor * s}  # E / (density g size) stays the same
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


def _collisions() -> Iterator[Experiment]:
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
    still = Run((cube(0.3, bottom=0.5), cube(0.3, 0.5, 0.5)), {"gravity": 0.0})
    yield Experiment("free space/two at rest", (still,), lambda t: largest_shift(t) / 0.3, 0.0, "largest shift [sides]",
                     1.0, TOLERANCES)  # fmt: skip


def _rebounds() -> Iterator[Experiment]:
    for (name, body), loss in product((("ball", ball(0.15, (0, 0, 0.15))), ("box", cube(0.3))), (0.05, 0.15, 0.4)):
        run = Run((replace(body, loss=loss),), {"lift": ("0.5",), "dt": 0.01, "steps": 100})
        yield Experiment(f"rebound/{name} loss={loss:g}", (run,), lambda t: rebound(t, 0.5),
                         math.exp(-math.pi * loss / 2), "restitution", 1.0, TOLERANCES)  # fmt: skip

    soft = replace(ball(0.15, (0, 0, 0.15)), E=2e5, density=600.0)  # the impact compresses it by a sixth
    run = Run((soft,), {"lift": ("0.5",), "dt": 0.01, "steps": 100})
    yield Experiment("rebound/soft ball loss=0.15", (run,), lambda t: rebound(t, 0.5), math.exp(-math.pi * 0.15 / 2),
                     "restitution", 1.0, TOLERANCES)  # fmt: skip


def _bounces() -> Iterator[Experiment]:
    """A ball that falls .5 m while it flies sideways: friction takes mu (1 + e) of its normal speed, until it rolls."""
    for loss, mu in product((0.02, 0.15), (0.1, 0.5)):
        body = replace(ball(0.15, (0, 0, 0.15)), loss=loss)
        run = Run((body,), {"lift": ("0.5",), "velocity": ("object=1 3,0,0",), "friction": mu, "dt": 0.01, "steps": 61})
        lost = mu * (1 + math.exp(-math.pi * loss / 2)) * math.sqrt(2 * G * 0.5)
        yield Experiment(f"bounce/friction={mu:g} loss={loss:g}", (run,),
                         lambda t: float(path(t, 0)[-1, 0] - path(t, 0)[-11, 0]) / (10 * t.info.dt),
                         max(3 - lost, 15 / 7), "horizontal speed, 3 before [m/s]", 3.0, TOLERANCES)  # fmt: skip


def _stacks() -> Iterator[Experiment]:
    soft = (cube(0.3, E=1e5, density=100.0), cube(0.15, bottom=0.31, E=1e9, density=2700.0))
    small = (cube(0.5), cube(0.05, bottom=0.505))
    rod = (cube(0.2, -0.3), cube(0.2, 0.3), block((1.0, 0.1, 0.1), (0, 0, 0.26)))
    yield Experiment("stack/heavy on soft", (Run(soft),), gap, 0.0, "gap [heights]", 1.0, GAPS)
    yield Experiment("stack/size 1:10", (Run(small),), gap, 0.0, "gap [heights]", 1.0, GAPS)
    yield Experiment("stack/rod on two boxes", (Run(rod),), lambda t: gap(t, 3, 1), 0.0, "gap [heights]", 1.0, GAPS)


def _piles() -> Iterator[Experiment]:
    inside = Run((Specimen(bowl(0.25, 0.3), E=1e7), ball(0.08, (0.0, 0.0, 0.14), loss=0.4)), {"steps": 150})
    yield Experiment("pile/ball in a bowl", (inside,), lambda t: float(t.com[-1, 1, 2]) / 0.08, 0.13 / 0.08,
                     "height of its middle [radii]", 1.0, TOLERANCES)  # fmt: skip
    for count in (20, 40):
        random = torch.Generator().manual_seed(count)
        places = torch.cartesian_prod(torch.arange(2.0), torch.arange(2.0), torch.arange(count / 4))
        jitter = 0.02 * torch.rand(places.shape, generator=random)
        centres = (0.24 * places + jitter + torch.tensor([0.0, 0.0, 0.11])).tolist()
        heap = Run(tuple(ball(0.1, tuple(c), loss=0.4) for c in centres), {"steps": 150})
        yield Experiment(f"pile/heap of {count}", (heap,), lambda t: overlap(t, 0.1), 0.0,
                         "largest overlap [diameters]", 1.0, {"rigid": 0.03, "mpm": 0.03, "ngff": 0.03})  # fmt: skip


def _boxes() -> Iterator[Experiment]:
    for side, density, E in product((0.03, 0.06, 0.15, 0.3), (50.0, 540.0, 1000.0, 2700.0, 7850.0), (1e5, 1e7, 1e9)):
        pair = (cube(5 / 3 * side, E=E, density=density), cube(side, bottom=5 / 3 * side, E=E, density=density))
        dropped = Run(pair, {"steps": 50, "lift": (f"2={0.1 * side:g}",)})  # what is not lifted may sleep where it is
        yield Experiment(f"boxes/{side:g}m {density:g}kg/m3 {E:.0e}Pa", (dropped,), gap, 0.0, "gap after 1 s [heights]",
                         1.0, GAPS)  # fmt: skip
