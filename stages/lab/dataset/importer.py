"""Import of a published scene of GSCollision: mpm/<group>/<scene>/%04d.h5 and its point_cloud.ply -> traj.h5.

Row i of a frame is the i-th Gaussian of the scene with opacity above 0.02 inside the simulated cube [-1, 1]^3. Some
rows become keypoints, to which all Gaussians are skinned. The object of each Gaussian is a property `object_id` of the
scene file (if written by ngff), or follows from the order of objects in scene_configs/<group>.json and their
Gaussian counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import torch
from jaxtyping import Float, Int
from plyfile import PlyData, PlyParseError
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.models.initial_conditions import FLOOR, GRAVITY
from stages.core.physics.keypoints import bind_gaussians, farthest_points
from stages.core.physics.particles import MIN_PARTICLE_OPACITY
from stages.core.physics.skinning import object_rotations
from stages.core.scene.files import must_exist, provenance
from stages.core.scene.h5_schema import Dataset
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.schema import reason
from stages.core.scene.trajectory import Keypoints, SimulationInfo, TrajectoryWriter
from stages.lab.dataset.cameras import orbit_cameras
from stages.lab.dataset.layout import Layout, object_kind
from stages.lab.dataset.options import FRAME_INTERVAL
from stages.lab.dataset.scene_configs import read_scene_configs

FILE_KIND = "a frame of GSCollision (.h5 with pos, cov3D and rot)"
HALF_EXTENT = 1.0  # half side of the simulated cube [m]
POSITION_TOLERANCE = 2e-3  # largest difference between float16 positions and those of the scene [m]
RESOLUTION = 448  # side of the published views [px]
# Gaussian count of the published objects. Source: public code of NGFF
PUBLISHED_COUNTS = {"ball": 106115, "bowl": 232764, "can": 70569, "cloth": 116188, "duck": 80544, "miku": 48316,
             "panda": 56104, "phone": 26571, "pillow": 64229, "rope": 8051}  # fmt: skip


def run(folder: Path, out: Path, scene: Path | None = None, count: int = 2048) -> str:
    """Write `out` with at most `count` keypoints per object and return a one-line summary.

    Raises InputError if the frames are incomplete or do not belong to the scene.
    """
    folder = Path(folder)
    frames = frame_files(folder)
    layout, group, name = _locate(folder)
    source = Path(scene) if scene is not None else layout.scene(group, name)
    must_exist(source, "the scene of these frames (.ply; name it with --scene)")
    labelled = label_objects(read_scene(source), source, layout, group, name)
    rows = _frame_rows(labelled, frames[0], source)
    chosen, keypoints = _choose_keypoints(labelled, rows, count)
    made_by = {**provenance("import", [source, frames[0]]), "scene": labelled.provenance}
    initial = replace(labelled, cameras=labelled.cameras or orbit_cameras(RESOLUTION), provenance=made_by,
                      floor=FLOOR if labelled.floor is None else labelled.floor)  # fmt: skip
    ids = [o.id for o in initial.objects]
    owner = initial.gaussians.object_id[rows]
    info = SimulationInfo(FRAME_INTERVAL, GRAVITY, "mpm")
    with TrajectoryWriter(out, initial, info, keypoints, bind_gaussians(initial, keypoints)) as trajectory:
        for t, positions in enumerate(_read_positions(frames, len(rows))):
            com = torch.stack([positions[owner == i].mean(0) for i in ids])
            points = positions[chosen] if t else keypoints.rest  # the rest positions are not rounded to float16
            trajectory.append(points, com, object_rotations(keypoints, points, ids))
    names = ", ".join(o.name for o in initial.objects)
    return f"{out}: {len(frames)} frames of {names}, {len(rows)} Gaussians, {len(keypoints.rest)} keypoints"


def frame_files(folder: Path) -> list[Path]:
    """The frames 0000.h5, 0001.h5, ... of a folder. Raises InputError if there are none or one is missing."""
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; give mpm/<group>/<scene> of the data set")
    frames = sorted(p for p in folder.glob("*.h5") if p.stem.isdigit())
    if not frames:
        raise InputError(
            f"{folder}: contains no frames 0000.h5, 0001.h5, ...; give mpm/<group>/<scene> of the data set"
        )
    gap = next((i for i, p in enumerate(frames) if int(p.stem) != i), None)
    if gap is not None:
        raise InputError(
            f"{folder}: {gap:04d}.h5 is missing, though {frames[-1].name} exists; download the folder completely"
        )
    return frames


def _locate(folder: Path) -> tuple[Layout, str, str]:
    """Data set root, group and scene name from the path ROOT/mpm/<group>/<scene>."""
    folder = folder.resolve()
    return Layout(folder.parents[min(2, len(folder.parents) - 1)]), folder.parent.name, folder.name


def label_objects(scene: Scene, source: Path, layout: Layout, group: str, name: str) -> Scene:
    """The scene with object ids: its own, or derived from the object order in its configuration.

    `source` is the file of the scene, for messages. Raises InputError if the configuration is missing or does not
    match the number of Gaussians.
    """
    if scene.objects:
        return scene
    configs = layout.config(group)
    if not configs.exists():
        raise InputError(f"{source}: has no object ids, and there is no {configs} to derive them from; label it with "
                         "`ngff segment` and give the result as --scene")  # fmt: skip
    config = read_scene_configs(configs).get(name)
    if config is None:
        raise InputError(f"{configs}: has no scene {name}; give the configuration that the frames were made from")
    kinds = [object_kind(i) for i in config.ids]
    counts = [_gaussian_count(layout, kind.name) for kind in kinds]
    if sum(counts) != len(scene.gaussians):
        listed = ", ".join(f"{kind.name} {n}" for kind, n in zip(kinds, counts, strict=True))
        raise InputError(f"{source}: has {len(scene.gaussians)} Gaussians, but its objects together {sum(counts)} "
                         f"({listed}); put the objects it was made from into {layout.root / 'objects'}")  # fmt: skip
    ids = torch.repeat_interleave(torch.arange(1, len(kinds) + 1), torch.tensor(counts))
    objects = tuple(SceneObject(n, kind.name) for n, kind in enumerate(kinds, start=1))
    return replace(scene, gaussians=replace(scene.gaussians, object_id=ids), objects=objects)


def _gaussian_count(layout: Layout, name: str) -> int:
    """Number of Gaussians of an object, from the file of the data set, or as published."""
    path = layout.object(name)
    if not path.exists():
        return PUBLISHED_COUNTS[name]
    try:
        return PlyData.read(str(path), mmap="r")["vertex"].count
    except (PlyParseError, KeyError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); download it again") from error


def _frame_rows(scene: Scene, first: Path, source: Path) -> Int[Tensor, "r"]:
    """Index of the Gaussian of each row. Raises InputError if the frames do not belong to the scene."""
    g = scene.gaussians
    rows = ((g.opacities > MIN_PARTICLE_OPACITY) & (g.means.abs() <= HALF_EXTENT).all(1)).nonzero()[:, 0]
    positions = read_frame(first, "pos", (3,))
    if len(positions) != len(rows):
        raise InputError(
            f"{first}: has {len(positions)} rows, but {source} has {len(rows)} Gaussians with opacity above "
            f"{MIN_PARTICLE_OPACITY} within {HALF_EXTENT} m; give the scene it was made from as --scene"
        )
    distance = float((positions - g.means[rows]).abs().amax())
    if not distance <= POSITION_TOLERANCE:
        raise InputError(f"{first}: its rows start up to {distance:.3g} m away from the Gaussians of {source}; "
                         "give the scene "
                         "that the frames were made from as --scene")  # fmt: skip
    return rows


def _choose_keypoints(scene: Scene, rows: Int[Tensor, "r"], count: int) -> tuple[Int[Tensor, "k"], Keypoints]:
    """Evenly distributed rows of each object, and the keypoints at their rest positions."""
    if count < 1:
        raise InputError(f"--keypoints {count}: give at least 1 per object")
    g, chosen = scene.gaussians, []
    for o in scene.objects:
        own = (g.object_id[rows] == o.id).nonzero()[:, 0]
        chosen.append(own[farthest_points(g.means[rows[own]], count)])
    index = torch.cat(chosen)
    return index, Keypoints(g.means[rows[index]], g.object_id[rows[index]])


def _read_positions(frames: list[Path], count: int) -> Iterator[Float[Tensor, "r 3"]]:
    for path in tqdm(frames, unit="frame"):
        positions = read_frame(path, "pos", (3,))
        if len(positions) != count:
            raise InputError(f"{path}: has {len(positions)} rows, but the first frame has {count}; download it again")
        yield positions


def read_frame(path: Path, name: str, shape: tuple[int, ...]) -> Tensor:
    """Dataset `name` of a frame, of shape (n, *shape), as float32."""
    must_exist(path, FILE_KIND)
    try:
        with h5py.File(path, "r") as file:
            table = Dataset(" ".join(("n", *map(str, shape))))
            return torch.from_numpy(table.read(file, name, {}))
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}); {FILE_KIND} is expected") from error
