"""All that training changes: the model, its running mean, the optimizer, the curve; to a checkpoint and back."""

from __future__ import annotations

import copy
import math
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from stages.core.errors import InputError
from stages.core.models.dynamics import Dynamics
from stages.core.scene.files import must_exist, replacing

EMA_DECAY = 0.999  # of the running mean of the weights, from a few thousand steps on
GRADIENT_CLIP = 2.0  # gradients are cut to so many times their usual norm
GRADIENT_NORM_DECAY = 0.99  # of the usual norm
WARMUP_STEPS = 200  # steps until the full rate
DIVERGENCE_RATIO = 1.25  # times the lowest RMSE so far, from which on training has gone astray,
MAX_WORSENING_CHECKS = 4  # as it has when each of so many checks was worse than the one before
OPTIMIZERS = ("adamw", "soap")


class TrainingState:
    """A model in training."""

    def __init__(self, model: Dynamics, lr: float, seed: int, optimizer: str = "adamw"):
        self.model = model.train()
        self.ema = copy.deepcopy(model).eval().requires_grad_(False)
        self.best = copy.deepcopy(self.ema.state_dict())
        self.params = [p for p in model.parameters() if p.requires_grad]
        self.optimizer = _optimizer(optimizer, self.params, lr)
        self.usual = self.params[0].new_zeros(())
        self.generator = torch.Generator().manual_seed(seed)
        self.step, self.elapsed, self.curve = 0, 0.0, []
        self.losses: list[Tensor] = []  # since the last line of the curve
        self.skipped = self.params[0].new_zeros(())  # steps without finite gradients since then
        self.caution, self.since = 1.0, 0  # what the rate is multiplied with, and the step it began to rise at
        self.horizon = 0  # frames of the rollouts that the moments are of
        self.ahead: torch.cuda.Event | None = None

    @torch.no_grad()
    def update(self, grads: list[Tensor], lr: float) -> None:
        """One step down the gradients, cut to twice their usual norm; none if they are not finite."""
        norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(grads)))
        finite = norm.isfinite()
        norm = torch.where(finite, norm, 0.0)
        usual = torch.where(self.usual > 0, self.usual, norm)
        cut = torch.minimum(norm, GRADIENT_CLIP * usual)
        scale = torch.where(norm > 0, cut / norm.clamp_min(1e-30), 0.0)
        self.usual = torch.where(finite, GRADIENT_NORM_DECAY * usual + (1 - GRADIENT_NORM_DECAY) * cut, self.usual)
        for p, g in zip(self.params, grads, strict=True):
            p.grad = torch.where(finite, g * scale, 0.0)
        for group in self.optimizer.param_groups:
            group["lr"] = lr * self.caution * min(1.0, (self.step - self.since + 1) / WARMUP_STEPS)
        before = [p.detach().clone() for p in self.params]
        self.optimizer.step()
        for p, old in zip(self.params, before, strict=True):
            p.copy_(torch.where(finite, p, old))
        self.skipped += ~finite
        self.step += 1
        keep = min(EMA_DECAY, (1 + self.step) / (10 + self.step))
        torch._foreach_lerp_(list(self.ema.parameters()), list(self.model.parameters()), 1 - keep)
        if self.usual.is_cuda:  # the host runs ahead by one step: more, and it would lose count of time
            if self.ahead is not None:
                self.ahead.synchronize()
            self.ahead = torch.cuda.Event()
            self.ahead.record()

    def note(self, row: dict) -> None:
        """A line of the curve; weights with the lowest RMSE so far are kept.

        Gone astray, training goes on from those, at half the rate: long rollouts can explode on the way back.
        """
        mean = torch.stack(self.losses).nanmean().item() if self.losses else math.nan
        row = {"minutes": self.elapsed / 60, "step": self.step, "loss": mean, "caution": self.caution,
               "skipped": int(self.skipped), **row}  # fmt: skip
        self.losses = []
        self.skipped.zero_()
        lowest = min((r["RMSE"] for r in self.curve), default=math.inf)
        self.curve.append(row)
        if row["RMSE"] <= lowest:
            self.best = copy.deepcopy(self.ema.state_dict())
        elif not row["RMSE"] < DIVERGENCE_RATIO * lowest or self._sinking():
            self._rewind()

    def _sinking(self) -> bool:
        last = [r["RMSE"] for r in self.curve[-MAX_WORSENING_CHECKS - 1 :]]
        return len(last) > MAX_WORSENING_CHECKS and all(a < b for a, b in pairwise(last))

    def _rewind(self) -> None:
        self.model.load_state_dict(self.best)
        self.ema.load_state_dict(self.best)
        self.caution /= 2
        self._forget()

    def anew(self, horizon: int) -> None:
        """Begin with rollouts of so many frames: gradients of another size need other moments, and a slow start."""
        if self.horizon not in (0, horizon):
            self._forget()
        self.horizon = horizon

    def _forget(self) -> None:
        self.since = self.step
        self.usual.zero_()
        for moments in self.optimizer.state.values():
            for name in ("exp_avg", "exp_avg_sq", "step"):  # not the axes that SOAP has found
                if name in moments:
                    moments[name].zero_()

    def best_row(self) -> dict:
        return min(self.curve, key=lambda r: r["RMSE"])

    def best_model(self) -> Dynamics:
        model = copy.deepcopy(self.ema)
        model.load_state_dict(self.best)
        return model

    def save(self, path: Path, key: dict) -> None:
        """A checkpoint, `key` saying of what."""
        state = {
            "key": key, "model": self.model.state_dict(), "ema": self.ema.state_dict(), "best": self.best,
            "optimizer": self.optimizer.state_dict(), "usual": self.usual, "generator": self.generator.get_state(),
            "random": torch.get_rng_state(), "step": self.step, "elapsed": self.elapsed, "curve": self.curve,
            "losses": self.losses, "skipped": self.skipped, "caution": self.caution, "since": self.since,
            "horizon": self.horizon,
            "cuda": torch.cuda.get_rng_state() if self.usual.is_cuda else None,
        }  # fmt: skip
        with replacing(path) as part:
            torch.save(state, part)

    def load(self, path: Path, key: dict) -> None:
        """Go on from a checkpoint. Raises InputError for one that is damaged or of something else."""
        must_exist(path, "the checkpoint of a training to go on with")
        try:
            state = torch.load(path, map_location=self.usual.device, weights_only=True)
            odd = [k for k in key if state["key"].get(k) != key[k]]
        except Exception as error:  # a damaged pickle raises anything
            why = " ".join(str(error).split())[:200]
            raise InputError(f"{path}: cannot be read as a checkpoint ({why})") from error
        if odd:
            raise InputError(f"{path}: was made with another {', '.join(odd)}; go on with the same, or start anew")
        self.model.load_state_dict(state["model"])
        self.ema.load_state_dict(state["ema"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.best, self.usual, self.curve = state["best"], state["usual"], state["curve"]
        self.losses, self.caution, self.since = state["losses"], state["caution"], state["since"]
        self.horizon, self.skipped = state["horizon"], state["skipped"]
        self.step, self.elapsed = state["step"], state["elapsed"]
        self.generator.set_state(state["generator"].cpu())
        torch.set_rng_state(state["random"].cpu())
        if state["cuda"] is not None and self.usual.is_cuda:
            torch.cuda.set_rng_state(state["cuda"].cpu())


def _optimizer(kind: str, params: list[Tensor], lr: float) -> torch.optim.Optimizer:
    """One of OPTIMIZERS: AdamW, or SOAP, which is Adam along the axes in which gradients vary most and least.

    Source: Vyas et al. 2024, "SOAP: improving and stabilizing Shampoo using Adam".
    """
    if kind == "adamw":
        return torch.optim.AdamW(params, lr, betas=(0.9, 0.99), weight_decay=1e-4, fused=True)
    try:
        from pytorch_optimizer import SOAP
    except ImportError as error:
        raise InputError("--optimizer soap needs the package pytorch-optimizer; pip install 'ngff[train]'") from error
    return SOAP(params, lr, betas=(0.95, 0.95), weight_decay=1e-4)
