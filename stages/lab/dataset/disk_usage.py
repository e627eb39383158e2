"""Estimated size of the missing parts of the data set, checked against the free disk space before writing."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from plyfile import PlyData

from stages.core.errors import InputError
from stages.lab.assets.objects import OBJECTS
from stages.lab.dataset.layout import Layout
from stages.lab.dataset.options import DatasetOptions
from stages.lab.dataset.selection import ORBIT_VIEWS, SCENE_COUNTS, object_count

VIDEO_FIXED_CAMERA, VIDEO_MOVING_CAMERA, DEPTH_MAP = 0.02, 0.035, 1.2  # measured compressed sizes [bytes/px]
KEYPOINT_COMPRESSION = 0.55  # ratio of compressed to raw size of keypoints, measured
MAX_DISK_FRACTION = 0.98  # fraction of the free space that may be filled


@dataclass(frozen=True)
class SizeEstimate:
    """Sizes in bytes: exact for uncompressed data, estimated from measured ratios for compressed data."""

    frames: int
    keypoints: int
    resolution: int

    def config(self, objects: int) -> float:
        """Bytes of one scene in the JSON file of its group."""
        return 42 + 100 * objects

    def motion(self, objects: int) -> float:
        """Bytes of the keypoints of one scene."""
        return KEYPOINT_COMPRESSION * self.frames * objects * self.keypoints * 6

    def scene(self, gaussians: float) -> float:
        """Bytes of the point cloud of one scene."""
        return 168 * gaussians

    def mpm(self, gaussians: float) -> float:
        """Bytes of the Gaussians of one scene in every frame."""
        return gaussians * (self.frames * 36 + 56) + 2600 * self.frames

    def initial(self, views: int) -> float:
        """Bytes of the orbit video and depth maps of one scene over one background."""
        return self.resolution**2 * (ORBIT_VIEWS * VIDEO_MOVING_CAMERA + views * DEPTH_MAP)

    def video(self) -> float:
        """Bytes of one video of one scene over time."""
        return self.resolution**2 * self.frames * VIDEO_FIXED_CAMERA


def missing_bytes(layout: Layout, options: DatasetOptions) -> dict[str, float]:
    """Bytes still to be written for each part. The objects must already have been made."""
    sizes = SizeEstimate(options.frames, options.keypoints, options.resolution)
    paths = [layout.object(name) for name in OBJECTS]
    counts = [PlyData.read(str(p), mmap="r")["vertex"].count for p in paths if p.exists()]
    mean_count = sum(counts) / max(len(counts), 1)  # mean number of Gaussians of an object
    views, backgrounds = len(options.view_indices), len(options.background_names)
    out = {}
    for part in ("scene_configs", "motions", "scenes", "mpm", "initial", "dynamic"):
        if part not in options.needed_parts:
            continue
        out[part] = 0.0
        for group in options.shard_groups:
            scenes, objects = min(SCENE_COUNTS[group], options.limit or SCENE_COUNTS[group]), object_count(group)
            total = {
                "scene_configs": SCENE_COUNTS[group] * sizes.config(objects),
                "motions": scenes * sizes.motion(objects),
                "scenes": scenes * sizes.scene(objects * mean_count),
                "mpm": scenes * sizes.mpm(objects * mean_count),
                "initial": scenes * backgrounds * sizes.initial(views),
                "dynamic": scenes * backgrounds * views * sizes.video(),
            }[part]
            file = {"scene_configs": layout.config(group), "motions": layout.motions(group)}.get(part)
            # files are written atomically, so an existing file is complete
            written = total * file.exists() if file else _folder_size(layout.root / part / group)
            out[part] += max(total - written, 0.0)
    return out


def _folder_size(folder: Path) -> int:
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())


def require_disk_space(root: Path, parts: dict[str, float]) -> None:
    """Print the size of each missing part [bytes]; raise InputError if the free space is too small."""
    total, free = sum(parts.values()), shutil.disk_usage(root).free
    if not total:
        return
    missing = ", ".join(f"{part} {format_bytes(size)}" for part, size in parts.items() if size)
    print(f"{root}: about {format_bytes(total)} to write ({missing}), {format_bytes(free)} free", flush=True)
    if total > MAX_DISK_FRACTION * free:
        raise InputError(f"{root}: about {format_bytes(total)} are needed, but {format_bytes(free)} are free; choose "
                         "fewer --parts, --groups, --views or --backgrounds, or a larger disk")  # fmt: skip


def format_bytes(size: float) -> str:
    """1234567 -> "1.23 MB"."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"
