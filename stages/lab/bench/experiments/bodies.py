"""Bodies and scenes of the experiments: closed surfaces of Gaussians, as from a perfect reconstruction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.spatial import ConvexHull

from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.shapes import Surface, box, ellipsoid, to_gaussians, union

POINTS_ALONG = 28  # Gaussians along the side of a cube


@dataclass(frozen=True)
class Specimen:
    """A body and its material."""

    surface: Surface
    E: float = 1e7  # Young's modulus [Pa]
    density: float = 540.0  # density [kg/m^3]
    loss: float = 0.15  # loss factor

    def material(self) -> dict:
        """The material in the form that `ngff simulate --materials` reads."""
        return {"E": self.E, "density": self.density, "loss": self.loss, "friction": 0.5}


@dataclass(frozen=True)
class Run:
    """A scene in metres with its floor at z = 0, and non-default options of `ngff simulate`."""

    bodies: tuple[Specimen, ...]
    options: Mapping = field(default_factory=dict)

    def scene(self) -> Scene:
        """The scene with the bodies as objects 1, 2, ..., made of grey Gaussians."""
        parts = [to_gaussians(t.surface, torch.full((len(t.surface.points), 3), 0.5), i + 1, widest=math.inf)
                 for i, t in enumerate(self.bodies)]  # fmt: skip
        objects = tuple(SceneObject(i + 1, f"body{i + 1}") for i in range(len(parts)))
        return Scene(concatenate(parts), objects, None, 0.0, {"metres_per_unit": 1.0, "source": "made in code"})


def cube(side: float, x: float = 0.0, bottom: float = 0.0, **material) -> Specimen:
    """A cube with this side [m], centred above (x, 0), with its lower face at the height `bottom` [m]."""
    return block((side,) * 3, (x, 0.0, bottom + side / 2), **material)


def block(sides: tuple[float, float, float], centre: tuple[float, float, float], **material) -> Specimen:
    """An upright box with Gaussians at most 1 / POINTS_ALONG of its longest side apart."""
    spacing = max(sides) / POINTS_ALONG if min(sides) > max(sides) / 4 else min(sides) / 7
    return Specimen(box(sides, spacing).moved(centre), **material)


def ball(radius: float, centre: tuple[float, float, float], **material) -> Specimen:
    """A ball with this radius and centre [m]."""
    return Specimen(ellipsoid((radius,) * 3, 1500).moved(centre), **material)


def bowl(inner: float, outer: float) -> Surface:
    """Half a spherical shell, open at the top, with its lowest point at z = 0."""
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


def cylinder(radius: float, length: float, spacing: float) -> Surface:
    """A solid cylinder about the y axis, centred on the origin."""
    around = torch.arange(0, 2 * math.pi, spacing / radius)
    a, y = torch.cartesian_prod(around, torch.linspace(-length / 2, length / 2, round(length / spacing) + 1)).T
    out = torch.stack([a.cos(), torch.zeros_like(a), a.sin()], 1)
    points, normals = [radius * out + y[:, None] * torch.tensor([0.0, 1.0, 0.0])], [out]
    for r in torch.arange(spacing / 2, radius, spacing).tolist():
        a = torch.arange(0, 2 * math.pi, spacing / r)
        for side in (-1.0, 1.0):
            end = torch.full_like(a, side)
            points.append(torch.stack([r * a.cos(), length / 2 * end, r * a.sin()], 1))
            normals.append(torch.stack([torch.zeros_like(a), end, torch.zeros_like(a)], 1))
    return Surface(torch.cat(points), torch.cat(normals))


def wedge(length: float, width: float, degrees: float, spacing: float) -> Surface:
    """A right-angled wedge on z = 0, centred on the z axis; its upper face descends towards +x at this angle."""
    height = length * math.tan(math.radians(degrees))
    block = box((length, width, height), spacing).moved((0, 0, height / 2))
    below = block.points[:, 2] < height * (0.5 - block.points[:, 0] / length)
    block = block.kept(below & (block.normals[:, 0] < 0.5) & (block.normals[:, 2] < 0.5))
    slope = tilted(box((math.hypot(length, height), width, height), spacing).moved((0, 0, -height / 2)), degrees)
    slope = slope.kept(slope.normals[:, 2] > math.cos(math.radians(degrees)) - 1e-3).moved((0, 0, height / 2))
    return Surface(torch.cat([block.points, slope.points]), torch.cat([block.normals, slope.normals]))


def compound(spacing: float, *boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Surface:
    """The union of upright boxes with these sides and centres [m]."""

    def part(sides: tuple[float, float, float], centre: tuple[float, float, float]):
        half = torch.tensor(sides) / 2 - 1e-4
        return box(sides, spacing).moved(centre), lambda p: ((p - torch.tensor(centre)).abs() < half).all(1)

    return union(*(part(*each) for each in boxes))


def polyhedron(corners: np.ndarray, count: int, seed: int = 0) -> Surface:
    """Random points on the convex hull of corners (v, 3) [m], as many on each area."""
    hull, rng = ConvexHull(corners), np.random.default_rng(seed)
    t = corners[hull.simplices]
    area = np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    points = (rng.dirichlet((1, 1, 1), count)[..., None] * t[face]).sum(1)
    return Surface(torch.from_numpy(points).float(), torch.from_numpy(hull.equations[face, :3]).float())


def about_z(surface: Surface, degrees: float) -> Surface:
    """The surface rotated about the z axis."""
    a = math.radians(degrees)
    R = torch.tensor([[math.cos(a), -math.sin(a), 0.0], [math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]])
    return Surface(surface.points @ R.mT, surface.normals @ R.mT)


def tilted(surface: Surface, degrees: float) -> Surface:
    """The surface rotated about the y axis through the origin, so that +x points downhill."""
    a = math.radians(degrees)
    R = torch.tensor([[math.cos(a), 0.0, math.sin(a)], [0.0, 1.0, 0.0], [-math.sin(a), 0.0, math.cos(a)]])
    return Surface(surface.points @ R.mT, surface.normals @ R.mT)


def on_slope(degrees: float, loss: float, options: Mapping, body: Surface | None = None) -> Run:
    """A body (default: a box of 0.2 x 0.2 x 0.1 m) at rest on a pinned slope of 2 m; it is given at the origin."""
    ramp = tilted(box((2.0, 0.6, 0.2), 0.025).moved((0, 0, -0.1)), degrees).moved((0, 0, 1.2))
    body = box((0.2, 0.2, 0.1), 0.008).moved((0, 0, 0.05)) if body is None else body
    body = tilted(body.moved((-0.5, 0, 0)), degrees).moved((0, 0, 1.2))
    return Run((Specimen(ramp, loss=loss), Specimen(body, loss=loss)), {"pin": ("1",), **options})
