"""Training of a dynamics model: reads motions, writes weights and their card."""

from __future__ import annotations

import logging
import math
import shlex
import signal
import sys
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.models.checkpoints import build, load, save
from stages.core.scene.files import ngff_version
from stages.evaluate.dynamics import all_metrics
from stages.lab.dataset.keypoint_motions import KeypointMotions, read_groups
from stages.lab.dataset.selection import EXTRA_GROUPS, parse_groups
from stages.lab.training.data import VALIDATION_SCENES, ClipSampler, describe_groups, train_validation_split
from stages.lab.training.distributed import ProcessGroup, process_group
from stages.lab.training.history import curve_columns, runs_of
from stages.lab.training.options import TrainOptions
from stages.lab.training.rollout_loss import LossOptions, RolloutLoss
from stages.lab.training.state import TrainingState
from stages.lab.training.widen import widen

log = logging.getLogger(__name__)
PROGRESS_LINE = (
    "{minutes:6.1f} min {step:7d} steps  horizon {horizon:2d}  loss {loss:.4f}  "
    "RMSE {RMSE:.4f}  FPE {FPE:.4f}  R {R:.3f}"
)
SPARSE_EVERY = 4  # with --sparse-keypoints, every fourth step uses fewer keypoints
VALIDATION_FRAMES = 80  # length of the rollouts that select the weights
SCORES = ("step", "minutes", "RMSE", "FPE", "R")  # scores of the selected weights that are stored in the card


def run(
    model: str, data: Path, out: Path, options: TrainOptions, resume: bool = False,
    start: Path | None = None,
) -> list[str]:  # fmt: skip
    """Train on groups of motions; write the best weights to OUT and their card next to it. Returns lines of results.

    OUT with the suffix .ckpt is the checkpoint from which `resume` continues; with the same options the curve is the
    same as without the interruption. `start` holds initial weights, whose runs come first in the new card. Raises
    InputError for missing or unsuitable files.
    """
    out = Path(out)
    if not out.parent.is_dir():
        raise InputError(f"{out}: there is no folder {out.parent}; create it first")
    groups = parse_groups(options.groups, more=EXTRA_GROUPS)
    training, validation = train_validation_split(read_groups(data, groups, options.keypoints), VALIDATION_SCENES)
    if training.points.shape[1] <= max(options.frames):
        raise InputError(f"--horizons: the motions have {training.points.shape[1]} frames; give shorter rollouts")
    with process_group(pick_device(options.device), options.batch) as processes:
        sums = describe_groups(data, groups)
        state, earlier = _initial_state(model, options, processes.device, start)
        key = _key(model, options, earlier, sums)
        if resume:
            state.load(out.with_suffix(".ckpt"), key)
            log.info("resuming at step %d, after %.1f min", state.step, state.elapsed / 60)
        if processes.is_main:
            log.info("%s, %s parameters: %d training scenes, %d validation scenes", model,
                     f"{sum(p.numel() for p in state.params):,}", len(training), len(validation))  # fmt: skip
        parts = _with_sparse(training, options.sparse_keypoints)
        samplers = [ClipSampler(part, processes.device, state.model) for part in parts]
        job = TrainingRun(state, samplers, validation.to(processes.device), options, processes, out, key)
        finished = job.run()
        if not processes.is_main:
            return []
        best = state.best_row()
        record = {
            "command": shlex.join(["ngff-lab", *sys.argv[1:]]), "seed": options.seed, "groups": options.groups,
            "processes": processes.size, "scenes": len(training), "validation scenes": len(validation),
            "steps": state.step, "minutes": state.elapsed / 60, "finished": finished,
            "validation": {k: best[k] for k in SCORES}, "data": sums,
        }  # fmt: skip
        save(out, model, state.best_model(), {
            "ngff": ngff_version(), "torch": torch.__version__,
            "device": torch.cuda.get_device_name() if processes.device == "cuda" else "cpu",
            "options": asdict(options), "runs": [*earlier, record], "curve": curve_columns(state.curve),
        })  # fmt: skip
    ended = "" if finished else " (stopped before the end; go on with --resume)"
    return [f"{out}: RMSE {best['RMSE']:.4f}  FPE {best['FPE']:.4f}  R {best['R']:.3f} over {VALIDATION_FRAMES} frames "
            f"of unseen scenes, after {best['minutes']:.1f} of {state.elapsed / 60:.1f} min{ended}"]  # fmt: skip


def _with_sparse(motions: KeypointMotions, count: int) -> list[KeypointMotions]:
    """The motions, followed by a copy with `count` keypoints per object unless `count` is 0."""
    return [motions, replace(motions, points=motions.points[:, :, :, :count].clone())] if count else [motions]


def _initial_state(
    model: str, options: TrainOptions, device: str, start: Path | None
) -> tuple[TrainingState, list[dict]]:
    """A new model, or one with the weights `start`, and the earlier runs of these weights."""
    torch.manual_seed(options.seed)
    earlier = []
    if start is None:
        network = build(model, **({"hidden": options.width} if options.width else {})).to(device)
    else:
        network, card = load(start, device)
        if options.width and card["model"] == model == "ngff":
            network = widen(network, options.width)
        if card["model"] != model or options.width not in (0, network.config.get("hidden")):
            raise InputError(f"{start}: holds {card['model']} {network.config}, not the model to be trained; leave "
                             "--width out and name weights of the same model")  # fmt: skip
        earlier = runs_of(card)
    return TrainingState(network, options.lr, options.seed, options.optimizer), earlier


def _key(model: str, options: TrainOptions, earlier: list[dict], sums: dict[str, str]) -> dict:
    """Settings and checksums that must be equal to resume training from a checkpoint."""
    start = earlier[-1]["sha256"] if earlier else None
    return {"model": model, "from": start, "data": sums, **{k: v for k, v in asdict(options).items() if k != "device"}}


@dataclass
class TrainingRun:
    """One training run, by one or several processes."""

    state: TrainingState
    # samplers with all keypoints, optionally followed by one with fewer for every fourth step
    samplers: list[ClipSampler]
    validation: KeypointMotions
    options: TrainOptions
    processes: ProcessGroup
    out: Path
    key: dict

    def run(self) -> bool:
        """Train until the budget is used up (returns True) or the process is asked to terminate (False)."""
        state, options, part = self.state, self.options, self.processes.rows(self.options.batch)
        self.clock = time.perf_counter() - state.elapsed
        losses, horizon, done = [], 0, self.progress()
        with (
            _termination_requests() as requests,
            _tf32_matmul(self.processes.device),
            tqdm(total=1.0, bar_format="{l_bar}{bar}| {elapsed}", disable=not self.processes.is_main) as bar,
        ):
            while done < 1 and not self.processes.broadcast(len(requests)):
                if options.horizon(done) != horizon:
                    losses, horizon = [], options.horizon(done)  # first free the memory of the old CUDA graphs
                    losses = [self.rollout_loss(sampler) for sampler in self.samplers]
                    state.start_horizon(horizon)
                i = -1 if state.step % SPARSE_EVERY == 0 else 0
                loss, grads = losses[i](self.samplers[i].draw(options.batch, horizon, state.generator, part))
                *grads, loss = self.processes.mean([*grads, loss])
                state.update(grads, options.rate(done))
                state.losses.append(loss.clone())  # the CUDA graph will overwrite the memory of the loss
                before, done = done, self.progress()
                if math.floor(done * options.checks) > math.floor(before * options.checks):
                    self.check(horizon)
                    done = self.progress()
                bar.update(min(done, 1.0) - bar.n)
        if not state.curve:
            self.check(horizon)
        if self.processes.is_main:
            state.save(self.out.with_suffix(".ckpt"), self.key)
        return done >= 1

    def rollout_loss(self, sampler: ClipSampler) -> RolloutLoss:
        """The loss for batches of one sampler."""
        o = self.options
        return RolloutLoss(
            self.state.model,
            sampler.motions.dt,
            LossOptions(o.loss, o.velocity_weight, o.gradient_discount),
            compiled=o.compiled,
        )

    def progress(self) -> float:
        """Fraction of the budget that is used up."""
        state, options = self.state, self.options
        state.elapsed = self.processes.broadcast(time.perf_counter() - self.clock)
        return state.step / options.steps if options.steps else state.elapsed / (60 * options.minutes)

    def check(self, horizon: int) -> None:
        """Validate, append to the curve, and write a checkpoint."""
        state, is_main = self.state, self.processes.is_main
        found = validate(state.ema, self.validation) if is_main else {}
        state.record({"horizon": horizon, **found, "RMSE": self.processes.broadcast(found.get("RMSE", 0.0))})
        if is_main:
            state.save(self.out.with_suffix(".ckpt"), self.key)
            log.info(PROGRESS_LINE.format(**state.curve[-1]))
            if state.curve[-1]["skipped"]:
                log.warning("%d steps were skipped, as their gradients were not finite", state.curve[-1]["skipped"])


@contextmanager
def _termination_requests():
    """A list that becomes non-empty when the process receives SIGTERM, for example from `timeout`."""
    requests: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: requests.append(number))
    try:
        yield requests
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _tf32_matmul(device: str):
    """Use TF32 for matrix products on a GPU: its rounding error is far below the noise of a batch."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if device == "cuda" else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@torch.no_grad()
def validate(
    model: torch.nn.Module, scenes: KeypointMotions, frames: int = VALIDATION_FRAMES, batch: int = 100
) -> dict[str, float]:
    """Metrics of full rollouts from rest, averaged over the scenes; the RMSE is inf if any scene's is not finite."""
    model.eval()
    frames = min(frames, scenes.points.shape[1])
    world, rows = scenes.initial_conditions(), []
    for first in range(0, len(scenes), batch):
        some = world[first : first + batch]
        truth = scenes.points[first : first + batch, :frames]
        rows.append(all_metrics(model.rollout(some, frames, scenes.dt), truth, some.valid))
    mean = {k: torch.cat([r[k] for r in rows]).nanmean().item() for k in ("RMSE", "FPE", "PCE", "R", "R_pooled")}
    worst = torch.cat([r["RMSE"] for r in rows])
    return mean if bool(worst.isfinite().all()) else {**mean, "RMSE": math.inf}
