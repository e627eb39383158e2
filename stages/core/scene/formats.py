"""The file formats that are read and written, by suffix.

A new format is one entry here and a reader or writer with the signature of its kind:

kind         reader                                writer
scene        read(path) -> Scene                   write(path, scene)
trajectory   read(path) -> Trajectory              TrajectoryWriter(path, scene, info, keypoints, binding)
image        read(path) -> (h, w, 3) in 0..1       write(path, image)
video        read(path) -> iterator of images      VideoWriter(path, fps)
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from stages.core.backends import load
from stages.core.errors import InputError


class Format(NamedTuple):
    """A file format: the kind of data it holds, and its reader and writer as "module:function" ("" for none)."""

    kind: str  # "scene", "trajectory", "image" or "video"
    reader: str
    writer: str = ""

    def read(self, path: Path) -> object:
        """Read a file; the type of the result depends on the kind."""
        return load(self.reader)(path)

    def load_writer(self) -> Callable:
        """The function or class that writes files of this format, which must have a writer."""
        return load(self.writer)


_IMAGES, _TRAJECTORIES = "stages.core.scene.images", "stages.core.scene.trajectory"
_SCENE = Format("scene", "stages.core.scene.scene_ply:read_scene", "stages.core.scene.scene_ply:write_scene")
_TRAJECTORY = Format("trajectory", f"{_TRAJECTORIES}:read_trajectory", f"{_TRAJECTORIES}:TrajectoryWriter")
_IMAGE = Format("image", f"{_IMAGES}:read_image")
_VIDEO = Format("video", f"{_IMAGES}:read_video")

FORMATS = {
    ".ply": _SCENE,
    ".h5": _TRAJECTORY,
    ".hdf5": _TRAJECTORY,
    **dict.fromkeys([".jpeg", ".bmp", ".tif", ".tiff", ".webp"], _IMAGE),
    ".png": _IMAGE._replace(writer=f"{_IMAGES}:write_png"),
    ".jpg": _IMAGE._replace(writer=f"{_IMAGES}:write_jpeg"),
    **dict.fromkeys([".mov", ".avi", ".mkv", ".webm", ".m4v"], _VIDEO),
    ".mp4": _VIDEO._replace(writer=f"{_IMAGES}:VideoWriter"),
}


def suffixes(*kinds: str, writable: bool = False) -> list[str]:
    """The suffixes of these kinds of data, sorted; with `writable` only those of formats that can be written."""
    return sorted(s for s, format in FORMATS.items() if format.kind in kinds and (format.writer or not writable))


def format_of(path: Path, *kinds: str, writable: bool = False) -> Format:
    """The format of a file by its suffix; the file need not exist.

    Raises InputError, which lists the accepted suffixes, unless the format holds one of these kinds of data and, with
    `writable`, can be written.
    """
    suffix, allowed = path.suffix.lower(), suffixes(*kinds, writable=writable)
    if suffix not in allowed:
        action = "written" if writable else "read"
        raise InputError(
            f"{path}: a file with {f'suffix {suffix}' if suffix else 'no suffix'} cannot be {action} as "
            f"{' or '.join(kinds)}; use {', '.join(allowed)}"
        )
    return FORMATS[suffix]


IMAGE_SUFFIXES, VIDEO_SUFFIXES = frozenset(suffixes("image")), frozenset(suffixes("video"))
