"""Benchmark of `ngff-lab track`: rendered films of known motion, synchronised and tracked from the films alone."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.geometry.cameras import centres
from stages.core.geometry.rotations import matrix, rotation_angle
from stages.core.geometry.similarity import Similarity, umeyama
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.trajectory import Trajectory, read_trajectory
from stages.lab.bench.common import write_results
from stages.lab.bench.motion_options import TrackBenchOptions
from stages.lab.track.options import TrackOptions
from stages.lab.track.stand_in import (
    KEYPOINTS,
    SUBSTEPS,
    StandIn,
    StandInOptions,
    make_stand_in,
    write_cameras,
    write_films,
    write_truth,
)
from stages.lab.track.track import run as track
from stages.reconstruct.filmed_sequence import read_sequence
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.stage import run as reconstruct
from stages.segment.options import SegmentOptions
from stages.segment.stage import run as segment

MATCHED = 0.06  # largest distance between a found and a true object at the release for a match [m]


class PoseErrors(NamedTuple):
    """Errors of each true object in each frame; nan (and not seen) for objects that were not found."""

    distance: Float[Tensor, "t o"]  # error of the object's centre [m]
    angle: Float[Tensor, "t o"]  # error of the rotation since the release [degrees]
    seen: Bool[Tensor, "t o"]


def measure(stand_in: StandIn, folder: Path, device: str, quality: str = "") -> dict:
    """Film a stand-in into a folder, track it, and return the errors; see TrackBenchOptions for `quality`."""
    films, truth, out = folder / "films", folder / "truth.h5", folder / "track.h5"
    write_films(stand_in, films)
    write_truth(stand_in, truth)
    began = time.monotonic()
    scene = reconstructed_scene(stand_in, folder, device, quality) if quality else true_scene(stand_in, folder)
    starts = read_scene(scene).sequence.starts
    options = TrackOptions(resolution=stand_in.options.width, keypoints=KEYPOINTS, seed=stand_in.options.seed,
                           frames=stand_in.options.frames, device=device)  # fmt: skip
    list(track(scene, films, out, options))
    return {**errors_of(stand_in, read_trajectory(out), read_trajectory(truth)),
            "offset_frames": _offset_error(starts, stand_in.starts), "seconds": round(time.monotonic() - began, 1),
            }  # fmt: skip


def true_scene(stand_in: StandIn, folder: Path) -> Path:
    """Write the true scene of a stand-in, with film starts estimated from the films."""
    _, sequence = read_sequence(folder / "films", ReconstructOptions(sequence=True))
    write_scene(folder / "scene.ply", replace(stand_in.scene, sequence=sequence))
    return folder / "scene.ply"


def reconstructed_scene(stand_in: StandIn, folder: Path, device: str, quality: str) -> Path:
    """The scene file that `reconstruct --sequence --cameras` and `segment` make from the films of a stand-in."""
    write_cameras(stand_in, folder / "transforms.json")
    options = ReconstructOptions(sequence=True, cameras=folder / "transforms.json", quality=quality, device=device)
    reconstruct(folder / "films", folder / "scene.ply", options)
    segment(folder / "scene.ply", folder / "labelled.ply", SegmentOptions(device=device))
    return folder / "labelled.ply"


def errors_of(stand_in: StandIn, tracked: Trajectory, true: Trajectory) -> dict:
    """Errors of a track, and how many object frames it flags as lost, in total and for each object."""
    errors, frames = pose_errors(tracked, true), len(tracked)
    covered, open_ = _covered(stand_in, errors.seen.shape)
    starts = tracked.scene.provenance["starts"]
    objects = {}
    for i, o in enumerate(true.scene.objects):
        row = slice(None), slice(i, i + 1)
        objects[f"{o.id} {o.name}"] = _summary(PoseErrors(*(e[row] for e in errors)), covered[row], open_[row])
    return {
        **_summary(errors, covered, open_), "objects": objects,
        "refined_offset_frames": _offset_error(starts, stand_in.starts),
        "release_frames": _release_error(starts, stand_in.starts), "frames": frames,
    }  # fmt: skip


def _summary(errors: PoseErrors, covered: Bool[Tensor, "t o"], open_: Bool[Tensor, "t o"]) -> dict:
    """Quantiles of the errors over seen objects, and numbers of frames."""
    seen, row = errors.seen, {}
    for name, values in (("position_mm", 1000 * errors.distance[seen]), ("rotation_deg", errors.angle[seen])):
        known = values if len(values) else torch.tensor([torch.nan])
        row |= {
            name: float(known.median()),
            f"{name}_90": float(known.quantile(0.9)),
            f"{name}_max": float(known.max()),
        }
    return {**row, "covered": int(covered.sum()), "covered_flagged": int((covered & ~seen).sum()),
            "others": int(open_.sum()), "others_flagged": int((open_ & ~seen).sum())}  # fmt: skip


def pose_errors(tracked: Trajectory, true: Trajectory) -> PoseErrors:
    """Errors of the motion since the first frame, in the true world.

    Each true object is matched with the nearest found object in the first frame.
    """
    frames, shape = len(tracked), (len(tracked), len(true.scene.objects))
    world = _world(tracked.scene, true.scene)
    com, turn = world(tracked.com), world.rotation @ matrix(tracked.rotation) @ world.rotation.mT
    distance, angle = torch.full(shape, torch.nan), torch.full(shape, torch.nan)
    seen = torch.zeros(shape, dtype=torch.bool)
    for i in range(shape[1]):
        middle, spin = true.com[:frames, i], matrix(true.rotation[:frames, i])
        off = (com[0] - middle[0]).norm(dim=1)
        k = int(off.argmin())
        if off[k] > MATCHED:
            continue
        spin, found = spin @ spin[0].mT, turn[:, k] @ turn[0, k].mT
        distance[:, i] = (found @ (middle[0] - com[0, k]) + com[:, k] - middle).norm(dim=1)
        angle[:, i] = rotation_angle(found @ spin.mT)
        seen[:, i] = tracked.confidence[:, k] > 0
    return PoseErrors(distance, angle, seen)


def _world(found: Scene, true: Scene) -> Similarity:
    """Similarity from the world of a reconstructed scene to the true world, by their cameras."""
    names = {name: i for i, name in enumerate(true.cameras.names)}
    rows = [names[name] for name in found.cameras.names]
    return umeyama(centres(found.cameras.viewmats), centres(true.cameras.viewmats[rows]))


def _covered(stand_in: StandIn, shape: tuple[int, int]) -> tuple[Bool[Tensor, "t o"], Bool[Tensor, "t o"]]:
    """Masks of object frames that are covered in at least all films but one, and of those covered in no film.

    The cover appears at different frames of the track in each film, since images are taken at different times.
    """
    count = torch.zeros(shape, dtype=torch.int64)
    for start in stand_in.starts.values():
        for t in range(shape[0]):
            step = round((round(start + t) - start) * SUBSTEPS)
            count[t, 0] += step // SUBSTEPS in stand_in.hidden
    return count >= len(stand_in.starts) - 1, count == 0


def _offset_error(found: dict[str, float], true: dict[str, float]) -> float:
    """Largest error of a film's start relative to the mean of all films [frames]."""
    late = torch.tensor([start - true[name] for name, start in found.items()])
    return float((late - late.mean()).abs().max())


def _release_error(found: dict[str, float], true: dict[str, float]) -> float:
    """Delay of the estimated release after the true one [frames]."""
    return float(torch.tensor([start - true[name] for name, start in found.items()]).mean())


def run(out: Path | None, options: TrackBenchOptions) -> Iterator[str]:
    """Yield the lines of a table of all sequences; `out` receives the results as JSON."""
    device, results = pick_device(options.device), {}
    yield (f"{'sequence':<10}{'position':>11}{'rotation':>10}{'flagged: covered':>18}{'others':>10}{'offsets by':>12}"
           f"{'refined':>9}{'release':>9}")  # fmt: skip
    yield f"{'':<10}{'[mm]':>11}{'[deg]':>10}{'':>28}{'motion':>12}{'[frames]':>9}{'[frames]':>9}"
    for seed in range(options.first, options.first + options.sequences):
        with tempfile.TemporaryDirectory() as folder:
            stand_in = make_stand_in(StandInOptions(width=options.width, frames=options.frames, seed=seed))
            row = results[str(seed)] = measure(stand_in, Path(folder), device, options.quality)
        yield (f"{_line(str(seed), row)}"
               f"{row['offset_frames']:>9.3f}{row['refined_offset_frames']:>9.3f}{row['release_frames']:>9.3f}"
               )  # fmt: skip
        yield from (_line(f"  {name}", each) for name, each in row["objects"].items())
        write_results(out, "track", device, {"width": options.width, "reconstructed": options.quality,
                                             "sequences": results})  # fmt: skip
    yield (f"median of the sequences: {median(r['position_mm'] for r in results.values()):.2f} mm, "
           f"{median(r['rotation_deg'] for r in results.values()):.2f} degrees")  # fmt: skip


def _line(name: str, row: dict) -> str:
    return (f"{name:<10}{row['position_mm']:>11.2f}{row['rotation_deg']:>10.2f}"
            f"{row['covered_flagged']:>12} of {row['covered']:<2}{row['others_flagged']:>5} of {row['others']:<4}"
            )  # fmt: skip
