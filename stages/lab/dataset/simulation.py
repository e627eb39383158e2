"""Simulation of the scenes of the data set in batches, with the published physics.

Bodies are fixed corotated with transfer damping 0.9; walls keep 0.9 of the tangential speed per substep of 1e-4 s;
gravity is 5 m/s^2; frames last 0.02 s. Particles are Gaussians on the surface, so bodies are hollow, except in the
group `solid`. Source: public code of NGFF. For other substeps, damping is scaled to the same rate per second.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.models.initial_conditions import BOX, GRAVITY
from stages.core.physics.mpm import solver as mpm
from stages.core.physics.mpm.batch import Batch
from stages.lab.dataset.keypoint_motions import KeypointMotions
from stages.lab.dataset.object_particles import FRICTION, POISSON_RATIO, Asset, translated
from stages.lab.dataset.options import FRAME_INTERVAL, SUBSTEP, Discretisation
from stages.lab.dataset.scene_configs import SceneConfig

log = logging.getLogger(__name__)
TRANSFER_DAMPING = 0.9  # damping of the particle-grid transfer, per published substep
WALL_RETENTION = 0.9  # fraction of the tangential speed kept at walls, per published substep
# Largest Courant number at which the given substep is kept, that of the bowl at the published substep; shells gain
# energy from 0.7.
MAX_COURANT = 0.68
MAX_FALL_SPEED = math.sqrt(-2 * GRAVITY[2] * (BOX[1][2] - BOX[0][2]))  # speed after a fall from ceiling to floor [m/s]
CPU_BATCH_SCENES = 4  # scenes per batch on a CPU
GPU_BATCH_PARTICLES = 1_500_000  # particles per batch on a GPU: enough to occupy it; more would only use memory


@dataclass(frozen=True)
class SimulationSettings:
    """All inputs of a simulation other than scenes and objects."""

    discretisation: Discretisation
    frames: int
    keypoints: int  # per object
    device: str
    exact: bool = False  # bitwise reproducible on a GPU, at about twice the time


def stable_substep(discretisation: Discretisation, materials: Iterable[tuple[float, float]]) -> float:
    """The substep of `discretisation`, or one from the CFL condition if it is too long for a material [s].

    `materials` holds Young's modulus [Pa] and density [kg/m^3] of each object; the fastest pressure wave decides. All
    scenes of a group have the same substep, so that a scene does not depend on the others in its batch.
    """
    E, density = max(materials, key=lambda m: m[0] / m[1])
    speed = mpm.wave_speed(E, POISSON_RATIO, density) + MAX_FALL_SPEED
    if discretisation.substep * speed <= MAX_COURANT * discretisation.dx:
        return discretisation.substep
    stable = FRAME_INTERVAL / math.ceil(FRAME_INTERVAL * mpm.substep_rate(discretisation.dx, speed))
    log.info("a substep of %.3g s is too long for E %.3g Pa at %.4g kg/m^3; %.3g s is used instead",
             discretisation.substep, E, density, stable)  # fmt: skip
    return stable


def simulate(
    configs: Mapping[str, SceneConfig], assets: Mapping[int, Asset], settings: SimulationSettings
) -> Iterator[KeypointMotions]:
    """Keypoint trajectories of all scenes, one batch at a time, on the device.

    Scenes whose simulation fails are logged and left out.
    """
    device, frames = settings.device, settings.frames
    max_objects = max(len(c.ids) for c in configs.values())
    for scenes, batch in simulation_batches(configs, assets, settings):
        rows = _keypoint_rows(scenes, assets, settings.keypoints, max_objects).to(device)
        points = torch.empty(frames, *rows.shape, 3, device=device)
        for t, frame in enumerate(batch.frames(frames, FRAME_INTERVAL, settings.discretisation.substeps, GRAVITY)):
            torch.index_select(frame.x, 0, rows.flatten(), out=points[t].view(-1, 3))
        valid = valid_scenes(scenes, batch)
        index = torch.tensor(valid, dtype=torch.int64, device=device)
        yield _to_motions([scenes[k] for k in valid], assets, points[:, index], max_objects)


def simulation_batches(
    configs: Mapping[str, SceneConfig], assets: Mapping[int, Asset], settings: SimulationSettings,
    max_particles: int = GPU_BATCH_PARTICLES,
) -> Iterator[tuple[list[SceneConfig], Batch]]:  # fmt: skip
    """Batches of scenes at rest, of about equal size, with at most about `max_particles` particles on a GPU."""
    dx, device = settings.discretisation.dx, settings.device
    low, high = BOX
    length = settings.discretisation.substep / SUBSTEP
    box = mpm.Box(low, high, tangential_retention=WALL_RETENTION**length)
    # Strain rates decay by diffusion between particles, at a rate proportional to damping / substep (measured).
    damping = min(TRANSFER_DAMPING * length, 1.0)
    options = mpm.SolverOptions(damping=damping, schedule="exact" if settings.exact else "auto")
    todo = list(configs.values())
    largest = max(sum(len(assets[i].points) for i in c.ids) for c in todo)
    count = math.ceil(len(todo) / _max_batch_scenes(box, largest, settings, max_particles))
    bodies = {i: a.particles(device) for i, a in assets.items()}
    for n in range(count):
        scenes = todo[len(todo) * n // count : len(todo) * (n + 1) // count]
        particles = {
            c.name: mpm.join_particles([translated(bodies[i], p) for i, p in zip(c.ids, c.translation, strict=True)])
            for c in scenes
        }
        yield scenes, Batch(particles, box, dx, device, options)


def _max_batch_scenes(box: mpm.Box, particles: int, settings: SimulationSettings, max_particles: int) -> int:
    """Scenes per batch, if each has `particles` particles: enough to occupy the device, limited by its memory."""
    device = settings.device
    if device == "cpu":
        return CPU_BATCH_SCENES
    torch.cuda.empty_cache()  # so that memory cached by an earlier batch counts as free
    fitting = Batch.fits(box, settings.discretisation.dx, particles, device, settings.exact)
    return min(fitting, math.ceil(max_particles / particles))


def valid_scenes(scenes: Sequence[SceneConfig], batch: Batch) -> list[int]:
    """Indices of the scenes whose simulation succeeded; the others are logged. Waits for the device."""
    failures = batch.failures()
    for name, problem in failures.items():
        log.warning("%s: %s; the scene is left out", name, problem)
    return [k for k, c in enumerate(scenes) if c.name not in failures]


def _keypoint_rows(
    scenes: Sequence[SceneConfig], assets: Mapping[int, Asset], keypoints: int, max_objects: int
) -> Int[Tensor, "s o n"]:
    """Row of every keypoint among the particles of the batch; missing objects repeat the rows of the first object."""
    start, out = 0, []
    for c in scenes:
        rows = []
        for i in c.ids:
            rows.append(torch.arange(start, start + keypoints))
            start += len(assets[i].points)
        out.append(torch.stack(rows + [rows[0]] * (max_objects - len(rows))))
    return torch.stack(out)


def _to_motions(
    scenes: Sequence[SceneConfig], assets: Mapping[int, Asset], points: Float[Tensor, "t s o n 3"], max_objects: int
) -> KeypointMotions:
    ids = [[*c.ids, *[-1] * (max_objects - len(c.ids))] for c in scenes]
    properties = {i: (a.mass, a.E, a.solidity) for i, a in assets.items()}
    rows = [[properties.get(i, (1.0, 1.0, 1.0)) for i in row] for row in ids]
    mass, E, solidity = torch.tensor(rows, device=points.device).reshape(-1, max_objects, 3).unbind(-1)
    objects = torch.tensor(ids, dtype=torch.int64, device=points.device).reshape(-1, max_objects)
    ones = torch.ones_like(mass)
    points = torch.where((objects >= 0)[:, None, :, None, None], points.transpose(0, 1), 0.0)
    return KeypointMotions(
        names=tuple(c.name for c in scenes), objects=objects, points=points, mass=mass, E=E, nu=POISSON_RATIO * ones,
        friction=FRICTION * ones, dt=FRAME_INTERVAL, gravity=GRAVITY, box=BOX, solidity=solidity,
    )  # fmt: skip
