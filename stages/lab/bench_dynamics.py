"""How well trained models predict motion they have not seen: the published table, on the regenerated data set.

    spatial         scenes of group 3_9: new arrangements of objects that were learned from, 80 frames
    temporal        300 scenes of the training groups, for 100 frames
    compositional   scenes of 4 and of 6 objects, 80 frames; learned from were scenes of 3
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.backends import pick_device
from stages.errors import InputError
from stages.evaluate.dynamics import all_metrics, error_over_time
from stages.lab import bench
from stages.lab.motions import Motions
from stages.lab.scenes import groups_of
from stages.lab.training_data import home, read_groups
from stages.models import weights
from stages.models.dynamics import Dynamics
from stages.models.world import World
from stages.scene.files import replacing

log = logging.getLogger(__name__)
SPLITS = {"spatial": ("3_9", 80), "temporal": ("3_0..3_8", 100), "4 objects": ("4", 80), "6 objects": ("6", 80)}
SAMPLE = 300  # scenes of the temporal split
TIMED = 100  # steps of one scene whose time is taken
FALL = "no learning"  # rigid free fall until the lowest point meets the floor
METRICS = ("MSE", "RMSE", "FPE", "PCE", "R", "R_pooled")
# NGFF paper (ICLR 2026), Table 1 and ablation, on its own data: (RMSE, FPE, R) by split; of the first three models only
# the mean over 4 and 6 objects is known, which stands in both places
PUBLISHED = {
    "VLM-MPM": ((0.306, 0.774, 0.299), (0.328, 0.901, 0.300), (0.358, 0.904, 0.305), (0.358, 0.904, 0.305)),
    "GCN": ((0.134, 0.479, 0.406), (0.174, 0.590, 0.400), (0.145, 0.509, 0.347), (0.145, 0.509, 0.347)),
    "Pointformer": ((0.096, 0.394, 0.623), (0.129, 0.537, 0.604), (0.162, 0.594, 0.434), (0.162, 0.594, 0.434)),
    "NGFF w/o deform.": ((0.110, 0.459, 0.595), (0.144, 0.600, 0.578), (0.1303, 0.547, 0.525), (0.1325, 0.546, 0.506)),
    "NGFF": ((0.082, 0.326, 0.661), (0.107, 0.419, 0.652), (0.0953, 0.373, 0.594), (0.1127, 0.446, 0.547)),
}


@dataclass(frozen=True)
class BenchOptions:
    """Which scenes."""

    keypoints: int = 256  # of an object
    limit: int = 0  # scenes of each split; 0: all
    batch: int = 50  # scenes at once
    seed: int = 0  # of the temporal sample
    device: str = "auto"

    def __post_init__(self):
        if self.keypoints < 1 or self.batch < 1 or self.limit < 0:
            raise InputError("--keypoints and --batch must be positive, --limit at least 0")


def run(data: Path, folder: Path, out: Path, options: BenchOptions = BenchOptions()) -> list[str]:
    """Every NAME.safetensors of a folder on every split; the results as JSON and as lines of a table."""
    files = sorted(Path(folder).glob("*.safetensors"))
    if not files:
        raise InputError(f"{folder}: holds no weights (.safetensors); make some with `ngff-lab train`")
    device = pick_device(options.device)
    splits = {name: scenes_of(data, name, options).to(device) for name in SPLITS if _there(data, name)}
    if not splits:
        scenes_of(data, "spatial", options)  # says what is missing
    rows = {FALL: {"splits": {name: measured(free_fall, m, name, options.batch) for name, m in splits.items()}}}
    for file in tqdm(files, desc="models", unit="model"):
        model, card = weights.load(file, device)
        with torch.inference_mode():
            results = {n: measured(partial(_rolled, model), m, n, options.batch) for n, m in splits.items()}
            time = _seconds(model, next(iter(splits.values())), device)
        about = {k: card[k] for k in ("model", "config", "minutes", "device", "validation", "sha256") if k in card}
        parameters = sum(p.numel() for p in model.parameters())
        rows[file.stem] = {"splits": results, f"s for {TIMED} steps": time, "parameters": parameters, "card": about}
        log.info("%s: RMSE %s", file.stem, ", ".join(f"{r['RMSE']} {n}" for n, r in results.items()))
    facts = {
        "machine": bench.machine(device), "date": datetime.now(timezone.utc).date().isoformat(),
        "keypoints": options.keypoints, "scenes": {n: len(m) for n, m in splits.items()},
        "frames": {n: frames for n, (_, frames) in SPLITS.items()}, "rows": rows,
        "published, on other data": {n: dict(zip(SPLITS, row, strict=True)) for n, row in PUBLISHED.items()},
    }  # fmt: skip
    with replacing(Path(out)) as part:
        part.write_text(json.dumps(facts, indent=1) + "\n")
    return table(rows)


def _there(data: Path, split: str) -> bool:
    """Whether all groups of a split have been made; a split that is not measured is told of."""
    missing = [g for g in groups_of(SPLITS[split][0]) if not (home(data) / f"{g}.h5").is_file()]
    if missing:
        log.warning("%s is not measured: %s has no %s", split, data, ", ".join(missing))
    return not missing


def scenes_of(data: Path, split: str, options: BenchOptions) -> Motions:
    """The scenes of a split, no longer than it is measured."""
    groups, frames = SPLITS[split]
    motions = read_groups(data, groups_of(groups), options.keypoints)
    count = min(len(motions), options.limit or len(motions))
    if split == "temporal":
        count = min(count, SAMPLE)
        rows = torch.randperm(len(motions), generator=torch.Generator().manual_seed(options.seed))[:count]
    else:
        rows = torch.arange(count)
    return replace(motions[rows], points=motions.points[rows, :frames])


def free_fall(world: World, frames: int, dt: float) -> Float[Tensor, "b t o n 3"]:
    """Objects fall as they stand until their lowest keypoint is on the floor, and lie there."""
    time = dt * torch.arange(frames, dtype=world.points.dtype, device=world.points.device)
    fallen = -world.gravity[:, None, None, 2] * time[:, None].square() / 2
    height = world.points[..., 2].masked_fill(~world.valid, torch.inf).amin(2) - world.floor[:, None]
    fallen = torch.minimum(fallen, height.clamp_min(0)[:, None])
    points = world.points[:, None].repeat(1, frames, 1, 1, 1)
    points[..., 2] -= fallen[..., None]
    return points.masked_fill(~world.valid[:, None, ..., None], 0.0)


def measured(rollout, motions: Motions, split: str, batch: int) -> dict:
    """Metrics averaged over the scenes, error over time, and error of each kind of object over all frames."""
    world, frames = motions.world(), motions.points.shape[1]
    metrics, errors = [], []
    for first in tqdm(range(0, len(motions), batch), desc=split, unit="batch", leave=False):
        some, truth = world[first : first + batch], motions.points[first : first + batch]
        predicted = rollout(some, frames, motions.dt)
        metrics.append(all_metrics(predicted, truth, some.valid))
        errors.append(error_over_time(predicted, truth, some.valid))
    each = {k: torch.cat([m[k] for m in metrics]) for k in METRICS}
    lost = ~each["RMSE"].isfinite()
    correlated = {k: torch.where(lost, 0.0, each[k]).nanmean() for k in ("R", "R_pooled")}  # none where nothing moves
    error, kind = torch.cat(errors), motions.objects
    return {
        **{k: _number(correlated.get(k, each[k].mean())) for k in METRICS}, "scenes not finite": int(lost.sum()),
        "error by frame": [_number(error[:, t][motions.present].mean(), 5) for t in range(frames)],
        "error by object id": {int(i): _number(error.mean(1)[kind == i].mean(), 5)
                               for i in kind[motions.present].unique()},
    }  # fmt: skip


def _rolled(model: Dynamics, world: World, frames: int, dt: float) -> Float[Tensor, "b t o n 3"]:
    return model.rollout(world, frames, dt)


def _seconds(model: Dynamics, motions: Motions, device: str) -> float:
    """Wall time of TIMED steps of one scene, as the command rolls it out [s]."""
    one = motions[:1].world()
    model.rollout(one, 3, motions.dt)
    return round(bench.seconds(lambda: model.rollout(one, TIMED + 1, motions.dt), device, 3), 4)


def _number(x: Tensor, digits: int = 6) -> float | None:
    """None for what is not finite: JSON knows no such numbers."""
    return round(x.item(), digits) if x.isfinite() else None


def table(rows: dict) -> list[str]:
    """RMSE / FPE / R of each model and split, ours and the published ones."""
    lines = [_line(["RMSE / FPE / R", *SPLITS, f"{TIMED} steps"])]
    for name, row in rows.items():
        cells = [_cell(*(row["splits"][split][k] for k in ("RMSE", "FPE", "R"))) if split in row["splits"] else "-"
                 for split in SPLITS]  # fmt: skip
        time = row.get(f"s for {TIMED} steps")
        lines.append(_line([name, *cells, "-" if time is None else f"{time:.3f} s"]))
    lines.append("as published, measured on other data:")
    for name, row in PUBLISHED.items():
        lines.append(_line([name, *(_cell(*values) for values in row), ""]))
    return lines


def _cell(rmse: float | None, fpe: float | None, r: float) -> str:
    return f"not finite / {r:.3f}" if rmse is None or fpe is None else f"{rmse:.4f} / {fpe:.3f} / {r:.3f}"


def _line(cells: list[str]) -> str:
    return f"{cells[0]:20}" + "".join(f"{cell:>25}" for cell in cells[1:-1]) + f"{cells[-1]:>12}"
