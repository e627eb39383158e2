"""How large parts of the data set are, before they are written."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from plyfile import PlyData

from stages.core.errors import InputError
from stages.lab.assets.objects import OBJECTS
from stages.lab.dataset.layout import ORBIT, Layout
from stages.lab.dataset.options import DatasetOptions
from stages.lab.dataset.scenes import SCENES, objects_in

STILL, MOVING, DEPTH = 0.02, 0.035, 1.2  # bytes a pixel: of videos from a camera that stands or moves, and of depth
PACKED = 0.55  # of keypoints: what compression leaves


@dataclass(frozen=True)
class Sizes:
    """Bytes, about: exact for what is stored as it is, as measured for what is compressed."""

    frames: int
    keypoints: int
    resolution: int

    def config(self, objects: int) -> float:
        """Of a scene in the JSON of its group."""
        return 42 + 100 * objects

    def motion(self, objects: int) -> float:
        """Of the keypoints of a scene."""
        return PACKED * self.frames * objects * self.keypoints * 6

    def scene(self, gaussians: float) -> float:
        return 168 * gaussians

    def mpm(self, gaussians: float) -> float:
        return gaussians * (self.frames * 36 + 56) + 2600 * self.frames

    def initial(self, views: int) -> float:
        """Over one background."""
        return self.resolution**2 * (ORBIT * MOVING + views * DEPTH)

    def video(self) -> float:
        return self.resolution**2 * self.frames * STILL


def wanted(layout: Layout, options: DatasetOptions) -> dict[str, float]:
    """What is still to be written of each part; objects are made already where scenes need them."""
    sizes = Sizes(options.frames, options.keypoints, options.resolution)
    paths = [layout.object(name) for name in OBJECTS]
    counts = [PlyData.read(str(p), mmap="r")["vertex"].count for p in paths if p.exists()]
    each = sum(counts) / max(len(counts), 1)  # Gaussians of an object, on average
    views, tables = len(options.cameras), len(options.tables)
    out = {}
    for part in ("scene_configs", "motions", "scenes", "mpm", "initial", "dynamic"):
        if part not in options.parts:
            continue
        out[part] = 0.0
        for group in options.mine:
            scenes, objects = min(SCENES[group], options.limit or SCENES[group]), objects_in(group)
            total = {
                "scene_configs": SCENES[group] * sizes.config(objects), "motions": scenes * sizes.motion(objects),
                "scenes": scenes * sizes.scene(objects * each), "mpm": scenes * sizes.mpm(objects * each),
                "initial": scenes * tables * sizes.initial(views),
                "dynamic": scenes * tables * views * sizes.video(),
            }[part]  # fmt: skip
            file = {"scene_configs": layout.config(group), "motions": layout.motions(group)}.get(part)
            there = total * file.exists() if file else _size(layout.root / part / group)  # a file that exists is whole
            out[part] += max(total - there, 0.0)
    return out


def _size(folder: Path) -> int:
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())


def must_fit(root: Path, parts: dict[str, float]) -> None:
    """Print what each part that is missing will take; raise InputError when the disk has less."""
    total, free = sum(parts.values()), shutil.disk_usage(root).free
    if not total:
        return
    missing = ", ".join(f"{part} {human(size)}" for part, size in parts.items() if size)
    print(f"{root}: about {human(total)} will be written ({missing}), {human(free)} are free", flush=True)
    if total > 0.98 * free:
        raise InputError(f"{root}: about {human(total)} are needed and {human(free)} are free; choose fewer parts "
                         "(--only), --groups, --views or --backgrounds, or a larger disk")  # fmt: skip


def human(size: float) -> str:
    """1234567 -> "1.23 MB"."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"
