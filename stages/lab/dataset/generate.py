"""Generation of GSCollision: scenes of falling objects, simulated in batches, in the published layout (layout.py).

Files and folders are written atomically and existing files are kept, so a run can be killed at any time and started
again. Fewer particles than the published Gaussians are simulated: see stages/lab/dataset/README.md.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.scene.files import make_folder, provenance
from stages.core.scene.scene_ply import read_scene
from stages.lab.assets import backgrounds, objects
from stages.lab.dataset import manifest
from stages.lab.dataset.disk_usage import missing_bytes, require_disk_space
from stages.lab.dataset.gaussian_frames import load_skins
from stages.lab.dataset.keypoint_motions import KeypointMotionsWriter, read_provenance
from stages.lab.dataset.layout import SCENE_PARTS, Layout
from stages.lab.dataset.object_particles import Asset, load_assets, placement_extents
from stages.lab.dataset.options import DatasetOptions
from stages.lab.dataset.scene_configs import (
    SceneConfig,
    perturbed,
    read_scene_configs,
    sample_group,
    write_scene_configs,
)
from stages.lab.dataset.simulation import SimulationSettings, simulate, stable_substep

if TYPE_CHECKING:
    from stages.lab.dataset.scene_files import SceneAssets


def run(out: Path, options: DatasetOptions) -> None:
    """Write all missing files of the data set. Raises InputError if the disk is too small or settings differ."""
    generator = DatasetGenerator(Path(out), options)
    generator.make_shared()
    require_disk_space(generator.layout.root, missing_bytes(generator.layout, options))
    for group in options.shard_groups:
        generator.make_group(group)
    print(f"{out}: complete")


def check(out: Path) -> None:
    """Verify the sha256 of all files of a data set. Raises InputError if one is missing, changed or not listed."""
    print(f"{out}: {manifest.verify_files(Path(out))} files, all unchanged")


class DatasetGenerator:
    """Generates the parts of a data set; shared inputs are made or read on first use."""

    def __init__(self, out: Path, options: DatasetOptions):
        materials = [(kind.E, kind.density) for kind in objects.OBJECTS.values()]
        self.options = replace(options, substep=stable_substep(options, materials))
        self.layout, self.device = Layout(out), pick_device(options.device)
        make_folder(out)
        manifest.open_manifest(out, self.options.settings)

    @cached_property
    def assets(self) -> dict[int, Asset]:
        """The objects of the data set as particles, by id; sampled or read on first use."""
        return load_assets(self.options, self.options.keypoints, self.layout.root / "particles.npz")

    @cached_property
    def scene_assets(self) -> SceneAssets:
        """Particles, skins and backgrounds needed to write the scene files."""
        from stages.lab.dataset.scene_files import SceneAssets

        names = self.options.background_names if "backgrounds" in self.options.needed_parts else ()
        tables = {n: read_scene(self.layout.background(n)).gaussians.to(self.device) for n in names}
        return SceneAssets(self.assets, load_skins(self.layout, self.assets), tables)

    def make_shared(self) -> None:
        """Write missing objects and backgrounds."""
        layout, parts = self.layout, self.options.needed_parts
        folders = [layout.root / name for name in ("objects", "backgrounds")]
        _remove_partial(folders)
        kinds = [n for n in objects.OBJECTS if "objects" in parts and not layout.object(n).exists()]
        tables = [n for n in self.options.background_names if "backgrounds" in parts]
        tables = [n for n in tables if not layout.background(n).exists()]
        if kinds:
            list(objects.run(layout.root / "objects", objects.ObjectsOptions(only=",".join(kinds))))
        if tables:
            list(backgrounds.run(layout.root / "backgrounds", ",".join(tables)))
        self._write_checksums("shared", folders)

    def make_group(self, group: str) -> None:
        """Write all missing parts of one group of scenes."""
        layout, parts = self.layout, {*self.options.needed_parts}
        paths = [layout.config(group), layout.motions(group), *(layout.root / part / group for part in SCENE_PARTS)]
        _remove_partial(paths)
        self._write_checksums(group, paths)  # update the list, in case a run was killed or files were removed
        if "scene_configs" in parts and not layout.config(group).exists():
            self._write_configs(group)
        if "motions" in parts:
            self._write_motions(group)
        if parts & {*SCENE_PARTS}:
            from stages.lab.dataset.scene_files import GroupFiles, write_scene_files  # needs a video codec

            files = GroupFiles(layout, self.options, group, self.device)
            write_scene_files(files, self._configs(group), lambda: self.scene_assets)
        self._write_checksums(group, paths)

    def _configs(self, group: str) -> dict[str, SceneConfig]:
        rows = list(read_scene_configs(self.layout.config(group)).items())
        return dict(rows[: self.options.limit or None])

    def _write_configs(self, group: str) -> None:
        path, nudge = self.layout.config(group), self.options.nudge
        path.parent.mkdir(exist_ok=True)
        configs = sample_group(group, placement_extents(self.assets))
        write_scene_configs(path, perturbed(configs, nudge) if nudge else configs)

    def _write_motions(self, group: str) -> None:
        path, o = self.layout.motions(group), self.options
        if path.exists():
            limit = read_provenance(path).get("options", {}).get("limit", 0)
            if limit != o.limit:
                raise InputError(
                    f"{path}: was generated with --limit {limit}, not {o.limit}; remove it to generate it again"
                )
            return
        path.parent.mkdir(exist_ok=True)
        configs, start, count = self._configs(group), time.perf_counter(), 0
        made_by = provenance("dataset", [self.layout.config(group)], o)
        settings = SimulationSettings(o, o.frames, o.keypoints, self.device, o.deterministic)
        bar = tqdm(total=len(configs), desc=group, unit="scene")
        with bar, KeypointMotionsWriter(path, made_by) as writer:
            for batch in simulate(configs, self.assets, settings):
                writer.append(batch)
                count += len(batch)
                bar.update(len(batch))
        seconds = time.perf_counter() - start
        print(f"{group}: {count} scenes in {seconds:.1f} s, {60 * count / seconds:.0f} per minute", flush=True)

    def _write_checksums(self, name: str, paths: list[Path]) -> None:
        manifest.write_checksums(self.layout.root, name, [file for path in paths for file in _files(path)])


def _files(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path
    yield from (p for p in path.rglob("*") if p.is_file())


def _remove_partial(paths: list[Path]) -> None:
    """Remove the `.part-*` files and folders of a killed run, inside folders or next to files."""
    for path in paths:
        partial = path.parent.glob(f".part-*-{path.name}") if path.suffix else path.rglob(".part-*")
        for p in sorted(partial, key=lambda p: len(p.parts), reverse=True):
            shutil.rmtree(p) if p.is_dir() else p.unlink()
