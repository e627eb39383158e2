"""Scenes of the data set through time, many at once: physics as published.

Fixed corotated bodies, transfer damping 0.9, walls that keep 0.9 of the tangential speed every substep of 1e-4 s,
gravity 5 m/s^2, frames of 0.02 s; Gaussians of the surface are the particles, and bodies are hollow, but for those
of the group `solid`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.physics.mpm import solver as mpm
from stages.core.physics.mpm.batch import Batch
from stages.lab.dataset.keypoint_motions import KeypointMotions
from stages.lab.dataset.object_particles import (
    FRAME_INTERVAL,
    FRICTION,
    POISSON_RATIO,
    SUBSTEP,
    Asset,
    Discretisation,
    translated,
)
from stages.lab.dataset.scene_configs import SceneConfig

log = logging.getLogger(__name__)
GRAVITY = (0.0, 0.0, -5.0)  # [m/s^2]
WALL_BOX = ((-1.94, -1.94, -0.94), (1.94, 1.94, 2.94))  # [m]
DAMPING, WALL_FRICTION = 0.9, 0.9  # of the transfer; of the tangential speed at walls, every published substep
CPU_BATCH_SCENES = 4  # a batch
GPU_BATCH_PARTICLES = 1_500_000  # particles that keep a GPU busy; more only take memory


def simulate(
    configs: Mapping[str, SceneConfig], things: Mapping[int, Asset], fineness: Discretisation, frames: int,
    keypoints: int, device: str, exact: bool = False,
) -> Iterator[KeypointMotions]:  # fmt: skip
    """The motion of all scenes, a batch at a time, on the device; scenes that went wrong are told of and left out."""
    most = max(len(c.ids) for c in configs.values())
    for scenes, batch in simulation_batches(configs, things, fineness, device, exact):
        rows = _rows(scenes, things, keypoints, most).to(device)
        points = torch.empty(frames, *rows.shape, 3, device=device)
        for t, frame in enumerate(batch.frames(frames, FRAME_INTERVAL, fineness.substeps, GRAVITY)):
            torch.index_select(frame.x, 0, rows.flatten(), out=points[t].view(-1, 3))
        good = valid_scenes(scenes, batch)
        rows = torch.tensor(good, dtype=torch.int64, device=device)
        yield _motions([scenes[k] for k in good], things, points[:, rows], most)


def simulation_batches(
    configs: Mapping[str, SceneConfig], things: Mapping[int, Asset], fineness: Discretisation, device: str,
    exact: bool = False, rows: int = GPU_BATCH_PARTICLES,
) -> Iterator[tuple[list[SceneConfig], Batch]]:  # fmt: skip
    """All scenes at their start, in batches of about equal size, with about so many particles on a GPU."""
    low, high = WALL_BOX
    box = mpm.Box(low, high, tangential_retention=WALL_FRICTION ** (fineness.substep / SUBSTEP))
    todo = list(configs.values())
    largest = max(sum(len(things[i].points) for i in c.ids) for c in todo)
    parts = math.ceil(len(todo) / _most(box, fineness.dx, largest, device, exact, rows))
    resting = {i: a.particles(device) for i, a in things.items()}
    for part in range(parts):
        scenes = todo[len(todo) * part // parts : len(todo) * (part + 1) // parts]
        bodies = {
            c.name: mpm.join_particles([translated(resting[i], p) for i, p in zip(c.ids, c.translation, strict=True)])
            for c in scenes
        }
        yield scenes, Batch(bodies, box, fineness.dx, device, damping=DAMPING, exact=exact)


def _most(box: mpm.Box, dx: float, particles: int, device: str, exact: bool, rows: int) -> int:
    """Scenes in a batch: as many as keep the device busy, if they fit."""
    if device == "cpu":
        return CPU_BATCH_SCENES
    torch.cuda.empty_cache()  # what an earlier batch left counts as free
    return min(Batch.fits(box, dx, particles, device, exact), math.ceil(rows / particles))


def valid_scenes(scenes: Sequence[SceneConfig], batch: Batch) -> list[int]:
    """Places of the scenes that ended well; the others are told of. Waits for the device."""
    bad = batch.failures()
    for name, problem in bad.items():
        log.warning("%s: %s; left out", name, problem)
    return [k for k, c in enumerate(scenes) if c.name not in bad]


def _rows(
    scenes: Sequence[SceneConfig], things: Mapping[int, Asset], keypoints: int, most: int
) -> Int[Tensor, "s o n"]:
    """The row of every keypoint among the particles of the batch; objects that are not there repeat the first."""
    start, out = 0, []
    for c in scenes:
        rows = []
        for i in c.ids:
            rows.append(torch.arange(start, start + keypoints))
            start += len(things[i].points)
        out.append(torch.stack(rows + [rows[0]] * (most - len(rows))))
    return torch.stack(out)


def _motions(
    scenes: Sequence[SceneConfig], things: Mapping[int, Asset], points: Float[Tensor, "t s o n 3"], most: int
) -> KeypointMotions:
    ids = torch.tensor([[*c.ids, *[-1] * (most - len(c.ids))] for c in scenes]).reshape(-1, most)
    told = {i: (a.mass, a.E, a.solidity) for i, a in things.items()}
    table = torch.tensor([[told.get(i, (1.0, 1.0, 1.0)) for i in row] for row in ids.tolist()]).reshape(-1, most, 3)
    same = torch.ones(ids.shape)
    there = (ids >= 0).to(points.device)
    points = torch.where(there[:, None, :, None, None], points.transpose(0, 1), 0.0)
    return KeypointMotions(
        names=tuple(c.name for c in scenes), objects=ids, points=points, mass=table[..., 0], E=table[..., 1],
        nu=POISSON_RATIO * same, friction=FRICTION * same, dt=FRAME_INTERVAL, gravity=GRAVITY, box=WALL_BOX,
        solidity=table[..., 2],
    )  # fmt: skip
