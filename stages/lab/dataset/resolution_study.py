"""Resolution study: the same scenes simulated at several resolutions and compared with the published resolution."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from stages.core.backends import pick_device
from stages.core.scene.files import replacing
from stages.lab.dataset.keypoint_motions import KeypointMotions, concatenate_motions
from stages.lab.dataset.object_particles import (
    Asset,
    count_for_spacing,
    load_assets,
    particle_volumes,
    placement_extents,
)
from stages.lab.dataset.options import Discretisation
from stages.lab.dataset.scene_configs import perturbed, sample_group
from stages.lab.dataset.simulation import SimulationSettings, simulate

FULL_SPACING = 1e-6  # particle spacing at which all Gaussians are used [m]
FRAMES, KEYPOINTS = 80, 512  # frames of each scene, and keypoints of each object
PUBLISHED_RESOLUTION = Discretisation(0.02, FULL_SPACING, 1e-4)
COMPARED_RESOLUTIONS = (
    Discretisation(0.02, 0.009, 1e-4), Discretisation(0.02, 0.0125, 1e-4), Discretisation(0.02, 0.009, 2e-4),
    Discretisation(0.025, 0.0105, 1e-4), Discretisation(0.03, 0.0125, 1e-4),
    Discretisation(0.03, 0.0125, 2e-4), Discretisation(0.03, 0.02, 1e-4), Discretisation(0.04, 0.0165, 1e-4),
)  # fmt: skip


@dataclass(frozen=True)
class ResolutionResult:
    """Errors of one resolution relative to the published resolution with all particles."""

    dx: float  # grid spacing [m]
    particles: float  # mean per scene
    per_cell: float  # mean number of particles per occupied cell
    substep: float  # substep of the simulation [s]
    rmse: float  # mean over scenes [m]
    rmse_median: float  # median over scenes [m]
    fpe: float  # final position error, mean over scenes [m]
    torn: float  # fraction of neighbouring keypoint pairs that end more than 1.5 rest distances and 4 cells apart
    scenes: int  # number of successful simulations
    seconds: float


def run(out: Path | None, scenes: int, device: str) -> Iterator[str]:
    """Simulate the first `scenes` of group 3_9 at all resolutions; yield the lines of a table, write JSON to `out`."""
    device = pick_device(device)
    full = load_assets(PUBLISHED_RESOLUTION, KEYPOINTS)
    configs = dict(list(sample_group("3_9", placement_extents(full)).items())[:scenes])
    truth, row = _measure(configs, full, PUBLISHED_RESOLUTION, device, None)
    rows = [row]
    heads = {"": 22, "dx": 6, "particles": 10, "in a cell": 10, "substep": 8, "RMSE": 7, "median": 7, "FPE": 7,
             "torn": 7, "s": 6}  # fmt: skip
    yield " ".join(f"{h:>{w}}" for h, w in heads.items())
    yield _table_row("full resolution", rows[0])
    rows.append(_measure(perturbed(configs, 1e-3), full, PUBLISHED_RESOLUTION, device, truth)[1])
    yield _table_row("start moved by 1 mm", rows[1])
    for discretisation in COMPARED_RESOLUTIONS:
        assets = {i: _subsampled(a, discretisation) for i, a in full.items()}
        rows.append(_measure(configs, assets, discretisation, device, truth)[1])
        yield _table_row("", rows[-1])
    if out is not None:
        name = torch.cuda.get_device_name() if device != "cpu" else platform.processor()
        facts = {"machine": name, "scenes": len(configs), "frames": FRAMES, "rows": [vars(r) for r in rows]}
        with replacing(out) as part:
            part.write_text(json.dumps(facts, indent=1) + "\n")


def _table_row(label: str, r: ResolutionResult) -> str:
    return (f"{label:>22} {r.dx:>6} {r.particles:>10.0f} {r.per_cell:>10.1f} {r.substep:>8} {r.rmse:>7.4f} "
            f"{r.rmse_median:>7.4f} {r.fpe:>7.4f} {r.torn:>7.4f} {r.seconds:>6.1f}")  # fmt: skip


def _subsampled(a: Asset, discretisation: Discretisation) -> Asset:
    """The asset with only its first particles, which are well distributed because of the farthest-point order."""
    points = a.points[: max(KEYPOINTS, count_for_spacing(a.points, discretisation.spacing))]
    return replace(a, points=points, volume=particle_volumes(points, discretisation.dx))


def _measure(
    configs, assets, discretisation: Discretisation, device: str, truth: KeypointMotions | None
) -> tuple[KeypointMotions, ResolutionResult]:
    settings, start = SimulationSettings(discretisation, FRAMES, KEYPOINTS, device), time.perf_counter()
    made = concatenate_motions([m.to("cpu") for m in simulate(configs, assets, settings)])
    seconds = time.perf_counter() - start
    count = np.mean([sum(len(assets[i].points) for i in c.ids) for c in configs.values()])
    cells = np.mean([float(a.volume.sum()) for a in assets.values()]) / discretisation.dx**3
    per_cell = np.mean([len(a.points) for a in assets.values()]) / cells
    error = fpe = np.zeros(1)
    if truth is not None:
        both = [n for n in made.names if n in truth.names]
        mine, true = (m.points[[m.names.index(n) for n in both]] for m in (made, truth))
        error = (mine - true).square().mean((1, 2, 3, 4)).sqrt().numpy()
        fpe = (mine[:, -1] - true[:, -1]).norm(dim=-1).mean((1, 2)).numpy()
    return made, ResolutionResult(
        dx=discretisation.dx, particles=float(count), per_cell=float(per_cell), substep=discretisation.substep,
        rmse=float(error.mean()), rmse_median=float(np.median(error)), fpe=float(fpe.mean()),
        torn=_torn_fraction(made, discretisation), scenes=len(made), seconds=seconds,
    )  # fmt: skip


def _torn_fraction(m: KeypointMotions, discretisation: Discretisation) -> float:
    """Fraction of pairs of keypoints that are neighbours at rest but far apart in the last frame."""
    first, last = m.points[:, 0].flatten(0, 1), m.points[:, -1].flatten(0, 1)
    near = torch.cdist(first, first).topk(5, largest=False)
    rest, index = near.values[..., 1:], near.indices[..., 1:]
    neighbour = torch.gather(
        last[:, None].expand(-1, last.shape[1], -1, -1), 2, index[..., None].expand(*index.shape, 3)
    )
    now = (neighbour - last[:, :, None]).norm(dim=-1)
    return float(((now > 1.5 * rest) & (now > 4 * discretisation.dx)).float().mean())
