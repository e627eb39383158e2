"""Training data: groups of simulated motions, their split into training and validation, and random clips of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.models.dynamics import Dynamics
from stages.core.models.initial_conditions import InitialConditions
from stages.core.scene.files import sha256
from stages.lab.dataset.keypoint_motions import KeypointMotions, motions_folder

VALIDATION_SCENES = 100  # number of scenes at the end of the last group, used only to select the best weights
# RMS change of velocity from frame to frame [m/s] above which an object is assumed to be in a collision, where central
# differences do not approximate its velocity
MAX_SPEED_CHANGE = 0.3
# a scene is assumed to remain at rest if it is slower [m/s] in this number of final frames
MAX_RESTING_SPEED, REST_FRAMES = 0.02, 5


@dataclass(frozen=True)
class MotionClip:
    """A batch of short motions."""

    world: InitialConditions  # initial conditions at rest, in the first frame of the whole motion
    rest: Any  # the model's precomputed features of `world` (`Dynamics.precompute`)
    points: Float[Tensor, "b o n 3"]  # keypoints at the start of the clip [m]
    speed: Float[Tensor, "b o n 3"]  # their velocities [m/s]
    truth: Float[Tensor, "b t o n 3"]  # keypoints in the frames after the start [m]
    spread: Float[Tensor, "b o 3"]  # RMS distance of an object's points from their mean over the whole motion [m]


def train_validation_split(motions: KeypointMotions, count: int) -> tuple[KeypointMotions, KeypointMotions]:
    """Training scenes, and the last `count` (at most a third) for validation. Raises InputError for a single scene."""
    count = max(1, min(count, len(motions) // 3))
    if len(motions) < 2:
        raise InputError("--data: give at least two scenes, one for training and one for validation")
    return motions[: len(motions) - count], motions[len(motions) - count :]


def describe_groups(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """First 16 digits of the sha256 of each group's file, for the card of weights."""
    return {name: sha256(motions_folder(folder) / f"{name}.h5")[:16] for name in names}


class ClipSampler:
    """Random clips of scenes that are stored in the memory of a device.

    Clips start only in frames without an impact, where central differences give the velocities. Scenes that end at rest
    are continued at rest beyond their last frame.
    """

    def __init__(self, motions: KeypointMotions, device: torch.device | str, model: Dynamics):
        self.motions = motions.to(device)
        self.world = self.motions.initial_conditions()
        self.rest = model.precompute(self.world)
        self.resting = ends_at_rest(self.motions)
        self.starts = smooth_frames(self.motions).cumsum(1)  # number of allowed start frames up to each frame
        self.spread = motion_spread(self.motions)

    def draw(self, count: int, horizon: int, generator: torch.Generator, part: slice = slice(None)) -> MotionClip:
        """Random clips of `count` random scenes, with `horizon` frames after the start.

        `part` selects the rows of the batch to return; the random numbers do not depend on it.
        """
        points = self.motions.points
        frames = points.shape[1]
        row = torch.randint(len(points), (count,), generator=generator)
        starts = self.starts[row, torch.where(self.resting[row], frames, frames - horizon) - 1]
        which = (torch.rand(count, generator=generator, dtype=torch.float64) * starts).long()
        start = torch.searchsorted(self.starts[row], which[:, None], right=True)[:, 0]
        return self.take(row[part], start[part], horizon)

    def take(self, row: Tensor, start: Tensor, horizon: int) -> MotionClip:
        """Clips of given scenes starting in given frames; velocities are central differences, 0 in frame 0."""
        points, dt = self.motions.points, self.motions.dt
        row, start = row.to(points.device), start.to(points.device)
        frames = start[:, None] + torch.arange(1, horizon + 1, device=start.device)
        truth = points[row[:, None], frames.clamp_max(points.shape[1] - 1)]
        speed = (truth[:, 0] - points[row, (start - 1).clamp_min(0)]) / (2 * dt)
        speed = torch.where((start > 0)[:, None, None, None], speed, 0.0)
        return MotionClip(self.world[row], self.rest[row], points[row, start], speed, truth, self.spread[row])


def ends_at_rest(motions: KeypointMotions) -> Bool[Tensor, "b"]:
    """Whether each scene is at rest in its last frames; on the CPU."""
    last = motions.points[:, -REST_FRAMES - 1 :]
    speed = (last[:, 1:] - last[:, :-1]).norm(dim=-1).mean(1) / motions.dt
    return (speed.flatten(1).amax(1) < MAX_RESTING_SPEED).cpu()


def motion_spread(motions: KeypointMotions) -> Float[Tensor, "b o 3"]:
    """RMS distance of each object's points from their mean over time, along each axis [m]."""
    return torch.stack([x.var(0, correction=0).mean(1).sqrt() for x in motions.points])


def smooth_frames(motions: KeypointMotions) -> Bool[Tensor, "b t"]:
    """Frames in which no object is in a collision, including the first and last frame; on the CPU."""
    inner = torch.stack([smooth_motion(x, motions.dt).all(-1) for x in motions.points]).cpu()
    ends = torch.ones(len(inner), 1, dtype=torch.bool)
    return torch.cat([ends, inner, ends], 1)


def smooth_motion(points: Float[Tensor, "*b t o n 3"], dt: float) -> Bool[Tensor, "*b t-2 o"]:
    """For all frames but the first and last, whether central differences give an object's velocity."""
    before, now, after = points[..., :-2, :, :, :], points[..., 1:-1, :, :, :], points[..., 2:, :, :, :]
    return (after - 2 * now + before).square().sum(-1).mean(-1) < (MAX_SPEED_CHANGE * dt) ** 2
