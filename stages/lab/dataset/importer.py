"""A scene of GSCollision as published -> traj.h5: mpm/<group>/<scene>/%04d.h5 and the scene's point_cloud.ply.

Row i of a frame is the i-th Gaussian of the scene with opacity above 0.02 inside the simulated cube [-1, 1]^3. Some
rows become keypoints; all Gaussians follow them. Which Gaussians are which object is a property `object_id` of the
scene (ours), or follows from the order of objects in scene_configs/<group>.json and how many Gaussians each has.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import torch
from jaxtyping import Float, Int
from plyfile import PlyData, PlyParseError
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.physics.keypoints import bind_gaussians, farthest_points
from stages.core.physics.skinning import object_rotations
from stages.core.scene.files import must_exist, provenance
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.trajectory import Keypoints, SimulationInfo, TrajectoryWriter
from stages.lab.dataset.cameras import orbit_cameras
from stages.lab.dataset.gaussian_frames import FLOOR_HEIGHT
from stages.lab.dataset.layout import Layout, object_kind
from stages.lab.dataset.object_particles import FRAME_INTERVAL, MIN_OPACITY
from stages.lab.dataset.scene_configs import read_scene_configs
from stages.lab.dataset.simulation import GRAVITY

FILE_KIND = "a frame of GSCollision (.h5 with pos, cov3D and rot)"
HALF_EXTENT = 1.0  # of the simulated cube [m]
POSITION_TOLERANCE = 2e-3  # float16 positions are within this of the scene's [m]
RESOLUTION = 448  # of the published views [px]
# Gaussians of the published objects. Source: public code of NGFF
PUBLISHED_COUNTS = {"ball": 106115, "bowl": 232764, "can": 70569, "cloth": 116188, "duck": 80544, "miku": 48316,
             "panda": 56104, "phone": 26571, "pillow": 64229, "rope": 8051}  # fmt: skip


def run(folder: Path, out: Path, scene: Path | None = None, count: int = 2048) -> str:
    """Write traj.h5 with at most `count` keypoints an object; a sentence about it."""
    folder = Path(folder)
    frames = frame_files(folder)
    layout, group, name = _place(folder)
    source = Path(scene) if scene is not None else layout.scene(group, name)
    must_exist(source, "the scene of these frames (.ply; name it with --scene)")
    world = label_objects(read_scene(source), source, layout.config(group), layout, name)
    rows = _rows(world, frames[0], source)
    chosen, keypoints = _keypoints(world, rows, count)
    made_by = {**provenance("import", [source, frames[0]]), "scene": world.provenance}
    world = replace(world, cameras=world.cameras or orbit_cameras(RESOLUTION), provenance=made_by,
                    floor=FLOOR_HEIGHT if world.floor is None else world.floor)  # fmt: skip
    ids = [o.id for o in world.objects]
    owner = world.gaussians.object_id[rows]
    info = SimulationInfo(FRAME_INTERVAL, GRAVITY, "mpm")
    with TrajectoryWriter(out, world, info, keypoints, bind_gaussians(world, keypoints)) as trajectory:
        for t, places in enumerate(_positions(frames, len(rows))):
            com = torch.stack([places[owner == i].mean(0) for i in ids])
            points = places[chosen] if t else keypoints.rest  # the start is known better than to float16
            trajectory.append(points, com, object_rotations(keypoints, points, ids))
    names = ", ".join(o.name for o in world.objects)
    return f"{out}: {len(frames)} frames of {names}, {len(rows)} Gaussians, {len(keypoints.rest)} keypoints"


def frame_files(folder: Path) -> list[Path]:
    """0000.h5, 0001.h5, ... Raises InputError when there are none or one is missing."""
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; give mpm/<group>/<scene> of the data set")
    frames = sorted(p for p in folder.glob("*.h5") if p.stem.isdigit())
    if not frames:
        raise InputError(f"{folder}: has no frames 0000.h5, 0001.h5, ...; give mpm/<group>/<scene> of the data set")
    gap = next((i for i, p in enumerate(frames) if int(p.stem) != i), None)
    if gap is not None:
        raise InputError(f"{folder}: {gap:04d}.h5 is missing, though {frames[-1].name} is there; get the folder whole")
    return frames


def _place(folder: Path) -> tuple[Layout, str, str]:
    """The data set, group and scene of ROOT/mpm/<group>/<scene>."""
    folder = folder.resolve()
    return Layout(folder.parents[min(2, len(folder.parents) - 1)]), folder.parent.name, folder.name


def label_objects(world: Scene, source: Path, configs: Path, layout: Layout, name: str) -> Scene:
    """The scene with its objects, from the order in its configuration where the file does not tell."""
    if world.objects:
        return world
    if not configs.exists():
        raise InputError(f"{source}: does not say which Gaussians are which object, and there is no {configs} to tell; "
                         "label it with `ngff segment` and give the result as --scene")  # fmt: skip
    config = read_scene_configs(configs).get(name)
    if config is None:
        raise InputError(f"{configs}: has no scene {name}; give the configuration that the frames were made of")
    kinds = [object_kind(i) for i in config.ids]
    counts = [_count(layout, kind.name) for kind in kinds]
    if sum(counts) != len(world.gaussians):
        told = ", ".join(f"{kind.name} {n}" for kind, n in zip(kinds, counts, strict=True))
        raise InputError(f"{source}: has {len(world.gaussians)} Gaussians, but its objects together {sum(counts)} "
                         f"({told}); put the objects it was made of into {layout.root / 'objects'}")  # fmt: skip
    ids = torch.repeat_interleave(torch.arange(1, len(kinds) + 1), torch.tensor(counts))
    objects = tuple(SceneObject(n, kind.name) for n, kind in enumerate(kinds, start=1))
    return replace(world, gaussians=replace(world.gaussians, object_id=ids), objects=objects)


def _count(layout: Layout, name: str) -> int:
    """Gaussians of an object: of the data set's own file, or as published."""
    path = layout.object(name)
    if not path.exists():
        return PUBLISHED_COUNTS[name]
    try:
        return PlyData.read(str(path), mmap="r")["vertex"].count
    except (PlyParseError, KeyError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from error


def _rows(world: Scene, first: Path, source: Path) -> Int[Tensor, "r"]:
    """The Gaussian of each row. Raises InputError when the frames are not of this scene."""
    g = world.gaussians
    rows = ((g.opacities > MIN_OPACITY) & (g.means.abs() <= HALF_EXTENT).all(1)).nonzero()[:, 0]
    places = _read(first, "pos", (3,))
    if len(places) != len(rows):
        raise InputError(f"{first}: has {len(places)} rows, but {source} has {len(rows)} Gaussians with opacity above "
                         f"{MIN_OPACITY} within {HALF_EXTENT} m; give the scene it was made of as --scene")  # fmt: skip
    apart = float((places - g.means[rows]).abs().amax())
    if not apart <= POSITION_TOLERANCE:
        raise InputError(f"{first}: rows start up to {apart:.3g} m from the Gaussians of {source}; give the scene that "
                         "the frames were made of as --scene")  # fmt: skip
    return rows


def _keypoints(world: Scene, rows: Int[Tensor, "r"], count: int) -> tuple[Int[Tensor, "k"], Keypoints]:
    """Rows of each object spread evenly, and where they start."""
    if count < 1:
        raise InputError(f"--keypoints {count}: at least 1 an object")
    g, chosen = world.gaussians, []
    for o in world.objects:
        mine = (g.object_id[rows] == o.id).nonzero()[:, 0]
        chosen.append(mine[farthest_points(g.means[rows[mine]], count)])
    index = torch.cat(chosen)
    return index, Keypoints(g.means[rows[index]], g.object_id[rows[index]])


def _positions(frames: list[Path], count: int) -> Iterator[Float[Tensor, "r 3"]]:
    for path in tqdm(frames, unit="frame"):
        places = _read(path, "pos", (3,))
        if len(places) != count:
            raise InputError(f"{path}: has {len(places)} rows and the first frame {count}; get the folder whole")
        if not places.isfinite().all():
            raise InputError(f"{path}: some positions are not finite; this scene cannot be used")
        yield places


def _read(path: Path, name: str, shape: tuple[int, ...]) -> Tensor:
    """A dataset of a frame, (n, *shape) of any float type, as float32."""
    must_exist(path, FILE_KIND)
    try:
        with h5py.File(path, "r") as file:
            data = np.asarray(file[name][()], np.float32)
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); {FILE_KIND} is expected") from error
    if data.shape[1:] != shape:
        raise InputError(f"{path}: {name} has shape {data.shape}; (n, {', '.join(map(str, shape))}) is expected")
    return torch.from_numpy(data)
