"""Benchmark of `ngff-lab track`: rendered films of known motion, synchronised and tracked from the films alone."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.rotations import matrix, rotation_angle
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.trajectory import Trajectory, read_trajectory
from stages.lab.bench.common import write_results
from stages.lab.track.options import TrackOptions
from stages.lab.track.stand_in import (
    KEYPOINTS,
    SUBSTEPS,
    StandIn,
    StandInOptions,
    make_stand_in,
    write_films,
    write_truth,
)
from stages.lab.track.track import run as track
from stages.reconstruct.filmed_sequence import read_sequence
from stages.reconstruct.options import ReconstructOptions


@dataclass(frozen=True)
class TrackBenchOptions:
    """Which stand-ins are filmed and tracked."""

    sequences: int = 5
    first: int = 0  # seed of the first sequence
    width: int = 240  # of the films [px]
    frames: int = 50
    device: str = "auto"

    def __post_init__(self):
        if self.sequences < 1 or self.frames < 20 or not 64 <= self.width <= 4096:
            raise InputError("--sequences must be 1 or more, --frames 20 or more and --width 64 to 4096")


def measure(stand_in: StandIn, folder: Path, device: str) -> dict:
    """Errors of the track of a stand-in, which is filmed into the folder."""
    films, truth, out = folder / "films", folder / "truth.h5", folder / "track.h5"
    write_films(stand_in, films)
    write_truth(stand_in, truth)
    began = time.monotonic()
    _, sequence = read_sequence(films, ReconstructOptions(sequence=True))
    frames = min(sequence.frames, stand_in.options.frames)
    write_scene(folder / "scene.ply", replace(stand_in.scene, sequence=replace(sequence, frames=frames)))
    options = TrackOptions(resolution=stand_in.options.width, keypoints=KEYPOINTS, seed=stand_in.options.seed,
                           device=device)  # fmt: skip
    list(track(folder / "scene.ply", films, out, options))
    seconds = time.monotonic() - began
    tracked, true = read_trajectory(out), read_trajectory(truth)
    error, angle = pose_errors(tracked, true)
    seen, (covered, open_) = tracked.confidence > 0, _covered(stand_in, tracked.confidence.shape)
    return {
        "position_mm": 1000 * float(error[seen].median()), "position_mm_90": 1000 * float(error[seen].quantile(0.9)),
        "rotation_deg": float(angle[seen].median()), "rotation_deg_90": float(angle[seen].quantile(0.9)),
        "position_mm_max": 1000 * float(error[seen].max()), "rotation_deg_max": float(angle[seen].max()),
        "covered": int(covered.sum()), "covered_flagged": int((covered & ~seen).sum()),
        "others": int(open_.sum()), "others_flagged": int((open_ & ~seen).sum()),
        "offset_frames": _offset_error(sequence.starts, stand_in.starts),
        "refined_offset_frames": _offset_error(tracked.scene.provenance["starts"], stand_in.starts),
        "release_frames": _release_error(tracked.scene.provenance["starts"], stand_in.starts), "frames": frames,
        "seconds": round(seconds, 1),
    }  # fmt: skip


def pose_errors(tracked: Trajectory, true: Trajectory) -> tuple[Float[Tensor, "t o"], Float[Tensor, "t o"]]:
    """Distance of the objects' middles [scene units] and angle between their rotations [degrees]."""
    frames, ids = len(tracked), tracked.keypoints.object_id
    off = tracked.positions - true.positions[:frames]
    middle = torch.stack([off[:, ids == o.id].mean(1) for o in tracked.scene.objects], 1)
    turn = matrix(tracked.rotation) @ matrix(true.rotation[:frames]).mT
    return middle.norm(dim=-1), rotation_angle(turn)


def _covered(stand_in: StandIn, shape: tuple[int, int]) -> tuple[Bool[Tensor, "t o"], Bool[Tensor, "t o"]]:
    """Frames and objects that are covered in all films but one or none, and those that are covered in none.

    Films show the disc from different frames of the track on, as their pictures are taken at different times.
    """
    count = torch.zeros(shape, dtype=torch.int64)
    for start in stand_in.starts.values():
        for t in range(shape[0]):
            step = round((round(start + t) - start) * SUBSTEPS)
            count[t, 0] += step // SUBSTEPS in stand_in.hidden
    return count >= len(stand_in.starts) - 1, count == 0


def _offset_error(found: dict[str, float], true: dict[str, float]) -> float:
    """Largest error of a film's time relative to the mean of all [frames]."""
    late = torch.tensor([start - true[name] for name, start in found.items()])
    return float((late - late.mean()).abs().max())


def _release_error(found: dict[str, float], true: dict[str, float]) -> float:
    """How much later than the release the motion is taken to begin [frames]."""
    return float(torch.tensor([start - true[name] for name, start in found.items()]).mean())


def run(out: Path | None, options: TrackBenchOptions) -> Iterator[str]:
    """Lines of a table of all sequences, and JSON in `out`."""
    device, results = pick_device(options.device), {}
    yield (f"{'sequence':<10}{'position':>11}{'rotation':>10}{'flagged: covered':>18}{'others':>10}{'offsets by':>12}"
           f"{'refined':>9}{'release':>9}")  # fmt: skip
    yield f"{'':<10}{'[mm]':>11}{'[deg]':>10}{'':>28}{'motion':>12}{'[frames]':>9}{'[frames]':>9}"
    for seed in range(options.first, options.first + options.sequences):
        with tempfile.TemporaryDirectory() as folder:
            stand_in = make_stand_in(StandInOptions(width=options.width, frames=options.frames, seed=seed))
            row = results[str(seed)] = measure(stand_in, Path(folder), device)
        yield (f"{seed:<10}{row['position_mm']:>11.2f}{row['rotation_deg']:>10.2f}"
               f"{row['covered_flagged']:>12} of {row['covered']:<2}{row['others_flagged']:>5} of {row['others']:<4}"
               f"{row['offset_frames']:>9.3f}{row['refined_offset_frames']:>9.3f}{row['release_frames']:>9.3f}"
               )  # fmt: skip
        write_results(out, "track", device, {"width": options.width, "sequences": results})
    yield (f"median of the sequences: {median(r['position_mm'] for r in results.values()):.2f} mm, "
           f"{median(r['rotation_deg'] for r in results.values()):.2f} degrees")  # fmt: skip
