"""Benchmark of dynamics models on motion they were not trained on: the splits of the NGFF paper, on our data set.

    spatial            scenes of group 3_9: new arrangements of training objects, 80 frames
    temporal           300 scenes of the training groups, 100 frames
    4, 6 objects       more objects than the 3 of most training scenes, 80 frames
    held-out objects   scenes of objects that no model was trained on (`ngff-lab heldout`), 80 frames

The baselines need no training: free fall, the true scenes simulated again from starts moved by 1 mm (a bound set by
predictability), the best rigid fit to the truth, and MPM with materials estimated by a vision-language model.
RESULTS.json holds all results; RESULTS.md and RESULTS.png are made from it.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import torch
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.models import checkpoints
from stages.core.models.dynamics import Dynamics
from stages.core.models.rollout import TimeStepper, record_frames
from stages.core.scene.files import must_exist
from stages.evaluate.dynamics import all_metrics, error_over_time
from stages.lab.assets.heldout_shapes import HELDOUT_SHAPES
from stages.lab.assets.objects import OBJECTS
from stages.lab.bench import common as bench
from stages.lab.bench.dynamics_baselines import (
    Predict,
    Resimulation,
    predict_free_fall,
    predict_from,
    predict_rigid_fit,
    shared_scenes,
)
from stages.lab.bench.dynamics_report import PUBLISHED, report, table
from stages.lab.bench.motion_options import DynamicsBenchOptions
from stages.lab.dataset import sensitivity
from stages.lab.dataset.keypoint_motions import KeypointMotions, motions_folder, read_groups
from stages.lab.training.history import total_minutes

log = logging.getLogger(__name__)
SPLITS = {**sensitivity.SPLITS, "held-out objects": (("heldout",), 80)}
TIMED_STEPS = 100  # steps of the timed rollout
STRIDE = 8  # frames between the values of the error curve of an object
COMPARABLE_KEYS = ("machine", "keypoints", "scenes", "frames")  # results in one table must agree in these values
METRICS = ("MSE", "RMSE", "FPE", "PCE", "R", "R_pooled")
FREE_FALL, NUDGED, RIGID_FIT, MPM_ESTIMATED = (
    "no learning",
    "truth, starts moved 1 mm",
    "truth, best rigid fit",
    "mpm-estimated",
)
NAMES = {kind.id: name for name, kind in (*OBJECTS.items(), *HELDOUT_SHAPES.items())}


def redraw(results: Path) -> list[str]:
    """Write table and plots again from the results of an earlier run; return the lines of the table.

    Raises InputError if the file has no such results.
    """
    must_exist(results, "results of `ngff-lab bench dynamics` (.json)")
    try:
        facts = json.loads(Path(results).read_text())
        report(Path(results), facts)
        return table(facts)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{results}: contains no results of `ngff-lab bench dynamics` ({error!r}); name another file"
        ) from error


def run(
    data: Path,
    folder: Path,
    out: Path,
    options: DynamicsBenchOptions,
    nudged: Path | None = None,
) -> list[str]:
    """Evaluate every NAME.safetensors of a folder, and the untrained baselines, on every split of a data set.

    `nudged` is a second data set of the same scenes, with every start moved by 1 mm. Writes OUT.json, OUT.md
    and OUT.png; returns the lines of the table. Other rows of an earlier OUT.json are kept if it was measured on the
    same machine and scenes.
    """
    files = sorted(Path(folder).glob("*.safetensors"), key=lambda f: (f.stem == "ngff", f.stem))  # our model last
    if not files:
        raise InputError(f"{folder}: contains no weights (.safetensors); train some with `ngff-lab train`")
    before = _earlier(Path(out))
    device = pick_device(options.device)
    splits = {name: split_scenes(data, name, options).to(device) for name in SPLITS if _groups_exist(data, name)}
    if not splits:
        split_scenes(data, "spatial", options)  # raises InputError that names the missing files
    rows = {
        FREE_FALL: {
            "splits": {name: evaluate_predictor(predict_free_fall, m, options.batch) for name, m in splits.items()}
        }
    }
    if nudged is not None:
        rows[NUDGED] = {"splits": dict(_nudged_metrics(nudged, splits, options))}
    rows[RIGID_FIT] = {
        "splits": {name: evaluate_predictor(predict_rigid_fit, m, options.batch) for name, m in splits.items()}
    }
    if options.mpm:
        rows[MPM_ESTIMATED] = _mpm(data, splits, options, device)
    for file in tqdm(files, desc="models", unit="model"):
        rows[file.stem] = _model(file, splits, options, device)
        log.info("%s: RMSE %s", file.stem, ", ".join(f"{r['RMSE']} {n}" for n, r in rows[file.stem]["splits"].items()))
    facts = {
        "machine": bench.machine(device), "date": datetime.now(timezone.utc).date().isoformat(),
        "keypoints": options.keypoints, "scenes": {n: len(m) for n, m in splits.items()},
        "frames": {n: m.points.shape[1] for n, m in splits.items()}, "frames between values by object": STRIDE,
        "rows": rows,
        "published, on other data": PUBLISHED,
    }  # fmt: skip
    if all(before.get(key) == facts[key] for key in COMPARABLE_KEYS):
        facts["rows"] = {**before["rows"], **rows}
    bench.write_json(out, facts)
    report(Path(out), facts)
    return table(facts)


def _earlier(out: Path) -> dict:
    """Results of an earlier run; empty if there is none."""
    if not out.is_file():
        return {}
    try:
        before = json.loads(out.read_text())
        return {key: before[key] for key in ("rows", *COMPARABLE_KEYS)}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{out}: contains no results of `ngff-lab bench dynamics` ({error!r}); name another file"
        ) from error


def _groups_exist(data: Path, split: str) -> bool:
    """Whether all groups of a split exist; logs a warning if not."""
    missing = [g for g in SPLITS[split][0] if not (motions_folder(data) / f"{g}.h5").is_file()]
    if missing:
        log.warning("split %s is not measured, as %s has no %s", split, data, ", ".join(missing))
    return not missing


def split_scenes(data: Path, split: str, options: DynamicsBenchOptions) -> KeypointMotions:
    """The scenes of a split, truncated to its number of frames."""
    groups, frames = SPLITS[split]
    motions = read_groups(data, groups, options.keypoints)
    count = min(len(motions), options.limit or len(motions))
    if split == "temporal":
        count = min(count, sensitivity.TEMPORAL_SCENES)
        rows = torch.randperm(len(motions), generator=torch.Generator().manual_seed(options.seed))[:count]
    else:
        rows = torch.arange(count)
    return replace(motions[rows], points=motions.points[rows, :frames])


def _nudged_metrics(
    nudged: Path, splits: dict[str, KeypointMotions], options: DynamicsBenchOptions
) -> Iterator[tuple[str, dict]]:
    """Metrics of the scenes with moved starts relative to the true ones, by split."""
    for split, motions in splits.items():
        if _groups_exist(nudged, split):
            made = read_groups(nudged, SPLITS[split][0], options.keypoints)
            yield split, _compared(made, motions, options.batch)


def _compared(made: KeypointMotions, motions: KeypointMotions, batch: int) -> dict:
    """Metrics of scenes from another simulation; scenes that failed in it are counted and left out."""
    both = shared_scenes(motions, made)
    if not len(both):
        raise InputError("the two data sets have no scene of the same name; use data sets of the same scenes")
    return {**evaluate_predictor(predict_from(made, motions.points.shape[1]), both, batch), "scenes left out":
            len(motions) - len(both)}  # fmt: skip


def _mpm(data: Path, splits: dict[str, KeypointMotions], options: DynamicsBenchOptions, device: str) -> dict:
    """Metrics of MPM with estimated materials, on splits for whose objects the paper has estimates."""
    row: dict = {"splits": {}}
    for split, motions in splits.items():
        if not set(motions.objects.unique().tolist()) - {-1} <= {kind.id for kind in OBJECTS.values()}:
            continue
        again = Resimulation(data, list(SPLITS[split][0]), device)
        some = motions[: min(options.mpm, len(motions))]
        made = again(some.names, some.points.shape[1], options.keypoints)
        row["splits"][split] = _compared(made, some, options.batch)
        if device != "cpu" and "seconds" not in row:  # on a CPU this would dominate the run time
            row["seconds"] = _digits(again.seconds(some.names[0], TIMED_STEPS), 3)
    return row


def _model(file: Path, splits: dict[str, KeypointMotions], options: DynamicsBenchOptions, device: str) -> dict:
    model, card = checkpoints.load(file, device)
    learned = card.get("options", {}).get("keypoints", options.keypoints)  # use no more keypoints than in training
    splits = {n: replace(m, points=m.points[..., :learned, :]) for n, m in splits.items()}
    with torch.inference_mode():
        results = {n: evaluate_predictor(_rolled(model), m, options.batch) for n, m in splits.items()}
        seconds = _seconds(model, next(iter(splits.values())), device)
    about = {k: card[k] for k in ("model", "config", "device", "sha256") if k in card}
    minutes = total_minutes(card)
    if minutes is not None:
        about["minutes"] = _digits(minutes)
    parameters = sum(p.numel() for p in model.parameters())
    keypoints = min(learned, options.keypoints)
    return {"splits": results, "seconds": seconds, "keypoints": keypoints, "parameters": parameters, "card": about}


def _rolled(model: Dynamics) -> Predict:
    return lambda some: model.rollout(some.initial_conditions(), some.points.shape[1], some.dt)


def _seconds(model: Dynamics, motions: KeypointMotions, device: str) -> float:
    """Wall time of a rollout of TIMED_STEPS steps of one scene [s], without recording its CUDA graph."""
    one = motions[:1].initial_conditions()
    stepper = TimeStepper(model, one, motions.dt)

    def again() -> None:
        stepper.restart(one)
        record_frames(stepper, TIMED_STEPS + 1)

    again()
    return _digits(bench.median_seconds(again, device, 3), 3)


def evaluate_predictor(predict: Predict, motions: KeypointMotions, batch: int) -> dict:
    """Metrics averaged over the scenes, and error [m] by frame, for all objects and for each kind of object.

    A rollout that is not finite counts as R = 0 and makes the RMSE undefined.
    """
    metrics, errors = [], []
    for first in tqdm(range(0, len(motions), batch), unit="batch", leave=False):
        some = motions[first : first + batch]
        valid, predicted = some.initial_conditions().valid, predict(some)
        metrics.append(all_metrics(predicted, some.points, valid))
        errors.append(error_over_time(predicted, some.points, valid))
    each = {k: torch.cat([m[k] for m in metrics]) for k in METRICS}
    lost = ~each["RMSE"].isfinite()
    correlated = {k: torch.where(lost, 0.0, each[k]).nanmean() for k in ("R", "R_pooled")}  # nan where nothing moves
    error, kind, present = torch.cat(errors), motions.objects, motions.present
    by_frame = error.transpose(0, 1)[:, present].mean(1)
    by_object = {NAMES.get(int(i), f"object {int(i)}"): error[:, ::STRIDE].transpose(0, 1)[:, kind == i].mean(1)
                 for i in kind[present].unique()}  # fmt: skip
    return {
        **{k: _digits(float(correlated.get(k, each[k].mean()))) for k in METRICS}, "scenes not finite": int(lost.sum()),
        "error by frame": [_digits(e, 3) for e in by_frame.tolist()],
        "error by object": {name: [_digits(e, 3) for e in curve.tolist()] for name, curve in by_object.items()},
    }  # fmt: skip


def _digits(x: float, count: int = 4) -> float | None:
    """Rounded to significant digits; None for non-finite values, which JSON cannot represent."""
    return float(f"{x:.{count}g}") if abs(x) < float("inf") else None
