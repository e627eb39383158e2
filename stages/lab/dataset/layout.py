"""Folder layout of GSCollision.

scene_configs/<group>.json                       start position of every object
motions/<group>.h5                               keypoints in every frame (keypoint_motions.py); not published
objects/<object>/  backgrounds/<background>/     Gaussians, generated
scenes/<group>/<scene>/point_cloud/iteration_30000/point_cloud.ply
mpm/<group>/<scene>/%04d.h5, shs.h5, opacity.h5  every Gaussian in every frame (gaussian_frames.py)
initial/<group>/<scene>/<background>/            <scene>.mp4, cameras.json, prompts.json, depth.h5 (videos.py)
dynamic/<group>/<scene>/<background>/view_<i>/<scene>.mp4
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from stages.core.scene.files import replacing
from stages.lab.assets.backgrounds import BACKGROUND_PLY
from stages.lab.assets.objects import OBJECTS, POINT_CLOUD, ObjectKind

SCENE_PARTS = ("scenes", "mpm", "initial", "dynamic")  # parts with files for each scene


@dataclass(frozen=True)
class Layout:
    """Paths inside a data set."""

    root: Path

    def config(self, group: str) -> Path:
        """Scene configurations of a group (.json)."""
        return self.root / "scene_configs" / f"{group}.json"

    def motions(self, group: str) -> Path:
        """Keypoint trajectories of a group (.h5)."""
        return self.root / "motions" / f"{group}.h5"

    def object(self, name: str) -> Path:
        """Gaussians of an object (.ply)."""
        return self.root / "objects" / name / POINT_CLOUD

    def background(self, name: str) -> Path:
        """Gaussians of a background (.ply)."""
        return self.root / "backgrounds" / name / BACKGROUND_PLY

    def scene(self, group: str, scene: str) -> Path:
        """Gaussians of a scene in its first frame (.ply)."""
        return self.root / "scenes" / group / scene / POINT_CLOUD

    def mpm(self, group: str, scene: str) -> Path:
        """Folder of the Gaussians of a scene in every frame."""
        return self.root / "mpm" / group / scene

    def initial(self, group: str, scene: str, background: str) -> Path:
        """Folder of the views of the first frame over a background."""
        return self.root / "initial" / group / scene / background

    def dynamic(self, group: str, scene: str, background: str, view: int) -> Path:
        """Video of a scene over time (.mp4)."""
        return self.root / "dynamic" / group / scene / background / f"view_{view}" / f"{scene}.mp4"


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """An empty folder next to `path` that is renamed to `path` on success and removed on failure.

    A leftover of an earlier, killed run is removed first. Raises InputError if the folder cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        try:
            yield part
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise


def object_kind(object_id: int) -> ObjectKind:
    """The object kind with this published id."""
    return next(kind for kind in OBJECTS.values() if kind.id == object_id)
