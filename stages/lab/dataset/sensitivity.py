"""Sensitivity to initial conditions: errors between two runs of the same scenes with slightly displaced objects.

A model that knows the initial conditions only to this precision cannot be expected to do better, so the result is a
lower bound on its error. `ngff-lab bench dynamics` evaluates models on the same splits with the same metrics.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Int
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.scene.files import replacing
from stages.evaluate.dynamics import all_metrics
from stages.lab.dataset.keypoint_motions import KeypointMotions, motions_folder, read_groups

TRAINED = tuple(f"3_{i}" for i in range(9))
SPLITS = {  # groups of scenes, and number of frames compared
    "spatial": (("3_9",), 80), "temporal": (TRAINED, 100), "4 objects": (("4",), 80), "6 objects": (("6",), 80),
}  # fmt: skip
TEMPORAL_SCENES = 300  # number of random scenes in the temporal split
SCENE_BATCH = 50  # scenes compared together
METRICS = ("RMSE", "FPE", "PCE", "R", "R_pooled")


def run(data: Path, nudged: Path, out: Path | None, keypoints: int, device: str) -> list[str]:
    """Compare two data sets on each split that both have; write JSON to `out` and return the lines of a table.

    Raises InputError if they have no group in common, or if the start positions are equal.
    """
    device, rows = pick_device(device), {}
    for split, (groups, frames) in SPLITS.items():
        names = [g for g in groups if all((motions_folder(d) / f"{g}.h5").is_file() for d in (data, nudged))]
        if not names:
            continue
        truth, other = common_scenes(read_groups(data, names, keypoints), read_groups(nudged, names, keypoints))
        if split == "temporal":
            chosen = torch.randperm(len(truth), generator=torch.Generator().manual_seed(0))[:TEMPORAL_SCENES]
            truth, other = truth[chosen], other[chosen]
        rows[split] = compare_motions(_first_frames(truth, frames).to(device), _first_frames(other, frames).to(device))
        if not rows[split]["start apart"]:
            raise InputError(f"{nudged}: its scenes of {', '.join(names)} have the same initial positions as in "
                             f"{data}; generate "
                             "it with `ngff-lab dataset --nudge 0.001`")  # fmt: skip
    if not rows:
        raise InputError(f"{nudged}: has no group of scenes in common with {data}; give a data set of the same groups")
    if out is not None:
        with replacing(Path(out)) as part:
            part.write_text(json.dumps({"keypoints": keypoints, "splits": rows}, indent=1) + "\n")
    heads = ["split", "scenes", "start apart [m]", *METRICS]
    lines = ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    for split, r in rows.items():
        numbers = " | ".join(f"{r[k]:.4f}" for k in METRICS)
        lines.append(f"| {split} | {r['scenes']} | {r['start apart']:.5f} | {numbers} |")
    return lines


def common_scenes(a: KeypointMotions, b: KeypointMotions) -> tuple[KeypointMotions, KeypointMotions]:
    """The scenes present in both runs, in the order of the first."""
    names_b = set(b.names)
    both = [n for n in a.names if n in names_b]
    return a[_rows(a, both)], b[_rows(b, both)]


def _rows(m: KeypointMotions, names: list[str]) -> Int[Tensor, "r"]:
    row = {n: i for i, n in enumerate(m.names)}
    return torch.tensor([row[n] for n in names], dtype=torch.int64)


def _first_frames(m: KeypointMotions, frames: int) -> KeypointMotions:
    return replace(m, points=m.points[:, :frames])


def compare_motions(truth: KeypointMotions, other: KeypointMotions) -> dict[str, float | int]:
    """Metrics of `other` as a prediction of `truth`, averaged over scenes, and the mean distance at the start [m].

    Scenes in which a metric is undefined (R without motion) are excluded from its mean.
    """
    found = []
    for first in range(0, len(truth), SCENE_BATCH):
        a, b = (m[slice(first, first + SCENE_BATCH)] for m in (truth, other))
        mask = a.present[..., None].expand(*a.present.shape, a.points.shape[3])
        found.append(all_metrics(b.points, a.points, mask))
    means = {name: float(torch.cat([f[name] for f in found]).nanmean()) for name in METRICS}
    apart = (truth.points[:, 0] - other.points[:, 0]).norm(dim=-1).mean(-1)[truth.present]
    return {"scenes": len(truth), "start apart": round(float(apart.mean()), 6),
            **{name: round(value, 6) for name, value in means.items()}}  # fmt: skip
