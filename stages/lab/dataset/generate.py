"""GSCollision again: scenes of falling objects, simulated in batches, in the published layout (dataset_layout.py).

Every file appears whole or not at all, so that a run can be stopped at any moment and begun again: what is there is
left as it is. Fewer Gaussians than published may be particles: see stages/lab/results/dataset.md.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.scene.files import provenance
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
from stages.lab.dataset.simulation import simulate

if TYPE_CHECKING:
    from stages.lab.dataset.scene_files import SceneAssets


def run(out: Path, options: DatasetOptions) -> None:
    """Write what is missing of the data set."""
    maker = DatasetGenerator(Path(out), options)
    maker.shared()
    require_disk_space(maker.layout.root, missing_bytes(maker.layout, options))
    for group in options.mine:
        maker.group(group)
    print(f"{out}: complete")


def check(out: Path) -> None:
    """Say that all files of a data set are as they were written; raises InputError when they are not."""
    print(f"{out}: {manifest.verify_files(Path(out))} files, all as they were written")


class DatasetGenerator:
    """Makes the parts of a data set; what they need is made or read when it is first asked for."""

    def __init__(self, out: Path, options: DatasetOptions):
        self.layout, self.options, self.device = Layout(out), options, pick_device(options.device)
        out.mkdir(parents=True, exist_ok=True)
        manifest.open_manifest(out, options.settings)

    @cached_property
    def things(self) -> dict[int, Asset]:
        return load_assets(self.options.fineness, self.options.keypoints, self.layout.root / "particles.npz")

    @cached_property
    def wardrobe(self) -> SceneAssets:
        from stages.lab.dataset.scene_files import SceneAssets

        names = self.options.tables if "backgrounds" in self.options.parts else ()
        tables = {n: read_scene(self.layout.background(n)).gaussians.to(self.device) for n in names}
        return SceneAssets(self.things, load_skins(self.layout, self.things), tables)

    def shared(self) -> None:
        """Objects and backgrounds."""
        layout, parts = self.layout, self.options.parts
        places = [layout.root / name for name in ("objects", "backgrounds")]
        _clear(places)
        kinds = [n for n in objects.OBJECTS if "objects" in parts and not layout.object(n).exists()]
        tables = [n for n in self.options.tables if "backgrounds" in parts and not layout.background(n).exists()]
        if kinds:
            list(objects.run(layout.root / "objects", objects.ObjectsOptions(",".join(kinds))))
        if tables:
            list(backgrounds.run(layout.root / "backgrounds", ",".join(tables)))
        self._seal("shared", places)

    def group(self, group: str) -> None:
        """All parts of a group of scenes."""
        layout, parts = self.layout, {*self.options.parts}
        mine = [layout.config(group), layout.motions(group), *(layout.root / part / group for part in SCENE_PARTS)]
        _clear(mine)
        self._seal(group, mine)  # what is gone or was not listed when a run was killed
        if "scene_configs" in parts and not layout.config(group).exists():
            layout.config(group).parent.mkdir(exist_ok=True)
            configs = sample_group(group, placement_extents(self.things))
            write_scene_configs(
                layout.config(group), perturbed(configs, self.options.nudge) if self.options.nudge else configs
            )
        if "motions" in parts:
            self._motions(group)
        if parts & {*SCENE_PARTS}:
            from stages.lab.dataset.scene_files import write_scene_files  # motions alone need no codec

            write_scene_files(layout, self.options, group, self._configs(group), lambda: self.wardrobe, self.device)
        self._seal(group, mine)

    def _configs(self, group: str) -> dict[str, SceneConfig]:
        rows = list(read_scene_configs(self.layout.config(group)).items())
        return dict(rows[: self.options.limit or None])

    def _motions(self, group: str) -> None:
        path, o = self.layout.motions(group), self.options
        if path.exists():
            limit = read_provenance(path).get("options", {}).get("limit", 0)
            if limit != o.limit:
                raise InputError(f"{path}: was made with --limit {limit}, not {o.limit}; remove it to make it again")
            return
        path.parent.mkdir(exist_ok=True)
        configs, start, made = self._configs(group), time.perf_counter(), 0
        source = provenance("dataset", [self.layout.config(group)], o)
        parts = simulate(configs, self.things, o.fineness, o.frames, o.keypoints, self.device, o.repeatable)
        with tqdm(total=len(configs), desc=group, unit="scene") as bar, KeypointMotionsWriter(path, source) as motions:
            for part in parts:
                motions.append(part)
                made += len(part)
                bar.update(len(part))
        took = time.perf_counter() - start
        print(f"{group}: {made} scenes in {took:.1f} s, {60 * made / took:.0f} a minute", flush=True)

    def _seal(self, name: str, places: list[Path]) -> None:
        manifest.write_checksums(self.layout.root, name, [file for place in places for file in _files(place)])


def _files(place: Path) -> Iterator[Path]:
    if place.is_file():
        yield place
    yield from (p for p in place.rglob("*") if p.is_file())


def _clear(places: list[Path]) -> None:
    """Remove what a killed run had begun to write in folders, or beside files."""
    for place in places:
        begun = place.parent.glob(f".part-{place.name}") if place.suffix else place.rglob(".part-*")
        for p in sorted(begun, key=lambda p: len(p.parts), reverse=True):
            shutil.rmtree(p) if p.is_dir() else p.unlink()
