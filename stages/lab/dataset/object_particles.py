"""The ten objects as particles, fine enough for a grid, chosen once and kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.geometry.neighbours import knn
from stages.core.physics.keypoints import farthest_points
from stages.core.physics.materials import MODELS
from stages.core.physics.mpm import solver as mpm
from stages.core.scene.files import replacing
from stages.core.scene.gaussians import Gaussians
from stages.lab.assets.objects import OBJECTS, ObjectKind, make_object
from stages.lab.assets.shapes import single_threaded
from stages.lab.dataset.scene_configs import PlacementExtent

FRAME_INTERVAL, SUBSTEP = 0.02, 1e-4  # as published [s]
POISSON_RATIO, FRICTION = 0.3, 1.0  # walls that keep 0.9 a substep hold like a friction of 1 or more
MIN_OPACITY = 0.02


@dataclass(frozen=True)
class Discretisation:
    """How finely the world is cut."""

    dx: float = 0.02  # grid spacing [m]
    spacing: float = 0.009  # between particles on a surface [m]
    substep: float = SUBSTEP  # [s]

    @property
    def substeps(self) -> int:
        return round(FRAME_INTERVAL / self.substep)


@dataclass(frozen=True)
class Asset:
    """An object as particles, at its scale prior, about the centre of its bounding box."""

    id: int
    scale: float
    points: Float[Tensor, "p 3"]  # [m], each the farthest from those before it
    volume: Float[Tensor, "p"]  # [m^3]
    E: float  # [Pa]
    density: float  # [kg/m^3]
    solidity: float = 1.0  # how many times stiffer than what is hollow or thin

    @cached_property
    def mass(self) -> float:
        return self.density * float(self.volume.sum())

    def particles(self, device: str = "cpu") -> mpm.Particles:
        """The object at rest, about the origin."""
        n = torch.ones(len(self.points))
        made = mpm.at_rest(self.points, self.volume, self.density * n, self.E * n, POISSON_RATIO * n, 0 * n,
                           FRICTION * n, MODELS["corotated"].kernel)  # fmt: skip
        return mpm.Particles(*(getattr(made, f.name).to(device) for f in fields(made)))


def translated(particles: mpm.Particles, at: tuple[float, float, float]) -> mpm.Particles:
    """The same particles elsewhere."""
    return replace(particles, x=particles.x + torch.tensor(at, device=particles.x.device))


def load_assets(fineness: Discretisation, least: int, kept: Path | None = None) -> dict[int, Asset]:
    """All objects by id, each with `least` particles or as many as the spacing asks for (or all its Gaussians).

    Making and choosing them takes about a minute; `kept` is a file (.npz) to read them from, or to write them to.
    """
    key = f"spacing {fineness.spacing} least {least}"
    points = _read_points(kept, key) if kept is not None and kept.exists() else None
    if points is None:
        bar = tqdm(OBJECTS.values(), desc="objects", unit="object")
        points = {kind.name: _particles(kind, fineness, least) for kind in bar}
        if kept is not None:
            with replacing(kept) as part:
                np.savez(part, key=key, **{name: p.numpy() for name, p in points.items()})
    return {
        kind.id: Asset(kind.id, kind.scale, points[kind.name], particle_volumes(points[kind.name], fineness.dx), kind.E,
                       kind.density)
        for kind in OBJECTS.values()
    }  # fmt: skip


def _read_points(kept: Path, key: str) -> dict[str, Float[Tensor, "p 3"]] | None:
    """What was kept, if it was chosen in the same way."""
    try:
        with np.load(kept) as file:
            same = str(file["key"]) == key
            return {name: torch.from_numpy(file[name]) for name in OBJECTS} if same else None
    except (KeyError, OSError, ValueError) as error:
        raise InputError(f"{kept}: cannot be read ({error}); remove it and it is made again") from error


def at_scale_prior(g: Gaussians, scale: float) -> Gaussians:
    """An object's Gaussians at its scale prior [m], about the centre of the box around those that are particles."""
    means = g.means * scale
    solid = means[g.opacities > MIN_OPACITY]
    return replace(g, means=means - (solid.amax(0) + solid.amin(0)) / 2, scales=g.scales * scale)


def _particles(kind: ObjectKind, fineness: Discretisation, least: int) -> Float[Tensor, "p 3"]:
    """Some of its Gaussians, each the farthest from those before it."""
    g = at_scale_prior(make_object(kind.name), kind.scale)
    means = g.means[g.opacities > MIN_OPACITY]
    if len(means) < least:
        raise InputError(f"--keypoints {least}: {kind.name} has only {len(means)} Gaussians")
    with single_threaded():  # ten times faster than threads that wait for each other thousands of times
        return means[farthest_points(means, max(least, count_for_spacing(means, fineness.spacing)))]


def count_for_spacing(means: Float[Tensor, "n 3"], spacing: float) -> int:
    """How many points of such a spacing cover the surface: from the spacing that all of them have."""
    sample = means[:: max(1, len(means) // 4000)]
    own = float(knn(means, sample, 5)[0][:, 1:].mean())
    return int(len(means) * (own / spacing) ** 2)


def particle_volumes(means: Float[Tensor, "n 3"], dx: float) -> Float[Tensor, "n"]:
    """The volume of a cell, shared by the particles in it (as published)."""
    cell = (means / dx).floor().long()
    _, owner, count = cell.unique(dim=0, return_inverse=True, return_counts=True)
    return dx**3 / count[owner].float()


def placement_extents(things: Mapping[int, Asset]) -> dict[int, PlacementExtent]:
    """What placing them needs."""
    return {i: PlacementExtent(a.points[:2048].numpy().astype(float), a.scale) for i, a in things.items()}
