"""How fine the data set's simulation has to be: the same scenes at several resolutions, against the published one."""

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
    Discretisation,
    count_for_spacing,
    load_assets,
    particle_volumes,
    placement_extents,
)
from stages.lab.dataset.scene_configs import SceneConfig, sample_group
from stages.lab.dataset.simulation import simulate

FULL_SPACING = 1e-6  # a spacing that asks for all Gaussians
FRAMES, KEYPOINTS = 80, 512
PUBLISHED_RESOLUTION = Discretisation(0.02, FULL_SPACING, 1e-4)
COMPARED_RESOLUTIONS = (
    Discretisation(0.02, 0.009, 1e-4), Discretisation(0.02, 0.0125, 1e-4), Discretisation(0.02, 0.009, 2e-4),
    Discretisation(0.025, 0.0105, 1e-4), Discretisation(0.03, 0.0125, 1e-4),
    Discretisation(0.03, 0.0125, 2e-4), Discretisation(0.03, 0.02, 1e-4), Discretisation(0.04, 0.0165, 1e-4),
)  # fmt: skip


@dataclass(frozen=True)
class ResolutionResult:
    """One resolution against the full one."""

    dx: float
    particles: float  # a scene
    per_cell: float  # particles in an occupied cell
    substep: float
    rmse: float  # averaged over scenes [m]
    rmse_median: float
    fpe: float
    torn: float  # share of keypoints that ended farther from their neighbours than 1.5 times at rest, and 4 cells
    scenes: int
    seconds: float


def run(out: Path | None, scenes: int, device: str) -> Iterator[str]:
    """Lines of a table, and JSON of the same."""
    device = pick_device(device)
    full = load_assets(PUBLISHED_RESOLUTION, KEYPOINTS)
    configs = dict(list(sample_group("3_9", placement_extents(full)).items())[:scenes])
    truth, row = _measured(configs, full, PUBLISHED_RESOLUTION, device, None)
    rows = [row]
    moved = {name: _moved(c) for name, c in configs.items()}
    heads = {"": 22, "dx": 6, "particles": 10, "in a cell": 10, "substep": 8, "RMSE": 7, "median": 7, "FPE": 7,
             "torn": 7, "s": 6}  # fmt: skip
    yield " ".join(f"{h:>{w}}" for h, w in heads.items())
    yield _line("full resolution", rows[0])
    rows.append(_measured(moved, full, PUBLISHED_RESOLUTION, device, truth)[1])
    yield _line("start moved by 1 mm", rows[1])
    for fineness in COMPARED_RESOLUTIONS:
        things = {i: _thinned(a, fineness) for i, a in full.items()}
        rows.append(_measured(configs, things, fineness, device, truth)[1])
        yield _line("", rows[-1])
    if out is not None:
        name = torch.cuda.get_device_name() if device != "cpu" else platform.processor()
        facts = {"machine": name, "scenes": len(configs), "frames": FRAMES, "rows": [vars(r) for r in rows]}
        with replacing(out) as part:
            part.write_text(json.dumps(facts, indent=1) + "\n")


def _line(label: str, r: ResolutionResult) -> str:
    return (f"{label:>22} {r.dx:>6} {r.particles:>10.0f} {r.per_cell:>10.1f} {r.substep:>8} {r.rmse:>7.4f} "
            f"{r.rmse_median:>7.4f} {r.fpe:>7.4f} {r.torn:>7.4f} {r.seconds:>6.1f}")  # fmt: skip


def _moved(c: SceneConfig) -> SceneConfig:
    """Every object put 1 mm aside, in a direction of its own."""
    aside = np.random.default_rng(0).normal(size=(len(c.ids), 3))
    aside *= 1e-3 / np.linalg.norm(aside, axis=1, keepdims=True)
    return replace(c, translation=tuple(tuple(p) for p in (np.array(c.translation) + aside).tolist()))


def _thinned(a: Asset, fineness: Discretisation) -> Asset:
    """The asset with fewer particles; they come in an order in which any first ones are spread evenly."""
    points = a.points[: max(KEYPOINTS, count_for_spacing(a.points, fineness.spacing))]
    return replace(a, points=points, volume=particle_volumes(points, fineness.dx))


def _measured(
    configs, things, fineness: Discretisation, device: str, truth: KeypointMotions | None
) -> tuple[KeypointMotions, ResolutionResult]:
    start = time.perf_counter()
    made = concatenate_motions([m.to("cpu") for m in simulate(configs, things, fineness, FRAMES, KEYPOINTS, device)])
    seconds = time.perf_counter() - start
    count = np.mean([sum(len(things[i].points) for i in c.ids) for c in configs.values()])
    cells = np.mean([float(a.volume.sum()) for a in things.values()]) / fineness.dx**3
    per_cell = np.mean([len(a.points) for a in things.values()]) / cells
    error = fpe = np.zeros(1)
    if truth is not None:
        both = [n for n in made.names if n in truth.names]
        mine, true = (m.points[[m.names.index(n) for n in both]] for m in (made, truth))
        error = (mine - true).square().mean((1, 2, 3, 4)).sqrt().numpy()
        fpe = (mine[:, -1] - true[:, -1]).norm(dim=-1).mean((1, 2)).numpy()
    return made, ResolutionResult(fineness.dx, float(count), float(per_cell), fineness.substep, float(error.mean()),
                     float(np.median(error)), float(fpe.mean()), _torn(made, fineness), len(made), seconds)  # fmt: skip


def _torn(m: KeypointMotions, fineness: Discretisation) -> float:
    """Of the keypoints' nearest neighbours at rest, the share that is far off in the last frame."""
    first, last = m.points[:, 0].flatten(0, 1), m.points[:, -1].flatten(0, 1)
    near = torch.cdist(first, first).topk(5, largest=False)
    rest, index = near.values[..., 1:], near.indices[..., 1:]
    there = torch.gather(last[:, None].expand(-1, last.shape[1], -1, -1), 2, index[..., None].expand(*index.shape, 3))
    now = (there - last[:, :, None]).norm(dim=-1)
    return float(((now > 1.5 * rest) & (now > 4 * fineness.dx)).float().mean())
