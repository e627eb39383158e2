"""Ablation benchmark: retrains the force field with one component removed, with equal training length and data.

RESULTS.json holds the scores on held-out scenes, RESULTS.md the table. Rows that an earlier run measured with the same
options are kept.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path

import torch

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.scene.files import replacing
from stages.lab.bench import common as bench
from stages.lab.bench.motion_options import AblationBenchOptions
from stages.lab.dataset.keypoint_motions import KeypointMotions, read_groups
from stages.lab.dataset.selection import EXTRA_GROUPS, parse_groups
from stages.lab.names import chosen_names
from stages.lab.training.ablation import ABLATIONS, Ablation
from stages.lab.training.data import VALIDATION_SCENES, ClipSampler, train_validation_split
from stages.lab.training.distributed import ProcessGroup
from stages.lab.training.options import TrainOptions
from stages.lab.training.state import TrainingState
from stages.lab.training.train import VALIDATION_FRAMES, TrainingRun, validate

METRICS = ("RMSE", "FPE", "R")
VALIDATION_CHECKS = 6  # validations per training; the best weights are scored


def run(data: Path, out: Path, options: AblationBenchOptions, only: str = "") -> Iterator[str]:
    """Train each ablation, or those named in `only` (comma-separated); yield a line for each."""
    names = chosen_names(only, ABLATIONS)
    base, device = _training(options), pick_device(options.device)
    asked = {k: v for k, v in asdict(options).items() if k != "device"}
    facts = _before(Path(out), asked) or {"options": asked, "machine": bench.machine(device), "rows": {}}
    for name in names:
        if name not in facts["rows"]:
            facts["rows"][name] = _measured(
                ABLATIONS[name], data, base, parse_groups(options.test, more=EXTRA_GROUPS), device
            )
            facts["rows"] = {k: facts["rows"][k] for k in ABLATIONS if k in facts["rows"]}
            facts["date"] = datetime.now(timezone.utc).date().isoformat()
            _write(Path(out), facts)
        yield _line(name, facts["rows"][name])


def _measured(choice: Ablation, data: Path, base: TrainOptions, test: list[str], device: str) -> dict:
    """Train one ablation and return its scores on the test groups."""
    options = choice.options(base)
    known, unseen = train_validation_split(
        read_groups(data, parse_groups(options.groups, more=EXTRA_GROUPS), options.keypoints), VALIDATION_SCENES
    )
    scenes = read_groups(data, test, options.keypoints)
    torch.manual_seed(options.seed)
    trainee = TrainingState(choice.network().to(device), options.lr, options.seed)
    with tempfile.TemporaryDirectory() as folder:
        pieces = [ClipSampler(known, device, trainee.model)]
        job = TrainingRun(
            trainee, pieces, unseen.to(device), options, ProcessGroup(device=device), Path(folder) / "weights", {}
        )
        if not job.run():
            raise InputError(
                "stopped; the rows measured so far are kept, and the same command continues with the next row"
            )
    found = validate(trainee.best_model(), scenes.to(device))
    return {"without": choice.without, **{k: float(f"{found[k]:.4g}") for k in METRICS}, "scenes": len(scenes),
            "frames": _frames(scenes), "minutes": float(f"{trainee.elapsed / 60:.3g}"),
            "parameters": sum(p.numel() for p in trainee.params)}  # fmt: skip


def _frames(scenes: KeypointMotions) -> int:
    return min(VALIDATION_FRAMES, scenes.points.shape[1])


def _before(out: Path, options: dict) -> dict | None:
    """Results of an earlier run with the same options, or None."""
    if not out.exists():
        return None
    try:
        facts = json.loads(out.read_text())
        same, _ = facts["options"] == options, facts["rows"].items()
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{out}: contains no results of `ngff-lab bench ablation` ({error!r}); name another file"
        ) from error
    if not same:
        raise InputError(f"{out}: was measured with {facts['options']}; use the same options, or name another file")
    return facts


def _write(out: Path, facts: dict) -> None:
    bench.write_json(out, facts)
    with replacing(out.with_suffix(".md")) as part:
        part.write_text("\n".join(markdown(facts)) + "\n")


def markdown(facts: dict) -> Iterator[str]:
    """The results as a Markdown page."""
    o, rows = facts["options"], facts["rows"]
    first = next(iter(rows.values()))
    yield "# Ablation of the force field"
    yield ""
    yield (
        f"`ngff-lab bench ablation`, {facts['machine']}, {facts['date']}. Each row is trained from scratch for "
        f"{o['steps']:,} steps of {o['batch']} scenes, {o['keypoints']} keypoints an object, horizons "
        f"{o['horizons']}, on {o['groups']}, and scored on {first['scenes']} scenes of {o['test']}, "
        f"{first['frames']} frames from rest. Trainings this short compare components; they do not converge."
    )
    yield ""
    yield "| without | RMSE [m] / FPE [m] / R | RMSE / RMSE of the full network |"
    yield "| --- | --- | --- |"
    for row in rows.values():
        more = f"{row['RMSE'] / rows['full']['RMSE']:.2f}" if "full" in rows else ""
        yield f"| {row['without']} | {row['RMSE']:.4f} / {row['FPE']:.3f} / {row['R']:.3f} | {more} |"


def _line(name: str, row: dict) -> str:
    return f"{name:12} RMSE {row['RMSE']:.4f}  FPE {row['FPE']:.4f}  R {row['R']:.3f}  without {row['without']}"


def _training(options: AblationBenchOptions) -> TrainOptions:
    """Training options of the full network."""
    chosen = asdict(options)
    del chosen["test"]
    return TrainOptions(**chosen, loss="axes", checks=VALIDATION_CHECKS)
