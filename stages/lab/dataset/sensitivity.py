"""How predictable the data set's world is: errors between two runs whose objects start a little aside.

No model that is told the start to this precision can be expected to do better, so this is the floor under all of
them: `ngff-lab bench dynamics` measures models on the same splits by the same metrics.
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
from stages.lab.dataset.keypoint_motions import KeypointMotions
from stages.lab.dataset.scene_configs import parse_groups
from stages.lab.training.data import motions_folder, read_groups

SPLITS = {"spatial": ("3_9", 80), "temporal": ("3_0..3_8", 100), "4 objects": ("4", 80), "6 objects": ("6", 80)}
TEMPORAL_SCENES = 300  # scenes of the temporal split
SCENE_BATCH = 50  # scenes
METRICS = ("RMSE", "FPE", "PCE", "R", "R_pooled")


def run(data: Path, nudged: Path, out: Path | None, keypoints: int, device: str) -> list[str]:
    """RMSE, FPE, PCE and R of each split that both have, as JSON and as lines of a table."""
    device, rows = pick_device(device), {}
    for split, (groups, frames) in SPLITS.items():
        names = [
            g for g in parse_groups(groups) if all((motions_folder(d) / f"{g}.h5").is_file() for d in (data, nudged))
        ]
        if not names:
            continue
        truth, other = common_scenes(read_groups(data, names, keypoints), read_groups(nudged, names, keypoints))
        if split == "temporal":
            some = torch.randperm(len(truth), generator=torch.Generator().manual_seed(0))[:TEMPORAL_SCENES]
            truth, other = truth[some], other[some]
        rows[split] = compare_motions(_cut(truth, frames).to(device), _cut(other, frames).to(device))
        if not rows[split]["start apart"]:
            raise InputError(f"{nudged}: its scenes of {', '.join(names)} start where those of {data} do; make it with "
                             "`ngff-lab dataset --nudge 0.001`")  # fmt: skip
    if not rows:
        raise InputError(f"{nudged}: has no group of scenes that {data} has too")
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
    """The scenes that ended well in both, in one order."""
    both = [n for n in a.names if n in set(b.names)]
    return a[_places(a, both)], b[_places(b, both)]


def _places(m: KeypointMotions, names: list[str]) -> Int[Tensor, "r"]:
    at = {n: i for i, n in enumerate(m.names)}
    return torch.tensor([at[n] for n in names], dtype=torch.int64)


def _cut(m: KeypointMotions, frames: int) -> KeypointMotions:
    return replace(m, points=m.points[:, :frames])


def compare_motions(truth: KeypointMotions, other: KeypointMotions) -> dict[str, float | int]:
    """Metrics of one run as a prediction of the other, averaged over scenes."""
    found = []
    for first in range(0, len(truth), SCENE_BATCH):
        a, b = (m[slice(first, first + SCENE_BATCH)] for m in (truth, other))
        mask = a.present[..., None].expand(*a.present.shape, a.points.shape[3])
        found.append(all_metrics(b.points, a.points, mask))
    means = {name: float(torch.cat([f[name] for f in found]).nanmean()) for name in METRICS}  # R: where nothing moves
    apart = (truth.points[:, 0] - other.points[:, 0]).norm(dim=-1).mean(-1)[truth.present]
    return {"scenes": len(truth), "start apart": round(float(apart.mean()), 6),
            **{name: round(value, 6) for name, value in means.items()}}  # fmt: skip
