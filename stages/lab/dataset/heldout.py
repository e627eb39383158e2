"""Scenes of objects other than the ten: eight that are never trained on, any meshes, or more objects for training.

    OUT/scene_configs/heldout.json     start position of every object, sampled as for the data set
    OUT/motions/heldout.h5             keypoint trajectories, as `ngff-lab dataset` writes
    OUT/particles_heldout.npz          the objects as particles, cached for the next run

The groups for training are `varied`: random hollow shapes (the ten are hollow too); `solid`: filled random shapes, like
the bodies simulated from photos; `turned`: randomly rotated copies of the ten, which the data set never rotates; and
`meshes`: meshes of random size and material. A seed other than 0 is appended to the name of a group (`varied_1`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.scene.files import make_folder, provenance
from stages.lab.assets.heldout_shapes import HELDOUT_SHAPES
from stages.lab.assets.mesh_files import find_objects
from stages.lab.assets.random_shapes import random_shapes
from stages.lab.dataset import extra_objects, object_particles
from stages.lab.dataset.keypoint_motions import KeypointMotionsWriter
from stages.lab.dataset.object_particles import Asset, placement_extents
from stages.lab.dataset.options import HeldoutOptions
from stages.lab.dataset.scene_configs import SceneConfig, sample_scene, write_scene_configs
from stages.lab.dataset.selection import HELDOUT, MESHES, ROTATED, SOLID, VARIED
from stages.lab.dataset.simulation import SimulationSettings, simulate, stable_substep

# index of the first scene of each group, which is also its random seed
FIRST_SCENE = {HELDOUT: 10_000, VARIED: 20_000, SOLID: 30_000, ROTATED: 40_000, MESHES: 50_000}
SCENES_PER_SEED = 100_000  # offset of the scene index from one --seed to the next
SHAPE_SEEDS = {VARIED: 0, SOLID: 1}  # base seed of the random shapes of each group


def run(out: Path, options: HeldoutOptions, meshes: list[Path] | None = None) -> str:
    """Write one group of scenes and return a one-line summary; an existing group is kept.

    `meshes` are files and folders. Raises InputError if they are combined with --solid or --rotations, or if a mesh
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
        make_folder(folder)
    device, start = pick_device(options.device), time.perf_counter()
    objects = find_objects(meshes or [])
    assets = _assets(options, objects, Path(out) / f"particles_{name}.npz")
    materials = [(asset.E, asset.density) for asset in assets.values()]
    options = replace(options, substep=stable_substep(options, materials))
    first = FIRST_SCENE[group] + SCENES_PER_SEED * options.seed
    configs = sample_configs(assets, options.scenes, options.objects, first)
    write_scene_configs(file, configs)
    made_by, count = provenance("heldout", [file, *(path for files in objects for path in files)], options), 0
    settings = SimulationSettings(options, options.frames, options.keypoints, device)
    bar = tqdm(total=len(configs), desc=name, unit="scene")
    with bar, KeypointMotionsWriter(motions, made_by) as writer:
        for batch in simulate(configs, assets, settings):
            writer.append(batch)
            count += len(batch)
            bar.update(len(batch))
    lost = f", {len(configs) - count} failed" if count < len(configs) else ""
    return f"{motions}: {count} scenes of {len(assets)} objects in {time.perf_counter() - start:.0f} s{lost}"


def _assets(options: HeldoutOptions, meshes: Sequence[Sequence[Path]], cache: Path) -> dict[int, Asset]:
    """The objects selected by the options."""
    how, seed = (options, options.keypoints), options.seed
    if meshes and options.shapes:
        return extra_objects.random_mesh_assets(meshes, options.shapes, *how, seed, cache)
    if meshes:
        return extra_objects.mesh_assets(meshes, options.size, *how)
    if options.rotations:
        ten = object_particles.load_assets(*how, cache)
        return extra_objects.rotated_assets(ten, options.rotations, options, seed)
    shapes = HELDOUT_SHAPES
    if options.shapes:
        shapes = random_shapes(options.shapes, SHAPE_SEEDS[options.group(False)] + len(SHAPE_SEEDS) * seed)
    return extra_objects.load_shape_assets(shapes, *how, cache, options.solid)


def sample_configs(
    assets: Mapping[int, Asset], scenes: int, objects: int, first: int = FIRST_SCENE[HELDOUT]
) -> dict[str, SceneConfig]:
    """Scene configurations sampled as for the data set, with seeds starting at `first`."""
    extents = placement_extents(assets)
    configs = (sample_scene(first + i, objects, extents) for i in tqdm(range(scenes), desc="placing", unit="scene"))
    return {c.name: c for c in configs}
