"""Training of a dynamics model: motions in, weights and their card out."""

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
from stages.lab.dataset.keypoint_motions import KeypointMotions
from stages.lab.dataset.scene_configs import EXTRA_GROUPS, parse_groups
from stages.lab.training.data import (
    VALIDATION_SCENES,
    ClipSampler,
    describe_groups,
    read_groups,
    train_validation_split,
)
from stages.lab.training.distributed import ProcessGroup, process_group
from stages.lab.training.rollout_loss import LOSSES, RolloutLoss
from stages.lab.training.state import OPTIMIZERS, TrainingState
from stages.lab.training.widen import widen

log = logging.getLogger(__name__)
HORIZON_FRACTIONS = (0.35, 0.35, 0.3)  # of the budget, for three horizons
PROGRESS_LINE = (
    "{minutes:6.1f} min {step:7d} steps  horizon {horizon:2d}  loss {loss:.4f}  "
    "RMSE {RMSE:.4f}  FPE {FPE:.4f}  R {R:.3f}"
)
SPARSE_EVERY = 4  # steps after which there is one with few keypoints
VALIDATION_FRAMES = 80  # of the rollouts that choose the weights


@dataclass(frozen=True)
class TrainOptions:
    """How to train."""

    minutes: float = 20.0  # budget, validation included
    steps: int = 0  # the budget in steps of the optimizer instead, when not 0: the same on every machine
    batch: int = 32  # scenes a step
    keypoints: int = 256  # of an object
    few: int = 0  # of an object in every fourth step instead, so that the model bears other numbers of them; 0: never
    lr: float = 1e-3  # highest rate
    horizons: str = "8,20,40"  # frames that a rollout goes on for, one phase each
    hidden: int = 0  # width of the network; 0: the model's own
    loss: str = "scene"  # one of training_roll.LOSSES
    optimizer: str = "adamw"  # one of training_state.OPTIMIZERS
    speeds: float = 0.0  # an error of a speed counts as one of the place so much later [s]; 0: not at all
    memory: float = 0.9  # share of a gradient that goes back by another frame
    groups: str = "3_0..3_8"  # files to learn from; the last scenes of the last choose the best weights
    compiled: bool = False  # compile a step first: a minute or so, then faster; for GPUs
    seed: int = 0
    device: str = "auto"
    checks: int = 24  # how often to validate, and to write a checkpoint, in the whole run

    def __post_init__(self):
        if self.minutes <= 0 or self.steps < 0 or min(self.batch, self.keypoints) < 1 or self.lr <= 0:
            raise InputError("--minutes, --batch, --keypoints and --lr must be positive, --steps at least 0")
        if not 0 <= self.few <= self.keypoints:
            raise InputError(f"--few {self.few}: must be between 0 and --keypoints")
        if self.speeds < 0:
            raise InputError(f"--speeds {self.speeds}: a time in seconds, or 0")
        if not 0 <= self.memory <= 1:
            raise InputError(f"--memory {self.memory}: must be between 0 and 1")
        if self.loss not in LOSSES:
            raise InputError(f"--loss {self.loss}: choose from {', '.join(LOSSES)}")
        if self.optimizer not in OPTIMIZERS:
            raise InputError(f"--optimizer {self.optimizer}: choose from {', '.join(OPTIMIZERS)}")
        if min(self.frames) < 1:
            raise InputError(f"--horizons takes frames, such as 8,20,40, not {self.horizons!r}")

    @property
    def frames(self) -> tuple[int, ...]:
        """The horizons."""
        try:
            return tuple(int(word) for word in self.horizons.split(","))
        except ValueError as error:
            raise InputError(f"--horizons takes frames, such as 8,20,40, not {self.horizons!r}") from error

    def horizon(self, progress: float) -> int:
        """Frames to roll out at this share of the budget."""
        n = len(self.frames)
        ends = [sum(HORIZON_FRACTIONS[: i + 1]) if n == len(HORIZON_FRACTIONS) else (i + 1) / n for i in range(n)]
        return self.frames[min(sum(progress >= e for e in ends), n - 1)]

    def rate(self, progress: float) -> float:
        """Learning rate: half a cosine down to a hundredth."""
        return self.lr * (0.01 + 0.99 * (1 + math.cos(math.pi * min(progress, 1.0))) / 2)


def run(
    model: str, data: Path, out: Path, options: TrainOptions = TrainOptions(), resume: bool = False,
    start: Path | None = None,
) -> list[str]:  # fmt: skip
    """Train on the groups in a folder; the best weights go to OUT and their card beside it. Lines of result.

    OUT with the suffix .ckpt is what `resume` goes on from; with the same options the curve is the same as without
    the interruption. `start` are weights to begin with, whose card becomes a part of the new one. Raises InputError
    for missing or unfit files.
    """
    out = Path(out)
    if not out.parent.is_dir():
        raise InputError(f"{out}: there is no folder {out.parent}; make it first")
    groups = parse_groups(options.groups, more=EXTRA_GROUPS)
    known, unseen = train_validation_split(read_groups(data, groups, options.keypoints), VALIDATION_SCENES)
    if known.points.shape[1] <= max(options.frames):
        raise InputError(f"--horizons: the motions have {known.points.shape[1]} frames; take shorter ones")
    with process_group(pick_device(options.device), options.batch) as crew:
        trainee, before = _trainee(model, out, options, crew.device, resume, start)
        if crew.leads:
            log.info("%s, %s parameters: learns from %d scenes, chosen by %d", model,
                     f"{sum(p.numel() for p in trainee.params):,}", len(known), len(unseen))  # fmt: skip
        pieces = [ClipSampler(part, crew.device, trainee.model) for part in _seen(known, options.few)]
        job = TrainingRun(trainee, pieces, unseen.to(crew.device), options, crew, out, _key(model, options, before))
        finished = job.run()
        if not crew.leads:
            return []
        best = trainee.best_row()
        card = {
            "command": shlex.join(["ngff-lab", *sys.argv[1:]]), "ngff": ngff_version(), "torch": torch.__version__,
            "device": torch.cuda.get_device_name() if crew.device == "cuda" else "cpu", "processes": crew.size,
            "options": asdict(options), "data": describe_groups(data, groups), "scenes": len(known),
            "scenes to choose by": len(unseen), "finished": finished, "minutes": trainee.elapsed / 60,
            "steps": trainee.step, "validation": best, "curve": trainee.curve, **before,
        }  # fmt: skip
        save(out, model, trainee.best_model(), card)
    ended = "" if finished else " (stopped before the end; go on with --resume)"
    return [f"{out}: RMSE {best['RMSE']:.4f}  FPE {best['FPE']:.4f}  R {best['R']:.3f} over {VALIDATION_FRAMES} frames "
            f"of unseen scenes, after {best['minutes']:.1f} of {trainee.elapsed / 60:.1f} min{ended}"]  # fmt: skip


def _seen(motions: KeypointMotions, few: int) -> list[KeypointMotions]:
    """The motions, and the same with few keypoints if that is wanted."""
    return [motions, replace(motions, points=motions.points[:, :, :, :few].clone())] if few else [motions]


def _trainee(
    model: str, out: Path, options: TrainOptions, device: str, resume: bool, start: Path | None
) -> tuple[TrainingState, dict]:
    """A model that is new, from other weights, or from its checkpoint; and what its card says of those weights."""
    torch.manual_seed(options.seed)
    before = {}
    if start is None:
        network = build(model, **({"hidden": options.hidden} if options.hidden else {})).to(device)
    else:
        network, card = load(start, device)
        if options.hidden and card["model"] == model == "ngff":
            network = widen(network, options.hidden)
        if card["model"] != model or options.hidden not in (0, network.config.get("hidden")):
            raise InputError(f"{start}: holds {card['model']} {network.config}, not what is to be trained; leave "
                             "--hidden out and name weights of the same model")  # fmt: skip
        before = {"before": {k: v for k, v in card.items() if k not in ("model", "config")}}
    trainee = TrainingState(network, options.lr, options.seed, options.optimizer)
    if resume:
        trainee.load(out.with_suffix(".ckpt"), _key(model, options, before))
        log.info("going on from step %d, %.1f min", trainee.step, trainee.elapsed / 60)
    return trainee, before


def _key(model: str, options: TrainOptions, before: dict) -> dict:
    """What must be the same for a checkpoint to be gone on from."""
    start = before.get("before", {}).get("sha256")
    return {"model": model, "from": start, **{k: v for k, v in asdict(options).items() if k != "device"}}


@dataclass
class TrainingRun:
    """One run of training, by one process or several."""

    trainee: TrainingState
    pieces: list[ClipSampler]  # the usual ones; what every fourth step learns from
    unseen: KeypointMotions
    options: TrainOptions
    team: ProcessGroup
    out: Path
    key: dict

    def run(self) -> bool:
        """Go on until the budget is used up (True) or somebody asks to stop (False)."""
        trainee, options, part = self.trainee, self.options, self.team.rows(self.options.batch)
        self.clock = time.perf_counter() - trainee.elapsed
        rolls, horizon, done = [], 0, self.progress()
        with (
            _asked_to_stop() as asked,
            _rounded(self.team.device),
            tqdm(total=1.0, bar_format="{l_bar}{bar}| {elapsed}", disable=not self.team.leads) as bar,
        ):
            while done < 1 and not self.team.agreed(len(asked)):
                if options.horizon(done) != horizon:
                    rolls, horizon = [], options.horizon(done)  # the memory of the old graphs goes first
                    rolls = [self.roll(pieces) for pieces in self.pieces]
                    trainee.anew(horizon)
                turn = -1 if trainee.step % SPARSE_EVERY == 0 else 0
                loss, grads = rolls[turn](self.pieces[turn].draw(options.batch, horizon, trainee.generator, part))
                *grads, loss = self.team.mean([*grads, loss])
                trainee.update(grads, options.rate(done))
                trainee.losses.append(loss.clone())  # a graph writes the next one in the same place
                before, done = done, self.progress()
                if math.floor(done * options.checks) > math.floor(before * options.checks):
                    self.check(horizon)
                    done = self.progress()
                bar.update(min(done, 1.0) - bar.n)
        if not trainee.curve:
            self.check(horizon)
        if self.team.leads:
            trainee.save(self.out.with_suffix(".ckpt"), self.key)
        return done >= 1

    def roll(self, pieces: ClipSampler) -> RolloutLoss:
        options = self.options
        return RolloutLoss(
            self.trainee.model, pieces.motions.dt, options.loss, options.memory, compiled=options.compiled,
            speeds=options.speeds,
        )  # fmt: skip

    def progress(self) -> float:
        """Share of the budget that is used up."""
        trainee, options = self.trainee, self.options
        trainee.elapsed = self.team.agreed(time.perf_counter() - self.clock)
        return trainee.step / options.steps if options.steps else trainee.elapsed / (60 * options.minutes)

    def check(self, horizon: int) -> None:
        """A line of the curve, and a checkpoint."""
        trainee, leads = self.trainee, self.team.leads
        found = validate(trainee.ema, self.unseen) if leads else {}
        trainee.note({"horizon": horizon, **found, "RMSE": self.team.agreed(found.get("RMSE", 0.0))})
        if leads:
            trainee.save(self.out.with_suffix(".ckpt"), self.key)
            log.info(PROGRESS_LINE.format(**trainee.curve[-1]))
            if trainee.curve[-1]["skipped"]:
                log.warning("%d steps had no finite gradients and changed nothing", trainee.curve[-1]["skipped"])


@contextmanager
def _asked_to_stop():
    """A list that is no longer empty once the process is asked to terminate, as `timeout` does."""
    asked: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: asked.append(number))
    try:
        yield asked
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _rounded(device: str):
    """On a GPU, products of matrices as tf32 has them: what they lose is far below the noise of a batch."""
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
    """Metrics of full rollouts from rest, averaged over the scenes; an RMSE that is not finite is infinite."""
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
