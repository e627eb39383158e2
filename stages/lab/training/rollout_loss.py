"""Loss and gradient of a batch: a rollout over some frames and back, on a GPU replayed as one CUDA graph.

What a model computes once for a scene (`prepare`, `observe`) decomposes matrices, for which the host must wait, so it
stays outside of the graph; gradients are carried on by hand from the graph into it.
"""

from __future__ import annotations

import logging
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.models.dynamics import Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.trees import leaf_tensors, replace_tensors
from stages.lab.training.data import MotionClip, smooth_motion

log = logging.getLogger(__name__)
UNIT = 0.01  # errors count in centimetres: gradients of order one
LOSSES = ("square", "scene", "axes", "relative")
ERROR_FLOOR = 0.1  # errors below a millimetre no longer matter to the root [UNIT]
MIN_SPREAD, TYPICAL_SPREAD = (
    1.0,
    5.0,
)  # motion that an error is measured against is at least so much; so much is usual [UNIT]


def keypoint_loss(
    predicted: Float[Tensor, "b t o n 3"], truth: Float[Tensor, "b t o n 3"], valid: Bool[Tensor, "b o n"], kind: str,
    spread: Float[Tensor, "b o 3"],
) -> Float[Tensor, ""]:  # fmt: skip
    """Error of the keypoints that are there, one of LOSSES.

    "square" is the mean squared coordinate error [cm^2], "scene" the mean RMSE of a scene [cm], and "axes" the mean
    RMSE of each axis of each object [cm], in which little motion counts as much as the fall; in "relative" it is
    measured against how much there is along that axis in the whole motion, as the correlation R measures it.
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
    kind: str, spread: Float[Tensor, "b o 3"], dt: float, time: float,
) -> Float[Tensor, ""]:  # fmt: skip
    """Error of speeds in all frames but the last, as of places `time` [s] later; `points` begin a frame earlier.

    A step that undoes what the one before did goes unseen in places. The truth are central differences, which mean
    nothing amid an impact: such frames of an object do not count.
    """
    truth = (points[:, 2:] - points[:, :-2]) / (2 * dt)
    known = smooth_motion(points, dt)[..., None, None]
    return keypoint_loss(torch.where(known, time * predicted[:, :-1], time * truth), time * truth, valid, kind, spread)


class RolloutLoss:
    """Call it with batches of one size and horizon: the loss, and its gradient for each of the model's parameters.

    Going back by a frame a gradient keeps the share `memory`: through contacts it grows, and over many frames explodes.
    """

    def __init__(
        self, model: Dynamics, dt: float, loss: str = "square", memory: float = 1.0, graph: bool = True,
        compiled: bool = False, speeds: float = 0.0,
    ):  # fmt: skip
        self.model, self.dt, self.loss, self.memory, self.speeds = model, dt, loss, memory, speeds
        self.advance = torch.compile(_advance, fullgraph=True, dynamic=False) if compiled else _advance
        self.compiling = compiled
        self.params = [p for p in model.parameters() if p.requires_grad]
        self.wanted = graph and self.params[0].is_cuda
        self.graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, piece: MotionClip) -> tuple[Float[Tensor, ""], list[Tensor]]:
        scene = self.model.encode(piece.rest)
        with torch.no_grad():
            state = self.model.state_from_motion(scene, piece.points, piece.speed)
        given = (scene, state, piece.points, piece.truth, piece.world.valid, piece.spread)
        if self.compiling:
            self._check(given)
            self.compiling = False
        if self.wanted and self.graph is None:
            self._capture(given)
        if self.graph is None:
            loss, grads = self._walk(given)
        else:
            for kept, new in zip(leaf_tensors(self.kept), leaf_tensors(given), strict=True):
                kept.data.copy_(new.detach())
            self.graph.replay()
            loss, grads = self.result
        return loss, self._carried(scene, grads)

    def _walk(self, given: tuple) -> tuple[Tensor, list[Tensor | None]]:
        """Loss, and gradients of the parameters, then of what was prepared."""
        scene, state, start, truth, valid, spread = given
        free = [x.detach().requires_grad_(x.requires_grad) for x in leaf_tensors(scene)]
        scene = replace_tensors(scene, iter(free))
        # so that the first step is like the others to a compiler
        state = replace_tensors(state, (x.detach().requires_grad_() for x in leaf_tensors(state)))
        pushes = ExternalForces.none_for(valid, truth)
        frames = []
        for _ in range(truth.shape[1]):
            state = replace_tensors(state, (torch.lerp(x.detach(), x, self.memory) for x in leaf_tensors(state)))
            moved = self.advance(self.model, scene, state, self.dt, pushes, self.speeds > 0)
            state = replace_tensors(state, iter(moved))
            frames.append(moved[len(state) :])
        points, *speed = (torch.stack(x, 1) for x in zip(*frames, strict=True))
        loss = keypoint_loss(points, truth, valid, self.loss, spread)
        if speed:
            known = torch.cat([start[:, None], truth], 1)
            loss = loss + velocity_loss(*speed, known, valid, self.loss, spread, self.dt, self.speeds)
        wanted = self.params + [x for x in free if x.requires_grad]
        return loss.detach(), list(torch.autograd.grad(loss, wanted, allow_unused=True))

    def _check(self, given: tuple) -> None:
        """Compile; where that fails or gives no finite gradients, say so and go on without."""
        try:
            if all(bool(g.isfinite().all()) for g in self._walk(given)[1] if g is not None):
                return
            why = "gives gradients that are not finite"
        except Exception as error:  # a compiler fails in many ways
            why = f"fails ({str(error).strip().splitlines()[0]})"
        log.warning("compiling the step %s: going on without", why)
        self.advance = _advance

    def _carried(self, scene: Any, grads: list[Tensor | None]) -> list[Tensor]:
        """Gradients of the parameters, with those that come through the prepared scene."""
        own, inner = grads[: len(self.params)], grads[len(self.params) :]
        prepared = [(x, g) for x, g in zip([x for x in leaf_tensors(scene) if x.requires_grad], inner, strict=True)
                    if g is not None]  # fmt: skip
        more = [None] * len(own)
        if prepared:
            outputs, weights = zip(*prepared, strict=True)
            more = torch.autograd.grad(outputs, self.params, weights, allow_unused=True)
        return [_sum(p, a, b) for p, a, b in zip(self.params, own, more, strict=True)]

    def _capture(self, given: tuple) -> None:
        """Record the walk; where that fails, say so and go on without."""
        self.wanted = False
        # leaves with memory of their own, which the graph reads
        kept = [x.detach().clone(memory_format=torch.contiguous_format).requires_grad_(x.requires_grad)
                for x in leaf_tensors(given)]  # fmt: skip
        kept = replace_tensors(given, iter(kept))
        try:
            side = torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                for _ in range(2):
                    self._walk(kept)
            torch.cuda.current_stream().wait_stream(side)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                self.result = self._walk(kept)
            self.graph, self.kept = graph, kept
        except RuntimeError as error:
            torch.cuda.synchronize()
            log.info("no CUDA graph, going on step by step: %s", str(error).splitlines()[0])


def _advance(
    model: Dynamics, scene: Any, state: tuple, dt: float, pushes: ExternalForces, speeds: bool
) -> tuple[Tensor, ...]:
    """The tensors of the next state, where its points are and perhaps how fast; without pushes the time is nothing.

    One flat tuple: PyTorch 2.11 compiles a named tuple that comes out of a `_replace` to an empty one.
    """
    state = model.step(scene, state, 0.0, dt, pushes)
    return (*state, model.points(scene, state), *([model.point_velocity(scene, state, pushes)] if speeds else []))


def _sum(like: Tensor, a: Tensor | None, b: Tensor | None) -> Tensor:
    if a is None and b is None:
        return torch.zeros_like(like)
    return a if b is None else b if a is None else a + b
