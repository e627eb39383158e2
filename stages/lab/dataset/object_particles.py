"""The data set's ten objects as MPM particles, sampled from their Gaussians at grid resolution and cached in a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
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
from stages.core.physics.particles import MIN_PARTICLE_OPACITY
from stages.core.scene.files import replacing
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.npz import read_npz
from stages.lab.assets.objects import OBJECTS, ObjectKind, make_object
from stages.lab.assets.shapes import single_threaded
from stages.lab.dataset.options import Discretisation
from stages.lab.dataset.scene_configs import PlacementExtent

POISSON_RATIO = 0.3  # Poisson's ratio of all objects, as published
FRICTION = 1.0  # walls that keep 0.9 of the tangential speed per substep act like a Coulomb coefficient of 1 or more
PLACEMENT_POINTS = 2048  # number of particles of an object from which distances between objects are computed


@dataclass(frozen=True)
class Asset:
    """An object as particles at its scale prior, relative to the centre of its bounding box."""

    id: int
    scale: float
    points: Float[Tensor, "p 3"]  # [m], in farthest-point order
    volume: Float[Tensor, "p"]  # volume of each particle [m^3]
    E: float  # Young's modulus [Pa]
    density: float  # density [kg/m^3]
    solidity: float = 1.0  # stiffness relative to a hollow or thin body of the same material

    @cached_property
    def mass(self) -> float:
        """Total mass [kg]."""
        return self.density * float(self.volume.sum())

    def particles(self, device: str = "cpu") -> mpm.Particles:
        """The particles of the object at rest about the origin."""
        material = mpm.ParticleMaterial(self.E, POISSON_RATIO, self.density, 0.0, FRICTION)
        made = mpm.at_rest(self.points, self.volume, material, MODELS["corotated"].kernel)
        return mpm.Particles(*(getattr(made, f.name).to(device) for f in fields(made)))


def translated(particles: mpm.Particles, offset: tuple[float, float, float]) -> mpm.Particles:
    """The same particles, moved by `offset` [m]."""
    return replace(particles, x=particles.x + torch.tensor(offset, device=particles.x.device))


def load_assets(discretisation: Discretisation, min_particles: int, cache: Path | None = None) -> dict[int, Asset]:
    """The ten objects by id, each with `min_particles` particles or as many as the particle spacing requires.

    An object with fewer Gaussians than the spacing requires uses all of them. Sampling takes about a minute; `cache`
    is a file (.npz) from which the particles are read, or to which they are written. Raises InputError if an object
    has fewer than `min_particles` Gaussians or the cache cannot be read.
    """
    key = f"spacing {discretisation.spacing} least {min_particles}"

    def sample() -> dict[str, Tensor]:
        bar = tqdm(OBJECTS.values(), desc="objects", unit="object")
        return {kind.name: _sample_particles(kind, discretisation, min_particles) for kind in bar}

    points = cached_points(cache, key, OBJECTS, sample)
    return {
        kind.id: Asset(kind.id, kind.scale, points[kind.name], particle_volumes(points[kind.name], discretisation.dx),
                       kind.E, kind.density)
        for kind in OBJECTS.values()
    }  # fmt: skip


def cached_points(
    cache: Path | None, key: str, names: Iterable[str], sample: Callable[[], dict[str, Tensor]]
) -> dict[str, Float[Tensor, "p 3"]]:
    """Particle positions by object name, from the file `cache` if it was written with the same `key`.

    Otherwise they are sampled and written to the file. Raises InputError if the file cannot be read.
    """
    if cache is not None and cache.exists():
        arrays = read_npz(cache, "particles of objects, which are made again where there is no such file")
        if str(arrays.pop("key", "")) == key and {*names} <= set(arrays):
            if any(arrays[n].shape[1:] != (3,) or arrays[n].dtype.kind != "f" for n in names):
                raise InputError(
                    f"{cache}: the particles of an object do not have the shape (particles, 3); "
                    "remove the file to generate it again"
                )
            return {name: torch.from_numpy(arrays[name]) for name in names}
    points = sample()
    if cache is not None:
        with replacing(cache) as part:
            np.savez(part, key=key, **{name: p.numpy() for name, p in points.items()})
    return points


def at_scale_prior(g: Gaussians, scale: float) -> Gaussians:
    """An object's Gaussians scaled by its scale prior and centred on the bounding box of the opaque ones [m]."""
    means = g.means * scale
    opaque = means[g.opacities > MIN_PARTICLE_OPACITY]
    return replace(g, means=means - (opaque.amax(0) + opaque.amin(0)) / 2, scales=g.scales * scale)


def _sample_particles(kind: ObjectKind, discretisation: Discretisation, min_particles: int) -> Float[Tensor, "p 3"]:
    """Centres of a subset of the object's Gaussians, chosen by farthest-point sampling."""
    g = at_scale_prior(make_object(kind.name), kind.scale)
    means = g.means[g.opacities > MIN_PARTICLE_OPACITY]
    if len(means) < min_particles:
        raise InputError(f"--keypoints {min_particles}: {kind.name} has only {len(means)} Gaussians; give fewer")
    count = max(min_particles, count_for_spacing(means, discretisation.spacing))
    with single_threaded():  # ten times faster: threads would synchronise once per sampled point
        return means[farthest_points(means, count)]


def count_for_spacing(means: Float[Tensor, "n 3"], spacing: float) -> int:
    """Number of points that sample a surface with the given spacing [m], estimated from the spacing of `means`."""
    sample = means[:: max(1, len(means) // 4000)]
    own_spacing = float(knn(means, sample, 5)[0][:, 1:].mean())
    return int(len(means) * (own_spacing / spacing) ** 2)


def particle_volumes(means: Float[Tensor, "n 3"], dx: float) -> Float[Tensor, "n"]:
    """Volume of a grid cell divided by the number of particles in it [m^3], for each particle, as published."""
    cell = (means / dx).floor().long()
    _, owner, count = cell.unique(dim=0, return_inverse=True, return_counts=True)
    return dx**3 / count[owner].float()


def placement_extents(assets: Mapping[int, Asset]) -> dict[int, PlacementExtent]:
    """Points and scale of each object, for placing it in scenes."""
    return {i: PlacementExtent(a.points[:PLACEMENT_POINTS].numpy().astype(float), a.scale) for i, a in assets.items()}
