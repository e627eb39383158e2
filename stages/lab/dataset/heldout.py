"""Scenes of objects other than the ten: eight that are never trained on, any meshes, or more objects for training.

    OUT/scene_configs/heldout.json     start position of every object, sampled as for the data set
    OUT/motions/heldout.h5             keypoint trajectories, as `ngff-lab dataset` writes
    OUT/particles_heldout.npz          the objects as particles, cached for the next run

The groups for training are `varied`: random hollow shapes (the ten are hollow too); `solid`: filled random shapes,
like the bodies simulated from photos; and `turned`: the ten, each randomly rotated, which they never are in the data
set.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.rotations import matrix
from stages.core.models.field.solidity import solidity
from stages.core.physics.keypoints import farthest_points
from stages.core.physics.materials import choose_materials
from stages.core.scene.files import provenance
from stages.core.scene.scene import SceneObject
from stages.lab.assets.heldout_shapes import HELDOUT_SHAPES, ShapeKind, surface_and_interior_points, surface_points
from stages.lab.assets.mesh_files import find_objects, object_name
from stages.lab.assets.random_shapes import random_shapes
from stages.lab.assets.shapes import single_threaded
from stages.lab.dataset import object_particles
from stages.lab.dataset.keypoint_motions import KeypointMotionsWriter
from stages.lab.dataset.object_particles import (
    SUBSTEP,
    Asset,
    Discretisation,
    count_for_spacing,
    particle_volumes,
    placement_extents,
)
from stages.lab.dataset.scene_configs import (
    HELDOUT,
    ROTATED,
    SOLID,
    VARIED,
    SceneConfig,
    sample_scene,
    write_scene_configs,
)
from stages.lab.dataset.simulation import SimulationSettings, simulate, stable_substep

log = logging.getLogger(__name__)
FIRST_SCENE = {HELDOUT: 10_000, VARIED: 20_000, SOLID: 30_000, ROTATED: 40_000}  # index, and seed, of the first scene
SHAPE_SEEDS = {VARIED: 0, SOLID: 1}  # of random shapes
FIRST_MESH_ID, FIRST_ROTATED_ID = 100, 2000  # object ids
PARTICLES_PER_CELL_AXIS = 1.5  # of solid bodies
SURFACE_POINTS = 30_000  # of a shape, from which particles are sampled
MAX_YOUNG = 2e7  # of a mesh, as of the stiffest of the ten (phone): hardly deforms, and substeps stay affordable [Pa]


@dataclass(frozen=True)
class HeldoutOptions:
    """Which objects and scenes to make, and the settings of their simulation."""

    scenes: int = 100
    objects: int = 3  # per scene
    frames: int = 100
    keypoints: int = 2048  # per object
    dx: float = 0.02  # grid spacing [m]
    spacing: float = 0.009  # between particles on a surface [m]
    substep: float = SUBSTEP  # the longest; shorter for objects that are too stiff for it [s]
    size: float = 0.5  # longest side of a mesh [m]
    shapes: int = 0  # random shapes and materials, instead of the eight
    solid: bool = False  # fill the random shapes
    rotations: int = 0  # random rotations of the ten objects, instead of the eight
    device: str = "auto"

    def __post_init__(self):
        if self.scenes < 1 or not 1 <= self.objects <= 6:
            raise InputError(f"--scenes {self.scenes} --objects {self.objects}: at least one scene, of 1 to 6 objects")
        if not 0 <= self.shapes <= 1000:
            raise InputError(f"--shapes {self.shapes}: 0 for the eight, or up to 1000 random ones")
        if not 0 <= self.rotations <= 1000:
            raise InputError(f"--rotations {self.rotations}: 0 for the eight, or up to 1000 rotated objects")
        if self.solid and not self.shapes or self.shapes and self.rotations:
            raise InputError("--solid needs --shapes, and --rotations cannot be combined with them")
        if not 0.1 <= self.size <= 1.0:
            raise InputError(f"--size {self.size}: from 0.1 to 1 m; objects are placed in a cube of 1.8 m")

    @property
    def group(self) -> str:
        """Name of the group of scenes."""
        return SOLID if self.solid else VARIED if self.shapes else ROTATED if self.rotations else HELDOUT

    @property
    def discretisation(self) -> Discretisation:
        """Grid spacing, particle spacing and longest substep of the simulation."""
        return Discretisation(self.dx, self.spacing, self.substep)


def run(out: Path, options: HeldoutOptions = HeldoutOptions(), meshes: list[Path] | None = None) -> str:
    """Write one group of scenes and return a one-line summary; an existing group is kept.

    `meshes` are files and folders. Raises InputError when they are combined with --shapes or --rotations, or a mesh
    cannot be read.
    """
    group = options.group
    file, motions = Path(out) / "scene_configs" / f"{group}.json", Path(out) / "motions" / f"{group}.h5"
    if meshes and (options.shapes or options.rotations):
        raise InputError("--from cannot be combined with --shapes or --rotations")
    if motions.exists():
        return f"{motions}: exists already"
    for folder in (file.parent, motions.parent):
        folder.mkdir(parents=True, exist_ok=True)
    device, start = pick_device(options.device), time.perf_counter()
    objects = find_objects(meshes or [])
    assets = _assets(options, objects, Path(out) / f"particles_{group}.npz")
    materials = [(asset.E, asset.density) for asset in assets.values()]
    options = replace(options, substep=stable_substep(options.discretisation, materials))
    configs = sample_configs(assets, options.scenes, options.objects, FIRST_SCENE[group])
    write_scene_configs(file, configs)
    made_by, count = provenance("heldout", [file, *(path for files in objects for path in files)], options), 0
    settings = SimulationSettings(options.discretisation, options.frames, options.keypoints, device)
    bar = tqdm(total=len(configs), desc=group, unit="scene")
    with bar, KeypointMotionsWriter(motions, made_by) as writer:
        for batch in simulate(configs, assets, settings):
            writer.append(batch)
            count += len(batch)
            bar.update(len(batch))
    lost = f", {len(configs) - count} failed" if count < len(configs) else ""
    return f"{motions}: {count} scenes of {len(assets)} objects in {time.perf_counter() - start:.0f} s{lost}"


def _assets(options: HeldoutOptions, meshes: Sequence[Sequence[Path]], cache: Path) -> dict[int, Asset]:
    """The objects that the options choose."""
    if meshes:
        return mesh_assets(meshes, options)
    if options.rotations:
        ten = object_particles.load_assets(options.discretisation, options.keypoints, cache)
        return rotated_assets(ten, options.rotations, options.discretisation)
    shapes = random_shapes(options.shapes, SHAPE_SEEDS[options.group]) if options.shapes else HELDOUT_SHAPES
    return load_shape_assets(shapes, options.discretisation, options.keypoints, cache, options.solid)


def sample_configs(
    assets: Mapping[int, Asset], scenes: int, objects: int, first: int = FIRST_SCENE[HELDOUT]
) -> dict[str, SceneConfig]:
    """Scene configurations sampled as for the data set, with the seeds from `first` on."""
    extents = placement_extents(assets)
    configs = (sample_scene(first + i, objects, extents) for i in tqdm(range(scenes), desc="placing", unit="scene"))
    return {c.name: c for c in configs}


def rotated_assets(assets: Mapping[int, Asset], count: int, discretisation: Discretisation) -> dict[int, Asset]:
    """`count` randomly rotated copies of the objects in turn, with new ids."""
    made = {}
    for i in range(count):
        asset = list(assets.values())[i % len(assets)]
        R = matrix(torch.from_numpy(np.random.default_rng([FIRST_ROTATED_ID, i]).normal(size=4)).float())
        points = asset.points @ R.T
        points = points - (points.amin(0) + points.amax(0)) / 2
        id = FIRST_ROTATED_ID + i
        made[id] = replace(asset, id=id, points=points, volume=particle_volumes(points, discretisation.dx))
    return made


def load_shape_assets(
    shapes: Mapping[str, ShapeKind], discretisation: Discretisation, min_particles: int, cache: Path | None = None,
    solid: bool = False,
) -> dict[int, Asset]:  # fmt: skip
    """Objects of signed distance fields by id; `cache` is a file (.npz) of their particles, read or written.

    Each has at least `min_particles` surface particles, and with `solid` interior ones after them.
    """
    key = f"spacing {discretisation.spacing} least {min_particles}" + f" dx {discretisation.dx}" * solid

    def sample() -> dict[str, Tensor]:
        bar = tqdm(shapes.items(), desc="objects", unit="object")
        return {name: _shape_particles(kind, discretisation, min_particles, solid) for name, kind in bar}

    points = object_particles.cached_points(cache, key, shapes, sample)
    made = {kind.id: _asset(kind.id, kind.scale, points[name], (kind.E, kind.density), discretisation)
            for name, kind in shapes.items()}  # fmt: skip
    if not solid:
        return made
    return {i: replace(a, solidity=solidity(a.points[:min_particles], float(a.volume.sum()))) for i, a in made.items()}


def mesh_assets(meshes: Sequence[Sequence[Path]], options: HeldoutOptions) -> dict[int, Asset]:
    """Meshes, each of one or several files, as objects 100, 101, ...; file and folder names choose the materials."""
    from stages.lab.assets.meshes import read_mesh  # needs an optional extra

    assets = {}
    for id, files in enumerate(tqdm(meshes, desc="meshes", unit="mesh"), start=FIRST_MESH_ID):
        name = f"{files[0].resolve().parent.name} {object_name(files)}"
        choice = choose_materials([SceneObject(id, name)])[id]
        E = min(choice.material.E, MAX_YOUNG)
        log.info("%s: %s%s, E %.3g Pa", name, choice.name, " (a guess)" * choice.guessed, E)
        points = options.size * read_mesh(files, SURFACE_POINTS).means
        points = _sample_points(points, options.discretisation, options.keypoints)
        assets[id] = _asset(id, options.size, points, (E, choice.material.density), options.discretisation)
    return assets


def _shape_particles(
    kind: ShapeKind, discretisation: Discretisation, min_particles: int, solid: bool
) -> Float[Tensor, "p 3"]:
    """Particles of the surface, and with `solid` those of the interior after them."""
    if not solid:
        return _sample_points(kind.scale * surface_points(kind, SURFACE_POINTS), discretisation, min_particles)
    spacing = discretisation.dx / PARTICLES_PER_CELL_AXIS / kind.scale
    surface, interior = surface_and_interior_points(kind, SURFACE_POINTS, spacing)
    return torch.cat([_sample_points(kind.scale * surface, discretisation, min_particles), kind.scale * interior])


def _sample_points(
    points: Float[Tensor, "n 3"], discretisation: Discretisation, min_particles: int
) -> Float[Tensor, "p 3"]:
    """Some of the points, by farthest-point sampling."""
    if len(points) < min_particles:
        raise InputError(f"--keypoints {min_particles}: an object has only {len(points)} surface points")
    count = min(len(points), max(min_particles, count_for_spacing(points, discretisation.spacing)))
    with single_threaded():
        return points[farthest_points(points, count)]


def _asset(
    id: int, scale: float, points: Tensor, material: tuple[float, float], discretisation: Discretisation
) -> Asset:
    """An object of particles; `material` is Young's modulus [Pa] and density [kg/m^3]."""
    return Asset(id, scale, points, particle_volumes(points, discretisation.dx), *material)
