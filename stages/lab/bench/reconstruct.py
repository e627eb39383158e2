"""Benchmark of reconstruction: camera errors against references, PSNR of held-out photos, time and memory.

A photo set is a folder of photos, or a folder with photos in `images/` or `photos/`. Next to them `cameras.json` (a
nerfstudio transforms file) may hold reference cameras. If there is also `truth.h5`, the reference world is upright and
has the floor height given there. Each set is reconstructed in a subprocess, to measure its peak memory separately.
"""

from __future__ import annotations

import logging
import math
import multiprocessing
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.geometry.rotations import rotation_angle
from stages.core.geometry.similarity import Similarity, umeyama
from stages.core.scene.cameras import Cameras, read_cameras
from stages.core.scene.scene_ply import read_scene
from stages.lab.bench.common import earlier_results, machine, write_json
from stages.lab.bench.scene_options import ReconstructBenchOptions


@dataclass(frozen=True)
class PoseError:
    """Errors of estimated cameras against reference cameras of the same photos."""

    cameras: int  # number of photos present in both
    rotation: float  # median error of the relative rotation over all pairs of photos [degrees]
    rotation_most: float  # largest error of the relative rotation [degrees]
    shift: float  # RMS distance of centres after similarity alignment [% of the extent of the reference centres]


def run(sets: list[Path], out: Path, options: ReconstructBenchOptions) -> Iterator[str]:
    """Yield a line for each set; all results go to the JSON file `out`, which keeps rows of other sets.

    The row of a set that cannot be reconstructed holds the error message.
    """
    if not sets:
        raise InputError(
            "PHOTOSET is missing: name one or more folders that contain images/ and, if known, cameras.json"
        )
    photos = {folder: photo_folder(folder) for folder in map(Path, sets)}
    rows = earlier_results(out, "sets")
    yield f"{'set':14s} {'photos':7s} {'rotation':>9s} {'shift':>7s} {'held-out':>19s} {'wall':>6s} {'CPU':>8s}  memory"
    for folder, images in photos.items():
        try:
            row = measure_in_subprocess(folder, images, options)
        except InputError as error:
            row = {"failed": str(error).removeprefix(f"{images}: ")}
        rows[options.key(folder)] = row
        write_json(out, {"sets": rows})
        yield _line(folder.resolve().name, row)


def measure_in_subprocess(folder: Path, images: Path, options: ReconstructBenchOptions) -> dict:
    """`measure` in a subprocess."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=_log_to_stderr) as process:
        return process.submit(measure, folder, images, options).result()


def _log_to_stderr() -> None:
    """Set up logging in a subprocess, which does not inherit it."""
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    logging.getLogger("stages").setLevel(logging.INFO)


def photo_folder(folder: Path) -> Path:
    """The folder with the photos of a set. Raises InputError if the set does not exist."""
    for name in ("images", "photos"):
        if (folder / name).is_dir():
            return folder / name
    if not folder.exists():
        raise InputError(f"{folder}: there is no such folder; give the folder of a photo set")
    return folder


def measure(folder: Path, images: Path, options: ReconstructBenchOptions) -> dict:
    """Reconstruct one set and compare it with its references, if there are any."""
    facts, found, floor = (_cameras if options.cameras_only else _scene)(images, options)
    device = pick_device(options.device)
    row = {**facts, "device": device, "cpu_seconds": time.process_time(), "machine": machine(device)}
    if (folder / "cameras.json").exists():
        reference, _ = read_cameras(folder / "cameras.json")
        row["poses"] = asdict(pose_error(found, reference))
        if floor is not None and (folder / "truth.h5").exists():
            from stages.core.scene.trajectory import read_trajectory

            true = read_trajectory(folder / "truth.h5").scene.floor
            row["tilt"], row["floor"] = upright_error(found, reference, floor, true)
    return row


def _scene(images: Path, options: ReconstructBenchOptions) -> tuple[dict, Cameras, float | None]:
    """The report of a full reconstruction, its cameras, and its floor height."""
    from stages.reconstruct.options import ReconstructOptions
    from stages.reconstruct.stage import run as reconstruct

    chosen = ReconstructOptions(
        quality=options.quality, holdout=options.holdout, device=options.device, matcher=options.matcher
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        report = reconstruct(images, path, chosen)
        scene = read_scene(path)
    return asdict(report), scene.cameras, scene.floor


def _cameras(images: Path, options: ReconstructBenchOptions) -> tuple[dict, Cameras, None]:
    """The report of camera estimation alone, and the cameras, in a world that is not yet upright."""
    from stages.reconstruct import sfm
    from stages.reconstruct.matching import MatchingOptions
    from stages.reconstruct.options import ReconstructOptions
    from stages.reconstruct.photo_reader import read_photos
    from stages.reconstruct.step_cache import StepCache, peak_memory

    photos, steps = read_photos(images, ReconstructOptions(quality=options.quality).max_side), StepCache()
    model = sfm.estimate_cameras(photos, MatchingOptions(options.matcher, 0, pick_device(options.device)), steps)
    facts = {"photos": len(photos), "placed": len(model.cameras), "dropped": model.dropped, "held_out": None}
    return {**facts, "seconds": steps.seconds, "memory": peak_memory()}, model.cameras, None


def pose_error(found: Cameras, reference: Cameras) -> PoseError:
    """Errors of relative rotations, which need no alignment, and of centres after alignment by a similarity.

    Raises InputError for fewer than 3 common photos.
    """
    a, b = matched_cameras(found, reference)
    relative = []
    for R in (a.viewmats[:, :3, :3].double(), b.viewmats[:, :3, :3].double()):
        i, j = torch.triu_indices(len(R), len(R), 1)
        relative.append(R[j] @ R[i].mT)
    angles = rotation_angle(relative[0] @ relative[1].mT)
    x, y = centres(a.viewmats.double()), centres(b.viewmats.double())
    shift = (umeyama(x, y)(x) - y).square().sum(1).mean().sqrt() / torch.pdist(y).max()
    return PoseError(len(a), float(angles.median()), float(angles.max()), 100 * float(shift))


def upright_error(found: Cameras, reference: Cameras, floor: float, true_floor: float) -> tuple[float, float]:
    """Angle between estimated and true vertical [degrees], and error of the floor height [% of scene size].

    The worlds are aligned by the positions and orientations of all cameras. The scene size is twice the mean distance
    of the cameras from their centroid; floor heights are compared below this centroid.
    """
    a, b = matched_cameras(found, reference)
    move = camera_similarity(a.viewmats.double(), b.viewmats.double())
    up = move.rotation @ torch.tensor([0.0, 0, 1], dtype=torch.float64)
    x, y = centres(a.viewmats.double()).mean(0), centres(b.viewmats.double())
    below = move(x - torch.tensor([0.0, 0, 1]) * (x[2] - floor))
    size = 2 * float((y - y.mean(0)).norm(dim=1).mean())
    tilt = math.degrees(math.acos(min(1.0, float(up[2]))))
    return tilt, 100 * abs(float(below[2]) - true_floor) / size


def camera_similarity(source: Float[Tensor, "n 4 4"], target: Float[Tensor, "n 4 4"]) -> Similarity:
    """Similarity between two worlds, fitted to camera centres and to points along the axes of each camera."""
    points = []
    for viewmats in (source, target):
        eyes = centres(viewmats)
        distance = (eyes - eyes.mean(0)).norm(dim=1).mean()
        points.append(torch.cat([eyes, *(eyes + distance * viewmats[:, axis, :3] for axis in range(3))]))
    return umeyama(*points)


def matched_cameras(found: Cameras, reference: Cameras) -> tuple[Cameras, Cameras]:
    """The cameras of the photos present in both, in the same order. Raises InputError for fewer than 3."""
    row = {name: i for i, name in enumerate(reference.names)}
    both = [name for name in found.names if name in row]
    if len(both) < 3:
        raise InputError(
            f"the reference cameras include {len(both)} of the photos; at least 3 are needed for a comparison"
        )
    return found[[found.names.index(name) for name in both]], reference[[row[name] for name in both]]


def _line(name: str, row: dict) -> str:
    if "failed" in row:
        return f"{name:14s} {row['failed']}"
    poses = row.get("poses")
    rotation = f"{poses['rotation']:5.2f} deg {poses['shift']:5.2f} %" if poses else f"{'-':>9s} {'-':>7s}"
    upright = f"; tilt {row['tilt']:.2f} deg, floor off by {row['floor']:.2f} %" if "tilt" in row else ""
    held = row["held_out"]
    score = f"{held['psnr']:6.2f} dB  {held['ssim']:.3f}" if held else f"{'-':>16s}"
    return (
        f"{name:14s} {row['placed']:3d}/{row['photos']:3d} {rotation} {score:>19s} "
        f"{sum(row['seconds'].values()):4.0f} s {row['cpu_seconds']:6.0f} s {row['memory']:5.1f} GB{upright}"
    )
