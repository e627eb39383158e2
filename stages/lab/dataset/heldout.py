"""Scenes of objects other than the ten: eight that are never trained on, any meshes, or more objects for training.

    OUT/scene_configs/heldout.json     start position of every object, sampled as for the data set
    OUT/motions/heldout.h5             keypoint trajectories, as `ngff-lab dataset` writes
    OUT/particles_heldout.npz          the objects as particles, cached for the next run

The groups for training are `varied`: random hollow shapes (the ten are hollow too); `solid`: filled random shapes,
like the bodies simulated from photos; `turned`: the ten, each randomly rotated, which they never are in the data set;
and `meshes`: meshes of random size and material. With another seed than 0 it ends a group's name (`varied_1`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.scene.files import provenance
from stages.lab.assets.heldout_shapes import HELDOUT_SHAPES
from stages.lab.assets.mesh_files import find_objects
from stages.lab.assets.random_shapes import random_shapes
from stages.lab.dataset import extra_objects, object_particles
from stages.lab.dataset.keypoint_motions import KeypointMotionsWriter
from stages.lab.dataset.object_particles import SUBSTEP, Asset, Discretisation, placement_extents
from stages.lab.dataset.scene_configs import (
    HELDOUT,
    MESHES,
    ROTATED,
    SOLID,
    VARIED,
    SceneConfig,
    sample_scene,
    write_scene_configs,
)
from stages.lab.dataset.simulation import SimulationSettings, simulate, stable_substep

# index, and seed, of the first scene
FIRST_SCENE = {HELDOUT: 10_000, VARIED: 20_000, SOLID: 30_000, ROTATED: 40_000, MESHES: 50_000}
SCENES_PER_SEED = 100_000
SHAPE_SEEDS = {VARIED: 0, SOLID: 1}  # of random shapes


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
    shapes: int = 0  # random shapes, or meshes of random size, and materials, instead of the eight
    solid: bool = False  # fill the random shapes
    rotations: int = 0  # random rotations of the ten objects, instead of the eight
    seed: int = 0  # of scenes and random objects
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

    def group(self, meshes: bool) -> str:
        """Kind of the group of scenes, of meshes or not."""
        random = MESHES if meshes else SOLID if self.solid else VARIED
        return random if self.shapes else ROTATED if self.rotations else HELDOUT

    @property
    def discretisation(self) -> Discretisation:
        """Grid spacing, particle spacing and longest substep of the simulation."""
        return Discretisation(self.dx, self.spacing, self.substep)


def run(out: Path, options: HeldoutOptions = HeldoutOptions(), meshes: list[Path] | None = None) -> str:
    """Write one group of scenes and return a one-line summary; an existing group is kept.

    `meshes` are files and folders. Raises InputError when they are combined with --solid or --rotations, or a mesh
    cannot be read.
    """
    group = options.group(bool(meshes))
    name = f"{group}_{options.seed}" if options.seed else group
    file, motions = Path(out) / "scene_configs" / f"{name}.json", Path(out) / "motions" / f"{name}.h5"
    if meshes and (options.solid or options.rotations):
        raise InputError("--from cannot be combined with --solid or --rotations")
    if motions.exists():
        return f"{motions}: exists already"
    for folder in (file.parent, motions.parent):
        folder.mkdir(parents=True, exist_ok=True)
    device, start = pick_device(options.device), time.perf_counter()
    objects = find_objects(meshes or [])
    assets = _assets(options, objects, Path(out) / f"particles_{name}.npz")
    materials = [(asset.E, asset.density) for asset in assets.values()]
    options = replace(options, substep=stable_substep(options.discretisation, materials))
    first = FIRST_SCENE[group] + SCENES_PER_SEED * options.seed
    configs = sample_configs(assets, options.scenes, options.objects, first)
    write_scene_configs(file, configs)
    made_by, count = provenance("heldout", [file, *(path for files in objects for path in files)], options), 0
    settings = SimulationSettings(options.discretisation, options.frames, options.keypoints, device)
    bar = tqdm(total=len(configs), desc=name, unit="scene")
    with bar, KeypointMotionsWriter(motions, made_by) as writer:
        for batch in simulate(configs, assets, settings):
            writer.append(batch)
            count += len(batch)
            bar.update(len(batch))
    lost = f", {len(configs) - count} failed" if count < len(configs) else ""
    return f"{motions}: {count} scenes of {len(assets)} objects in {time.perf_counter() - start:.0f} s{lost}"


def _assets(options: HeldoutOptions, meshes: Sequence[Sequence[Path]], cache: Path) -> dict[int, Asset]:
    """The objects that the options choose."""
    how, seed = (options.discretisation, options.keypoints), options.seed
    if meshes and options.shapes:
        return extra_objects.random_mesh_assets(meshes, options.shapes, *how, seed, cache)
    if meshes:
        return extra_objects.mesh_assets(meshes, options.size, *how)
    if options.rotations:
        ten = object_particles.load_assets(*how, cache)
        return extra_objects.rotated_assets(ten, options.rotations, options.discretisation, seed)
    shapes = HELDOUT_SHAPES
    if options.shapes:
        shapes = random_shapes(options.shapes, SHAPE_SEEDS[options.group(False)] + len(SHAPE_SEEDS) * seed)
    return extra_objects.load_shape_assets(shapes, *how, cache, options.solid)


def sample_configs(
    assets: Mapping[int, Asset], scenes: int, objects: int, first: int = FIRST_SCENE[HELDOUT]
) -> dict[str, SceneConfig]:
    """Scene configurations sampled as for the data set, with the seeds from `first` on."""
    extents = placement_extents(assets)
    configs = (sample_scene(first + i, objects, extents) for i in tqdm(range(scenes), desc="placing", unit="scene"))
    return {c.name: c for c in configs}
