"""Motions for training: which scenes are learned from, which choose the best weights, and short pieces of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.models.dynamics import Dynamics
from stages.core.models.initial_conditions import InitialConditions
from stages.core.scene.files import sha256
from stages.lab.dataset.keypoint_motions import KeypointMotions, concatenate_motions, read_motions

VALIDATION_SCENES = 100  # scenes at the end of the last group that only choose among weights
MAX_SPEED_CHANGE = (
    0.3  # usual change of speed from frame to frame [m/s] above which the speed between is not to be told
)
REST_SPEED, REST_FRAMES = 0.02, 5  # a scene whose points moved slower [m/s] for the last frames goes on as it ends


@dataclass(frozen=True)
class MotionClip:
    """A batch of short motions."""

    world: InitialConditions  # at rest, as of the first frame of the whole motion
    rest: Any  # what the model computes of it once and for all
    points: Float[Tensor, "b o n 3"]  # where they start [m]
    speed: Float[Tensor, "b o n 3"]  # [m/s]
    truth: Float[Tensor, "b t o n 3"]  # the frames after the start [m]
    spread: Float[Tensor, "b o 3"]  # of the points of an object about their mean in time, in the whole motion [m]


def motions_folder(folder: Path) -> Path:
    """Where the motions of a data set lie: in the folder `motions`, or right there."""
    inner = Path(folder) / "motions"
    return inner if inner.is_dir() else Path(folder)


def read_groups(folder: Path, names: Sequence[str], keypoints: int) -> KeypointMotions:
    """Scenes of NAME.h5 in a folder, with the first `keypoints` of each object. Raises InputError for missing files."""
    folder = motions_folder(folder)
    missing = [f"{name}.h5" for name in names if not (folder / f"{name}.h5").is_file()]
    if missing:
        raise InputError(f"{folder}: there is no {', '.join(missing)}; make the groups with `ngff-lab dataset`, or "
                         "name those that are there")  # fmt: skip
    parts = []
    for name in names:
        part = read_motions(folder / f"{name}.h5")
        if part.points.shape[3] < keypoints:
            raise InputError(f"{folder / name}.h5: has {part.points.shape[3]} keypoints an object; ask for at most so "
                             f"many, not {keypoints}")  # fmt: skip
        parts.append(replace(part, points=part.points[:, :, :, :keypoints].clone()))
    odd = next((n for n, p in zip(names, parts, strict=True) if p.points.shape[1] != parts[0].points.shape[1]), None)
    if odd:
        raise InputError(f"{folder / odd}.h5: has another number of frames than {names[0]}.h5; use groups of one kind")
    return concatenate_motions(parts)


def train_validation_split(motions: KeypointMotions, unseen: int) -> tuple[KeypointMotions, KeypointMotions]:
    """Scenes to learn from, and the last ones to choose by."""
    count = max(1, min(unseen, len(motions) // 3))
    if len(motions) < 2:
        raise InputError("two scenes are the least that can be trained on: one to learn from, one to choose by")
    return motions[: len(motions) - count], motions[len(motions) - count :]


def describe_groups(folder: Path, names: Sequence[str]) -> list[dict]:
    """What the card of weights says about each file they were trained on."""
    files = []
    for name in names:
        path = motions_folder(folder) / f"{name}.h5"
        with h5py.File(path, "r") as file:
            made = json.loads(file.attrs.get("provenance", "{}"))
        files.append({"name": path.name, "sha256": sha256(path), "made": made})
    return files


class ClipSampler:
    """Random pieces of scenes that lie in the memory of a device.

    They begin where speeds are known: not amid an impact, where central differences are far from them. Scenes that
    have come to rest are known for longer than they were simulated: they stay as they are.
    """

    def __init__(self, motions: KeypointMotions, device: torch.device | str, model: Dynamics):
        self.motions = motions.to(device)
        self.world = self.motions.initial_conditions()
        self.rest = model.precompute(self.world)
        self.asleep = ends_at_rest(self.motions)
        self.calm = smooth_frames(self.motions).cumsum(1)
        self.spread = motion_spread(self.motions)

    def draw(self, count: int, horizon: int, generator: torch.Generator, part: slice = slice(None)) -> MotionClip:
        """`count` random scenes from random frames on, for `horizon` frames after the first; a part of them."""
        points = self.motions.points
        frames = points.shape[1]
        row = torch.randint(len(points), (count,), generator=generator)
        starts = self.calm[row, torch.where(self.asleep[row], frames, frames - horizon) - 1]
        which = (torch.rand(count, generator=generator, dtype=torch.float64) * starts).long()
        start = torch.searchsorted(self.calm[row], which[:, None], right=True)[:, 0]
        return self.take(row[part].to(points.device), start[part].to(points.device), horizon)

    def take(self, row: Tensor, start: Tensor, horizon: int) -> MotionClip:
        """Those scenes from those frames on; speeds are central differences, and 0 at frame 0, where all rest."""
        points, dt = self.motions.points, self.motions.dt
        frames = start[:, None] + torch.arange(1, horizon + 1, device=start.device)
        truth = points[row[:, None], frames.clamp_max(points.shape[1] - 1)]
        speed = (truth[:, 0] - points[row, (start - 1).clamp_min(0)]) / (2 * dt)
        speed = torch.where((start > 0)[:, None, None, None], speed, 0.0)
        return MotionClip(self.world[row], self.rest[row], points[row, start], speed, truth, self.spread[row])


def ends_at_rest(motions: KeypointMotions) -> Bool[Tensor, "b"]:
    """Scenes that have come to rest at their end; on the CPU."""
    last = motions.points[:, -REST_FRAMES - 1 :]
    speed = (last[:, 1:] - last[:, :-1]).norm(dim=-1).mean(1) / motions.dt
    return (speed.flatten(1).amax(1) < REST_SPEED).cpu()


def motion_spread(motions: KeypointMotions) -> Float[Tensor, "b o 3"]:
    """How far the points of each object are from their mean in time, as a root of mean squares along each axis [m]."""
    return torch.stack([x.var(0, correction=0).mean(1).sqrt() for x in motions.points])


def smooth_frames(motions: KeypointMotions) -> Bool[Tensor, "b t"]:
    """Frames in which no object is changing its speed abruptly; on the CPU."""
    inner = torch.stack([smooth_motion(x, motions.dt).all(-1) for x in motions.points]).cpu()
    ends = torch.ones(len(inner), 1, dtype=torch.bool)
    return torch.cat([ends, inner, ends], 1)


def smooth_motion(points: Float[Tensor, "*b t o n 3"], dt: float) -> Bool[Tensor, "*b t-2 o"]:
    """In which frames, the ends left out, central differences are about the speed an object has."""
    before, now, after = points[..., :-2, :, :, :], points[..., 1:-1, :, :, :], points[..., 2:, :, :, :]
    return (after - 2 * now + before).square().sum(-1).mean(-1) < (MAX_SPEED_CHANGE * dt) ** 2
