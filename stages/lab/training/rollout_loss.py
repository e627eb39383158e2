"""Loss of a batch and its gradient: forward and backward pass of a rollout, replayed as one CUDA graph on a GPU.

The computations done once per scene (`precompute`, `encode`, `state_from_motion`) include matrix decompositions that
synchronise with the host, so they are outside of the graph. Their gradients are chained to those of the graph
explicitly.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.kernels.cuda_graphs import captured
from stages.core.models.dynamics import Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.trees import leaf_tensors, replace_tensors
from stages.lab.training.data import MotionClip, smooth_motion

log = logging.getLogger(__name__)
UNIT = 0.01  # unit of errors, so that gradients are of order one [m]
ERROR_FLOOR = 0.1  # added in quadrature to errors before taking the root [UNIT]: a millimetre
MIN_SPREAD, TYPICAL_SPREAD = 1.0, 5.0  # offset and reference value of the spread that "relative" divides by [UNIT]


@dataclass(frozen=True)
class LossOptions:
    """Kind and weights of the terms of the loss."""

    kind: str = "square"  # name of the position loss, one of LOSSES
    velocity_time: float = 0.0  # weight of velocity errors relative to position errors [s]; 0: no velocity errors
    gradient_discount: float = 1.0  # factor on the gradient per frame; contacts amplify it in backpropagation


def keypoint_loss(
    predicted: Float[Tensor, "b t o n 3"], truth: Float[Tensor, "b t o n 3"], valid: Bool[Tensor, "b o n"], kind: str,
    spread: Float[Tensor, "b o 3"],
) -> Float[Tensor, ""]:  # fmt: skip
    """Error of the valid keypoints, one of LOSSES.

    "square" is the mean squared coordinate error [cm^2], "scene" the mean RMSE of a scene [cm], "axes" the mean RMSE
    over axes of objects [cm], in which small motions count as much as the fall. "relative" divides the latter by the
    `spread` of the true motion along that axis, like the correlation R.
    """
    squared = ((predicted - truth) / UNIT).square().mean(1)
    squared = torch.where(valid[..., None], squared, 0.0)
    if kind in ("axes", "relative"):
        count = valid.sum(2)
        each = squared.sum(2) / count.clamp_min(1)[..., None]
        root = (each + ERROR_FLOOR**2).sqrt()
        if kind == "relative":
            root = root * (TYPICAL_SPREAD / (MIN_SPREAD + spread / UNIT))
        return (root.mean(-1) * (count > 0)).sum() / (count > 0).sum().clamp_min(1)
    each = squared.mean(-1).sum((1, 2)) / valid.sum((1, 2)).clamp_min(1)
    return (each + ERROR_FLOOR**2).sqrt().mean() if kind == "scene" else each.mean()


def velocity_loss(
    predicted: Float[Tensor, "b t o n 3"], points: Float[Tensor, "b t+1 o n 3"], valid: Bool[Tensor, "b o n"],
    spread: Float[Tensor, "b o 3"], dt: float, options: LossOptions,
) -> Float[Tensor, ""]:  # fmt: skip
    """Velocity errors in all frames but the last, converted to position errors after `options.velocity_time`.

    It penalises oscillations whose positions cancel from step to step. `points` holds the true keypoints, starting one
    frame before the first prediction. The true velocities are central differences, so frames in which an object is in a
    collision are ignored.
    """
    truth, time = (points[:, 2:] - points[:, :-2]) / (2 * dt), options.velocity_time
    known = smooth_motion(points, dt)[..., None, None]
    later = torch.where(known, time * predicted[:, :-1], time * truth)
    return keypoint_loss(later, time * truth, valid, options.kind, spread)


class RolloutLoss:
    """Callable on clips of one batch size and horizon: the loss, and its gradient for each of the model's parameters.

    `graph` records the rollout as a CUDA graph on a GPU; `compiled` compiles the step first. If either fails, training
    continues without it.
    """

    def __init__(
        self, model: Dynamics, dt: float, options: LossOptions = LossOptions(), graph: bool = True,
        compiled: bool = False,
    ):  # fmt: skip
        self.model, self.dt, self.options = model, dt, options
        self.advance = torch.compile(_advance, fullgraph=True, dynamic=False) if compiled else _advance
        self.untested_compile = compiled
        self.params = [p for p in model.parameters() if p.requires_grad]
        self.record_graph = graph and self.params[0].is_cuda
        self.graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, clip: MotionClip) -> tuple[Float[Tensor, ""], list[Tensor]]:
        scene = self.model.encode(clip.rest)
        with torch.no_grad():
            state = self.model.state_from_motion(scene, clip.points, clip.speed)
        inputs = (scene, state, clip.points, clip.truth, clip.world.valid, clip.spread)
        if self.untested_compile:
            self._test_compiled(inputs)
            self.untested_compile = False
        if self.record_graph and self.graph is None:
            self._capture(inputs)
        if self.graph is None:
            loss, grads = self._rollout(inputs)
        else:
            for static, new in zip(leaf_tensors(self.static_inputs), leaf_tensors(inputs), strict=True):
                static.data.copy_(new.detach())
            self.graph.replay()
            loss, grads = self.result
        return loss, self._chain(scene, grads)

    def _rollout(self, inputs: tuple) -> tuple[Tensor, list[Tensor | None]]:
        """The loss, and its gradients with respect to the parameters and to the tensors of the prepared scene."""
        scene, state, start, truth, valid, spread = inputs
        options = self.options
        leaves = [x.detach().requires_grad_(x.requires_grad) for x in leaf_tensors(scene)]
        scene = replace_tensors(scene, iter(leaves))
        # the state requires gradients, so that the compiler sees the first step like all others
        state = replace_tensors(state, (x.detach().requires_grad_() for x in leaf_tensors(state)))
        external = ExternalForces.none_for(valid, truth)
        frames = []
        for _ in range(truth.shape[1]):
            state = replace_tensors(
                state, (torch.lerp(x.detach(), x, options.gradient_discount) for x in leaf_tensors(state))
            )
            moved = self.advance(self.model, scene, state, self.dt, external, options.velocity_time > 0)
            state = replace_tensors(state, iter(moved))
            frames.append(moved[len(state) :])
        points, *speed = (torch.stack(x, 1) for x in zip(*frames, strict=True))
        loss = keypoint_loss(points, truth, valid, options.kind, spread)
        if speed:
            known = torch.cat([start[:, None], truth], 1)
            loss = loss + velocity_loss(*speed, known, valid, spread, self.dt, options)
        with_gradient = self.params + [x for x in leaves if x.requires_grad]
        return loss.detach(), list(torch.autograd.grad(loss, with_gradient, allow_unused=True))

    def _test_compiled(self, inputs: tuple) -> None:
        """Compile; if this fails or gives non-finite gradients, warn and use the uncompiled step."""
        try:
            if all(bool(g.isfinite().all()) for g in self._rollout(inputs)[1] if g is not None):
                return
            why = "gives gradients that are not finite"
        except Exception as error:  # compilers raise many types of exceptions
            why = f"fails ({str(error).strip().splitlines()[0]})"
        log.warning("compiling the training step %s: training continues without compilation", why)
        self.advance = _advance

    def _chain(self, scene: Any, grads: list[Tensor | None]) -> list[Tensor]:
        """Gradients of the parameters, including those through the prepared scene."""
        direct, inner = grads[: len(self.params)], grads[len(self.params) :]
        prepared = [(x, g) for x, g in zip([x for x in leaf_tensors(scene) if x.requires_grad], inner, strict=True)
                    if g is not None]  # fmt: skip
        through_scene = [None] * len(direct)
        if prepared:
            outputs, weights = zip(*prepared, strict=True)
            through_scene = torch.autograd.grad(outputs, self.params, weights, allow_unused=True)
        return [_sum(p, a, b) for p, a, b in zip(self.params, direct, through_scene, strict=True)]

    def _capture(self, inputs: tuple) -> None:
        """Record the rollout as a CUDA graph; if this fails, log it and continue without."""
        self.record_graph = False
        # leaf tensors with separate memory, from which the graph reads its inputs
        static = [x.detach().clone(memory_format=torch.contiguous_format).requires_grad_(x.requires_grad)
                  for x in leaf_tensors(inputs)]  # fmt: skip
        static = replace_tensors(inputs, iter(static))
        try:
            side = torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                for _ in range(2):
                    self._rollout(static)
            torch.cuda.current_stream().wait_stream(side)
            results: list[Tensor] = []
            self.graph = captured(lambda: results.append(self._rollout(static)))
            (self.result,), self.static_inputs = results, static
        except RuntimeError as error:
            torch.cuda.synchronize()
            log.info(
                "no CUDA graph could be recorded, so that steps are launched one by one: %s", str(error).splitlines()[0]
            )


def _advance(
    model: Dynamics, scene: Any, state: tuple, dt: float, external: ExternalForces, speeds: bool
) -> tuple[Tensor, ...]:
    """The tensors of the next state, its keypoints, and with `speeds` their velocities.

    The time passed to the model is 0, since only external forces depend on it. The result is one flat tuple, because
    PyTorch 2.11 compiles a named tuple returned by `_replace` to an empty one.
    """
    state = model.step(scene, state, 0.0, dt, external)
    return (*state, model.points(scene, state), *([model.point_velocity(scene, state, external)] if speeds else []))


def _sum(like: Tensor, a: Tensor | None, b: Tensor | None) -> Tensor:
    if a is None and b is None:
        return torch.zeros_like(like)
    return a if b is None else b if a is None else a + b
