"""The parts of the data set that are made scene by scene: Gaussians at rest and in motion, and videos of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from stages.core.physics.mpm.batch import BatchFrame
from stages.core.scene.files import provenance
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene_ply import write_scene
from stages.lab.dataset.gaussian_frames import ObjectSkin, SkinnedScene, rest_scene, write_frames
from stages.lab.dataset.layout import Layout, replacing_folder
from stages.lab.dataset.object_particles import FRAME_INTERVAL, Asset
from stages.lab.dataset.options import DatasetOptions
from stages.lab.dataset.scene_configs import SceneConfig
from stages.lab.dataset.simulation import GRAVITY, simulation_batches, valid_scenes
from stages.lab.dataset.videos import write_dynamic, write_initial

MAX_BATCH_PARTICLES = 400_000  # particles at once when all frames of a batch are kept: 2 GB for 100


@dataclass(frozen=True)
class SceneAssets:
    """What scenes are made of."""

    things: Mapping[int, Asset]
    covers: Mapping[int, ObjectSkin]
    tables: Mapping[str, Gaussians]  # backgrounds, on the device


@dataclass(frozen=True)
class MissingFiles:
    """What is not there yet of a scene."""

    scene: bool
    mpm: bool
    initial: tuple[str, ...]  # backgrounds
    dynamic: dict[str, dict[int, Path]]  # background -> view -> video

    @property
    def moves(self) -> bool:
        return self.mpm or bool(self.dynamic)

    def __bool__(self) -> bool:
        return self.scene or self.moves or bool(self.initial)


def missing_files(layout: Layout, options: DatasetOptions, group: str, scene: str) -> MissingFiles:
    """Of the parts that are asked for."""
    parts, tables = options.parts, options.tables
    videos = {b: {v: path for v in options.cameras if not (path := layout.dynamic(group, scene, b, v)).exists()}
              for b in tables if "dynamic" in parts}  # fmt: skip
    return MissingFiles(
        "scenes" in parts and not layout.scene(group, scene).exists(),
        "mpm" in parts and not layout.mpm(group, scene).exists(),
        tuple(b for b in tables if "initial" in parts and not layout.initial(group, scene, b).exists()),
        {b: views for b, views in videos.items() if views},
    )


def write_scene_files(
    layout: Layout, options: DatasetOptions, group: str, configs: Mapping[str, SceneConfig],
    wear: Callable[[], SceneAssets], device: str,
) -> None:  # fmt: skip
    """Write what is missing; scenes that went wrong are told of and left without motion."""
    todo = {name: lacks for name in configs if (lacks := missing_files(layout, options, group, name))}
    if not todo:
        return
    wardrobe, start = wear(), time.perf_counter()
    with tqdm(total=len(todo), desc=group, unit="scene") as bar:
        for name, lacks in todo.items():
            _at_start(layout, options, group, configs[name], lacks, wardrobe, device)
            bar.update(not lacks.moves)
        moving = {name: configs[name] for name, lacks in todo.items() if lacks.moves}
        fineness = options.fineness
        for scenes, batch in (
            simulation_batches(moving, wardrobe.things, fineness, device, True, MAX_BATCH_PARTICLES) if moving else ()
        ):
            frames = list(batch.frames(options.frames, FRAME_INTERVAL, fineness.substeps, GRAVITY))
            for k in valid_scenes(scenes, batch):
                film = [frame.of(scenes[k].name) for frame in frames]
                _in_motion(layout, options, group, scenes[k], todo[scenes[k].name], wardrobe, film, device)
                bar.update()
    took = time.perf_counter() - start
    print(f"{group}: {len(todo)} scenes in {took:.1f} s, {took / len(todo):.2f} s each", flush=True)


def _at_start(
    layout: Layout,
    options: DatasetOptions,
    group: str,
    config: SceneConfig,
    lacks: MissingFiles,
    wardrobe: SceneAssets,
    device: str,
) -> None:
    if lacks.scene:
        path = layout.scene(group, config.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        made_by = provenance("dataset", [layout.config(group)])
        write_scene(path, rest_scene(config, wardrobe.covers, shown=False, provenance=made_by))
    rest = rest_scene(config, wardrobe.covers).gaussians.to(device) if lacks.initial else None
    for background in lacks.initial:
        with replacing_folder(layout.initial(group, config.name, background)) as folder:
            write_initial(folder, config, rest, wardrobe.tables[background], options.resolution, options.cameras)


def _in_motion(
    layout: Layout, options: DatasetOptions, group: str, config: SceneConfig, lacks: MissingFiles,
    wardrobe: SceneAssets, film: Sequence[BatchFrame], device: str,
) -> None:  # fmt: skip
    carried = SkinnedScene(config, wardrobe.covers, wardrobe.things, device)
    x, F = [frame.x for frame in film], [frame.F for frame in film]
    if lacks.mpm:
        with replacing_folder(layout.mpm(group, config.name)) as folder:
            write_frames(folder, carried, x, F)
    for background, views in lacks.dynamic.items():
        write_dynamic(views, carried, x, F, wardrobe.tables[background], options.resolution)
