"""Where GSCollision keeps what.

scene_configs/<group>.json                       where every object starts
motions/<group>.h5                               keypoints in every frame (motions.py); not in the published set
objects/<object>/  backgrounds/<background>/     Gaussians, made in code
scenes/<group>/<scene>/point_cloud/iteration_30000/point_cloud.ply
mpm/<group>/<scene>/%04d.h5, shs.h5, opacity.h5  every Gaussian in every frame (dataset_gaussians.py)
initial/<group>/<scene>/<background>/            <scene>.mp4, cameras.json, prompts.json, depth.h5
dynamic/<group>/<scene>/<background>/view_<i>/<scene>.mp4
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError
from stages.lab.assets.backgrounds import BACKGROUND_PLY as BACKGROUND_PLY
from stages.lab.assets.backgrounds import BACKGROUNDS
from stages.lab.assets.objects import OBJECTS, ObjectKind

PARTS = ("scene_configs", "motions", "objects", "backgrounds", "scenes", "mpm", "initial", "dynamic")
POINT_CLOUD = "point_cloud/iteration_30000/point_cloud.ply"  # of objects and scenes
SCENE_PARTS = ("scenes", "mpm", "initial", "dynamic")
ORBIT_VIEWS = 100  # cameras around a scene, a frame each of an initial video
VIDEO_VIEWS = tuple(range(0, ORBIT_VIEWS, 4))  # from where dynamic videos are taken


@dataclass(frozen=True)
class Layout:
    """Paths in a data set."""

    root: Path

    def config(self, group: str) -> Path:
        return self.root / "scene_configs" / f"{group}.json"

    def motions(self, group: str) -> Path:
        return self.root / "motions" / f"{group}.h5"

    def object(self, name: str) -> Path:
        return self.root / "objects" / name / POINT_CLOUD

    def background(self, name: str) -> Path:
        return self.root / "backgrounds" / name / BACKGROUND_PLY

    def scene(self, group: str, scene: str) -> Path:
        return self.root / "scenes" / group / scene / POINT_CLOUD

    def mpm(self, group: str, scene: str) -> Path:
        return self.root / "mpm" / group / scene

    def initial(self, group: str, scene: str, background: str) -> Path:
        return self.root / "initial" / group / scene / background

    def dynamic(self, group: str, scene: str, background: str, view: int) -> Path:
        return self.root / "dynamic" / group / scene / background / f"view_{view}" / f"{scene}.mp4"


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """An empty folder beside `path` that takes its place on success and vanishes on failure.

    What a killed run left of it is removed first.
    """
    part = path.with_name(f".part-{path.name}")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def parse_parts(text: str) -> tuple[str, ...]:
    """ "mpm, scenes" -> ("scenes", "mpm"), in the order in which they are made."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    odd = next((name for name in names if name not in PARTS), None)
    if odd is not None or not names:
        raise InputError(f"--only {odd or text!r}: choose from {', '.join(PARTS)}")
    return tuple(p for p in PARTS if p in names)


def parse_views(text: str) -> tuple[int, ...]:
    """ "0,16" -> (0, 16); "all" are the 25 published ones."""
    if text == "all":
        return VIDEO_VIEWS
    names = [name.strip() for name in text.split(",")]
    if not all(name.isdigit() and int(name) in VIDEO_VIEWS for name in names):
        raise InputError(f"--views {text}: multiples of 4 from 0 to {VIDEO_VIEWS[-1]} with commas between, or all")
    return tuple(sorted({int(name) for name in names}))


def parse_backgrounds(text: str) -> tuple[str, ...]:
    """ "table0,table3" -> ("table0", "table3"); "all" are the eight."""
    names = tuple(BACKGROUNDS) if text == "all" else tuple(name.strip() for name in text.split(","))
    odd = next((name for name in names if name not in BACKGROUNDS), None)
    if odd is not None:
        raise InputError(f"--backgrounds {odd}: choose from {', '.join(BACKGROUNDS)}, or all")
    return tuple(dict.fromkeys(names))


def object_kind(object_id: int) -> ObjectKind:
    """The ObjectKind with this id."""
    return next(kind for kind in OBJECTS.values() if kind.id == object_id)
