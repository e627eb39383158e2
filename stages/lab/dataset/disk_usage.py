"""How large parts of the data set are, before they are written."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from plyfile import PlyData

from stages.core.errors import InputError
from stages.lab.assets.objects import OBJECTS
from stages.lab.dataset.layout import ORBIT_VIEWS, Layout
from stages.lab.dataset.options import DatasetOptions
from stages.lab.dataset.scene_configs import SCENE_COUNTS, object_count

VIDEO_FIXED_CAMERA, VIDEO_MOVING_CAMERA, DEPTH_MAP = (
    0.02,
    0.035,
    1.2,
)  # bytes a pixel: of videos from a camera that stands or moves, and of depth
KEYPOINT_COMPRESSION = 0.55  # of keypoints: what compression leaves


@dataclass(frozen=True)
class SizeEstimate:
    """Bytes, about: exact for what is stored as it is, as measured for what is compressed."""

    frames: int
    keypoints: int
    resolution: int

    def config(self, objects: int) -> float:
        """Of a scene in the JSON of its group."""
        return 42 + 100 * objects

    def motion(self, objects: int) -> float:
        """Of the keypoints of a scene."""
        return KEYPOINT_COMPRESSION * self.frames * objects * self.keypoints * 6

    def scene(self, gaussians: float) -> float:
        return 168 * gaussians

    def mpm(self, gaussians: float) -> float:
        return gaussians * (self.frames * 36 + 56) + 2600 * self.frames

    def initial(self, views: int) -> float:
        """Over one background."""
        return self.resolution**2 * (ORBIT_VIEWS * VIDEO_MOVING_CAMERA + views * DEPTH_MAP)

    def video(self) -> float:
        return self.resolution**2 * self.frames * VIDEO_FIXED_CAMERA


def missing_bytes(layout: Layout, options: DatasetOptions) -> dict[str, float]:
    """What is still to be written of each part; objects are made already where scenes need them."""
    sizes = SizeEstimate(options.frames, options.keypoints, options.resolution)
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
            scenes, objects = min(SCENE_COUNTS[group], options.limit or SCENE_COUNTS[group]), object_count(group)
            total = {
                "scene_configs": SCENE_COUNTS[group] * sizes.config(objects), "motions": scenes * sizes.motion(objects),
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


def require_disk_space(root: Path, parts: dict[str, float]) -> None:
    """Print what each part that is missing will take; raise InputError when the disk has less."""
    total, free = sum(parts.values()), shutil.disk_usage(root).free
    if not total:
        return
    missing = ", ".join(f"{part} {format_bytes(size)}" for part, size in parts.items() if size)
    print(f"{root}: about {format_bytes(total)} will be written ({missing}), {format_bytes(free)} are free", flush=True)
    if total > 0.98 * free:
        raise InputError(f"{root}: about {format_bytes(total)} are needed and {format_bytes(free)} are free; choose "
                         "fewer parts (--only), --groups, --views or --backgrounds, or a larger disk")  # fmt: skip


def format_bytes(size: float) -> str:
    """1234567 -> "1.23 MB"."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"
