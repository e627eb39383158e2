"""MPM particles of objects other than the data set's ten: procedural shapes, meshes, and rotated copies of the ten."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.geometry.rotations import matrix
from stages.core.models.field.solidity import solidity
from stages.core.physics.keypoints import farthest_points
from stages.core.physics.materials import choose_materials
from stages.core.scene.scene import SceneObject
from stages.lab.assets.heldout_shapes import ShapeKind, surface_and_interior_points, surface_points
from stages.lab.assets.mesh_files import object_name
from stages.lab.assets.shapes import single_threaded
from stages.lab.dataset.object_particles import Asset, cached_points, count_for_spacing, particle_volumes
from stages.lab.dataset.options import Discretisation

log = logging.getLogger(__name__)
FIRST_MESH_ID, FIRST_ROTATED_ID, FIRST_RANDOM_MESH_ID = 100, 2000, 3000  # first object id of each kind
PARTICLES_PER_CELL_AXIS = 1.5  # particles of solid bodies per grid cell and axis
SURFACE_POINTS = 30_000  # surface points of a shape, from which particles are sampled
MESH_SIZE_RANGE = (0.25, 0.8)  # longest side of a random mesh [m]
MESH_DENSITY_RANGE = (100.0, 2700.0)  # density of a random mesh [kg/m^3]
MESH_STIFFNESS_RANGE = (100.0, 1e5)  # E / density of a random mesh [m^2/s^2], from a cushion to light wood
# Largest Young's modulus of a mesh [Pa], that of the stiffest of the ten objects (phone): such bodies hardly deform,
# and substeps are still affordable.
MAX_YOUNG = 2e7


def rotated_assets(
    assets: Mapping[int, Asset], count: int, discretisation: Discretisation, seed: int = 0
) -> dict[int, Asset]:
    """`count` copies of the objects, taken in turn and rotated randomly, with new ids."""
    made = {}
    for i in range(count):
        asset = list(assets.values())[i % len(assets)]
        points = _rotated(asset.points, np.random.default_rng([FIRST_ROTATED_ID, i, *([seed] if seed else [])]))
        id = FIRST_ROTATED_ID + i
        made[id] = replace(asset, id=id, points=points, volume=particle_volumes(points, discretisation.dx))
    return made


def _rotated(points: Float[Tensor, "p 3"], rng: np.random.Generator) -> Float[Tensor, "p 3"]:
    """The points rotated randomly and centred on their bounding box."""
    points = points @ matrix(torch.from_numpy(rng.normal(size=4)).float()).T
    return points - (points.amin(0) + points.amax(0)) / 2


def load_shape_assets(
    shapes: Mapping[str, ShapeKind], discretisation: Discretisation, min_particles: int, cache: Path | None = None,
    solid: bool = False,
) -> dict[int, Asset]:  # fmt: skip
    """Objects defined by signed distance fields, by id; `cache` is a file (.npz) for their particles, read or written.

    Each object has at least `min_particles` surface particles, with `solid` followed by interior particles.
    """
    key = f"spacing {discretisation.spacing} least {min_particles}" + f" dx {discretisation.dx}" * solid

    def sample() -> dict[str, Tensor]:
        bar = tqdm(shapes.items(), desc="objects", unit="object")
        return {name: _shape_particles(kind, discretisation, min_particles, solid) for name, kind in bar}

    points = cached_points(cache, key, shapes, sample)
    made = {kind.id: _asset(kind.id, kind.scale, points[name], (kind.E, kind.density), discretisation)
            for name, kind in shapes.items()}  # fmt: skip
    if not solid:
        return made
    return {i: replace(a, solidity=solidity(a.points[:min_particles], float(a.volume.sum()))) for i, a in made.items()}


def mesh_assets(
    meshes: Sequence[Sequence[Path]], size: float, discretisation: Discretisation, min_particles: int
) -> dict[int, Asset]:
    """Objects 100, 101, ... from meshes of one or several files each; materials are guessed from file and folder names.

    `size` is the longest side of each object [m].
    """
    from stages.lab.assets.meshes import read_mesh  # needs an optional extra

    assets = {}
    for id, files in enumerate(tqdm(meshes, desc="meshes", unit="mesh"), start=FIRST_MESH_ID):
        name = f"{files[0].resolve().parent.name} {object_name(files)}"
        choice = choose_materials([SceneObject(id, name)])[id]
        E = min(choice.material.E, MAX_YOUNG)
        log.info("%s: %s%s, E %.3g Pa", name, choice.name, " (a guess)" * choice.guessed, E)
        points = _sample_points(size * read_mesh(files, SURFACE_POINTS).means, discretisation, min_particles)
        assets[id] = _asset(id, size, points, (E, choice.material.density), discretisation)
    return assets


def random_mesh_assets(
    meshes: Sequence[Sequence[Path]],
    count: int,
    discretisation: Discretisation,
    min_particles: int,
    seed: int = 0,
    cache: Path | None = None,
) -> dict[int, Asset]:
    """`count` objects of random size and material from randomly chosen meshes; every second one is rotated randomly.

    `cache` is a file (.npz) for their particles, read or written.
    """
    from stages.lab.assets.meshes import read_mesh  # needs an optional extra

    rngs = [np.random.default_rng([FIRST_RANDOM_MESH_ID, seed, i]) for i in range(count)]
    ranges = (MESH_SIZE_RANGE, MESH_DENSITY_RANGE, MESH_STIFFNESS_RANGE)
    size, density, stiffness = zip(*[[math.exp(rng.uniform(*np.log(r))) for r in ranges] for rng in rngs], strict=True)
    order = np.random.default_rng([FIRST_RANDOM_MESH_ID, seed]).permutation(len(meshes))

    def sample() -> dict[str, Tensor]:
        made = {}
        for i, rng in enumerate(tqdm(rngs, desc="meshes", unit="mesh")):
            points = size[i] * read_mesh(meshes[order[i % len(meshes)]], SURFACE_POINTS).means
            points = _rotated(points, rng) if i % 2 else points
            made[str(i)] = _sample_points(points, discretisation, min_particles)
        return made

    names = ", ".join(path.name for files in meshes for path in files)
    key = f"spacing {discretisation.spacing} least {min_particles} seed {seed} of {names}"
    points = cached_points(cache, key, [str(i) for i in range(count)], sample)
    return {
        id: _asset(id, size[i], points[str(i)].float(), (min(density[i] * stiffness[i], MAX_YOUNG), density[i]),
                   discretisation)
        for i, id in enumerate(range(FIRST_RANDOM_MESH_ID, FIRST_RANDOM_MESH_ID + count))
    }  # fmt: skip


def _shape_particles(
    kind: ShapeKind, discretisation: Discretisation, min_particles: int, solid: bool
) -> Float[Tensor, "p 3"]:
    """Particles of the surface, with `solid` followed by particles of the interior."""
    if not solid:
        return _sample_points(kind.scale * surface_points(kind, SURFACE_POINTS), discretisation, min_particles)
    spacing = discretisation.dx / PARTICLES_PER_CELL_AXIS / kind.scale
    surface, interior = surface_and_interior_points(kind, SURFACE_POINTS, spacing)
    return torch.cat([_sample_points(kind.scale * surface, discretisation, min_particles), kind.scale * interior])


def _sample_points(
    points: Float[Tensor, "n 3"], discretisation: Discretisation, min_particles: int
) -> Float[Tensor, "p 3"]:
    """A subset of the points, chosen by farthest-point sampling."""
    if len(points) < min_particles:
        raise InputError(f"--keypoints {min_particles}: an object has only {len(points)} surface points; give fewer")
    count = min(len(points), max(min_particles, count_for_spacing(points, discretisation.spacing)))
    with single_threaded():
        return points[farthest_points(points, count)]


def _asset(
    id: int, scale: float, points: Tensor, material: tuple[float, float], discretisation: Discretisation
) -> Asset:
    """An object made of particles; `material` is Young's modulus [Pa] and density [kg/m^3]."""
    return Asset(id, scale, points, particle_volumes(points, discretisation.dx), *material)
