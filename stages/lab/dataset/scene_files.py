"""Writing of the data set parts that have files for each scene: Gaussians at rest and in motion, and videos of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from stages.core.models.initial_conditions import GRAVITY
from stages.core.physics.mpm.batch import BatchFrame
from stages.core.scene.files import provenance
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene_ply import write_scene
from stages.lab.dataset.gaussian_frames import (
    ObjectSkin,
    SkinnedScene,
    compose_scene,
    opaque_rest_gaussians,
    write_frames,
)
from stages.lab.dataset.layout import Layout, replacing_folder
from stages.lab.dataset.object_particles import Asset
from stages.lab.dataset.options import FRAME_INTERVAL, DatasetOptions
from stages.lab.dataset.scene_configs import SceneConfig
from stages.lab.dataset.simulation import SimulationSettings, simulation_batches, valid_scenes
from stages.lab.dataset.videos import write_dynamic, write_initial

MAX_BATCH_PARTICLES = 400_000  # particles per batch if all frames are kept in memory: 2 GB for 100 frames


@dataclass(frozen=True)
class SceneAssets:
    """Inputs of the scene files."""

    particles: Mapping[int, Asset]
    skins: Mapping[int, ObjectSkin]
    backgrounds: Mapping[str, Gaussians]  # backgrounds by name, on the rendering device


@dataclass(frozen=True)
class MissingFiles:
    """The files of a scene that do not exist yet."""

    scene: bool
    mpm: bool
    initial: tuple[str, ...]  # names of backgrounds
    dynamic: dict[str, dict[int, Path]]  # background -> view -> video

    @property
    def needs_simulation(self) -> bool:
        """Whether a missing file shows the scene in motion."""
        return self.mpm or bool(self.dynamic)

    def __bool__(self) -> bool:
        return self.scene or self.needs_simulation or bool(self.initial)


@dataclass(frozen=True)
class GroupFiles:
    """The files of one group of scenes: their paths and the functions that generate them."""

    layout: Layout
    options: DatasetOptions
    group: str
    device: str

    def missing(self, scene: str) -> MissingFiles:
        """The files of the requested parts that do not exist."""
        layout, group = self.layout, self.group
        parts, backgrounds = self.options.needed_parts, self.options.background_names
        videos = {}
        for b in backgrounds if "dynamic" in parts else ():
            paths = {v: layout.dynamic(group, scene, b, v) for v in self.options.view_indices}
            videos[b] = {v: path for v, path in paths.items() if not path.exists()}
        return MissingFiles(
            scene="scenes" in parts and not layout.scene(group, scene).exists(),
            mpm="mpm" in parts and not layout.mpm(group, scene).exists(),
            initial=tuple(
                b for b in backgrounds if "initial" in parts and not layout.initial(group, scene, b).exists()
            ),
            dynamic={b: views for b, views in videos.items() if views},
        )

    def write_rest(self, config: SceneConfig, missing: MissingFiles, assets: SceneAssets) -> None:
        """Write the missing files of a scene that show only its first frame."""
        if missing.scene:
            path = self.layout.scene(self.group, config.name)
            path.parent.mkdir(parents=True, exist_ok=True)
            made_by = provenance("dataset", [self.layout.config(self.group)])
            write_scene(path, compose_scene(config, [assets.skins[i].gaussians for i in config.ids], made_by))
        rest = opaque_rest_gaussians(config, assets.skins).to(self.device) if missing.initial else None
        for name in missing.initial:
            with replacing_folder(self.layout.initial(self.group, config.name, name)) as folder:
                write_initial(folder, config, rest, assets.backgrounds[name], self.options.resolution,
                              self.options.view_indices)  # fmt: skip

    def write_motion(
        self, config: SceneConfig, missing: MissingFiles, assets: SceneAssets, frames: Sequence[BatchFrame]
    ) -> None:
        """Write the missing files of a scene that show its motion."""
        scene = SkinnedScene(config, assets.skins, assets.particles, self.device)
        x, F = [frame.x for frame in frames], [frame.F for frame in frames]
        if missing.mpm:
            with replacing_folder(self.layout.mpm(self.group, config.name)) as folder:
                write_frames(folder, scene, x, F)
        for name, views in missing.dynamic.items():
            write_dynamic(views, scene, x, F, assets.backgrounds[name], self.options.resolution)


def write_scene_files(
    files: GroupFiles, configs: Mapping[str, SceneConfig], load_assets: Callable[[], SceneAssets]
) -> None:
    """Write the missing files of all scenes; `load_assets` is called only if there are any.

    A scene whose simulation fails is logged, and no files of its motion are written.
    """
    options = files.options
    todo = {name: missing for name in configs if (missing := files.missing(name))}
    if not todo:
        return
    assets, start = load_assets(), time.perf_counter()
    with tqdm(total=len(todo), desc=files.group, unit="scene") as bar:
        for name, missing in todo.items():
            files.write_rest(configs[name], missing, assets)
            bar.update(not missing.needs_simulation)
        moving = {name: configs[name] for name, missing in todo.items() if missing.needs_simulation}
        settings = SimulationSettings(options, options.frames, options.keypoints, files.device, exact=True)
        batches = simulation_batches(moving, assets.particles, settings, MAX_BATCH_PARTICLES) if moving else ()
        for scenes, batch in batches:
            frames = list(batch.frames(options.frames, FRAME_INTERVAL, options.substeps, GRAVITY))
            for k in valid_scenes(scenes, batch):
                name = scenes[k].name
                files.write_motion(scenes[k], todo[name], assets, [frame.of(name) for frame in frames])
                bar.update()
    seconds = time.perf_counter() - start
    print(f"{files.group}: {len(todo)} scenes in {seconds:.1f} s, {seconds / len(todo):.2f} s each", flush=True)
