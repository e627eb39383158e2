"""State of a training run: model, averaged weights, optimizer and curve; saved to and loaded from checkpoints."""

from __future__ import annotations

import copy
import math
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from stages.core.errors import InputError, MissingPackage
from stages.core.models.dynamics import Dynamics
from stages.core.scene.files import must_exist, save_tensors

EMA_DECAY = 0.999  # decay of the exponential moving average of the weights, after a few thousand steps
GRADIENT_CLIP = 2.0  # gradients are clipped to this multiple of the moving average of their norm
GRADIENT_NORM_DECAY = 0.99  # decay of the moving average of the gradient norm
WARMUP_STEPS = 200  # steps until the full learning rate
DIVERGENCE_RATIO = 1.25  # training has diverged if the RMSE is this multiple of the lowest so far
MAX_WORSENING_CHECKS = 4  # training has diverged if this many consecutive validations were each worse than the last


class TrainingState:
    """A model in training, with everything that a checkpoint has to store."""

    def __init__(self, model: Dynamics, lr: float, seed: int, optimizer: str = "adamw"):
        self.model = model.train()
        self.ema = copy.deepcopy(model).eval().requires_grad_(False)
        self.best = copy.deepcopy(self.ema.state_dict())
        self.params = [p for p in model.parameters() if p.requires_grad]
        self.optimizer = _optimizer(optimizer, self.params, lr)
        self.gradient_norm = self.params[0].new_zeros(())  # moving average; 0: none yet
        self.generator = torch.Generator().manual_seed(seed)
        self.step, self.elapsed, self.curve = 0, 0.0, []
        self.losses: list[Tensor] = []  # losses since the last row of the curve
        self.skipped = self.params[0].new_zeros(())  # number of steps with non-finite gradients since then
        self.rate_factor, self.warmup_start = 1.0, 0  # halved on divergence; step at which the warm-up starts
        self.horizon = 0  # rollout length to which the optimizer's moments belong [frames]
        self.previous_step: torch.cuda.Event | None = None

    @torch.no_grad()
    def update(self, grads: list[Tensor], lr: float) -> None:
        """One optimizer step with clipped gradients; parameters stay unchanged if the gradients are not finite."""
        norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(grads)))
        finite = norm.isfinite()
        norm = torch.where(finite, norm, 0.0)
        usual = torch.where(self.gradient_norm > 0, self.gradient_norm, norm)
        clipped = torch.minimum(norm, GRADIENT_CLIP * usual)
        scale = torch.where(norm > 0, clipped / norm.clamp_min(1e-30), 0.0)
        average = GRADIENT_NORM_DECAY * usual + (1 - GRADIENT_NORM_DECAY) * clipped
        self.gradient_norm = torch.where(finite, average, self.gradient_norm)
        for p, g in zip(self.params, grads, strict=True):
            p.grad = torch.where(finite, g * scale, 0.0)
        for group in self.optimizer.param_groups:
            group["lr"] = lr * self.rate_factor * min(1.0, (self.step - self.warmup_start + 1) / WARMUP_STEPS)
        before = [p.detach().clone() for p in self.params]
        self.optimizer.step()
        for p, old in zip(self.params, before, strict=True):
            p.copy_(torch.where(finite, p, old))
        self.skipped += ~finite
        self.step += 1
        keep = min(EMA_DECAY, (1 + self.step) / (10 + self.step))
        torch._foreach_lerp_(list(self.ema.parameters()), list(self.model.parameters()), 1 - keep)
        # let the host run at most one step ahead, so that its clock measures the time of the GPU
        if self.gradient_norm.is_cuda:
            if self.previous_step is not None:
                self.previous_step.synchronize()
            self.previous_step = torch.cuda.Event()
            self.previous_step.record()

    def record(self, row: dict) -> None:
        """Append a validation to the curve; keep the weights if they have the lowest RMSE so far.

        On divergence, which exploding gradients of long rollouts can cause, training continues from the best weights at
        half the learning rate.
        """
        mean = torch.stack(self.losses).nanmean().item() if self.losses else math.nan
        row = {"minutes": self.elapsed / 60, "step": self.step, "loss": mean, "rate_factor": self.rate_factor,
               "skipped": int(self.skipped), **row}  # fmt: skip
        self.losses = []
        self.skipped.zero_()
        lowest = min((r["RMSE"] for r in self.curve), default=math.inf)
        self.curve.append(row)
        if row["RMSE"] <= lowest:
            self.best = copy.deepcopy(self.ema.state_dict())
        elif not row["RMSE"] < DIVERGENCE_RATIO * lowest or self._worsening():
            self._restart_from_best()

    def _worsening(self) -> bool:
        last = [r["RMSE"] for r in self.curve[-MAX_WORSENING_CHECKS - 1 :]]
        return len(last) > MAX_WORSENING_CHECKS and all(a < b for a, b in pairwise(last))

    def _restart_from_best(self) -> None:
        self.model.load_state_dict(self.best)
        self.ema.load_state_dict(self.best)
        self.rate_factor /= 2
        self._reset_moments()

    def start_horizon(self, horizon: int) -> None:
        """Prepare for rollouts of `horizon` frames: gradients change in size, so moments and warm-up restart."""
        if self.horizon not in (0, horizon):
            self._reset_moments()
        self.horizon = horizon

    def _reset_moments(self) -> None:
        self.warmup_start = self.step
        self.gradient_norm.zero_()
        for moments in self.optimizer.state.values():
            for name in ("exp_avg", "exp_avg_sq", "step"):  # SOAP's eigenvectors are kept
                if name in moments:
                    moments[name].zero_()

    def best_row(self) -> dict:
        """The row of the curve with the lowest RMSE."""
        return min(self.curve, key=lambda r: r["RMSE"])

    def best_model(self) -> Dynamics:
        """A model with the averaged weights of the best row."""
        model = copy.deepcopy(self.ema)
        model.load_state_dict(self.best)
        return model

    def save(self, path: Path, key: dict) -> None:
        """Write a checkpoint; `key` identifies the training to which it belongs."""
        state = {
            "key": key, "model": self.model.state_dict(), "ema": self.ema.state_dict(), "best": self.best,
            "optimizer": self.optimizer.state_dict(), "gradient_norm": self.gradient_norm,
            "generator": self.generator.get_state(), "random": torch.get_rng_state(), "step": self.step,
            "elapsed": self.elapsed, "curve": self.curve, "losses": self.losses, "skipped": self.skipped,
            "rate_factor": self.rate_factor, "warmup_start": self.warmup_start, "horizon": self.horizon,
            "cuda": torch.cuda.get_rng_state() if self.gradient_norm.is_cuda else None,
        }  # fmt: skip
        save_tensors(path, state)

    def load(self, path: Path, key: dict) -> None:
        """Resume from a checkpoint. Raises InputError if it is damaged or belongs to another training."""
        must_exist(path, "the checkpoint of a training to go on with")
        try:
            state = torch.load(path, map_location=self.gradient_norm.device, weights_only=True)
            different = [k for k in key if state["key"].get(k) != key[k]]
            if not different:
                self._take(state)
        except torch.cuda.OutOfMemoryError:  # the file is not the cause
            raise
        except Exception as error:  # damaged pickles and values of wrong types raise arbitrary exceptions
            raise InputError(
                f"{path}: cannot be read as a checkpoint of a training; start again without --resume"
            ) from error
        if different:
            raise InputError(f"{path}: was written with different values of {', '.join(different)}; use the same "
                             "values, or start "
                             "again without --resume")  # fmt: skip

    def _take(self, state: dict) -> None:
        """Restore the state written by `save`."""
        self.model.load_state_dict(state["model"])
        self.ema.load_state_dict(state["ema"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.best, self.gradient_norm, self.curve = state["best"], state["gradient_norm"], state["curve"]
        self.losses, self.rate_factor, self.warmup_start = state["losses"], state["rate_factor"], state["warmup_start"]
        self.horizon, self.skipped = state["horizon"], state["skipped"]
        self.step, self.elapsed = state["step"], state["elapsed"]
        self.generator.set_state(state["generator"].cpu())
        torch.set_rng_state(state["random"].cpu())
        if state["cuda"] is not None and self.gradient_norm.is_cuda:
            torch.cuda.set_rng_state(state["cuda"].cpu())


def _optimizer(kind: str, params: list[Tensor], lr: float) -> torch.optim.Optimizer:
    """One of OPTIMIZERS: AdamW, or SOAP, which runs Adam in the eigenbasis of Shampoo's preconditioner.

    Source: Vyas et al. 2024, "SOAP: improving and stabilizing Shampoo using Adam".
    """
    if kind == "adamw":
        return torch.optim.AdamW(params, lr, betas=(0.9, 0.99), weight_decay=1e-4, fused=True)
    try:
        from pytorch_optimizer import SOAP
    except ImportError as error:
        raise MissingPackage("--optimizer soap needs pytorch-optimizer: `pip install 'ngff[train]'`") from error
    return SOAP(params, lr, betas=(0.95, 0.95), weight_decay=1e-4)
