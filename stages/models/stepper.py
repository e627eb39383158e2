"""Rollouts at the speed of the device: on CUDA a step is recorded once and replayed, without Python in between.

    stepper = Stepper(model, world)
    for _ in range(steps):
        stepper.step()
        stepper.points  # where the keypoints are now

A step of a model is hundreds of small kernels, whose launches take ten times as long as their work. A CUDA graph
launches them all at once.
"""

from __future__ import annotations

import logging
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from stages.models.dynamics import FRAME, Dynamics
from stages.models.pushes import Pushes
from stages.models.trees import rebuilt, tensors
from stages.models.world import World

log = logging.getLogger(__name__)


class Stepper:
    """A scene that moves on by dt [s] with every `step`; on other devices than CUDA simply the model's own step.

    `state`, `points` and `pushes` are tensors that stay where they are: their contents change, and `pushes` may be
    written to between steps.
    """

    @torch.no_grad()
    def __init__(self, model: Dynamics, world: World, dt: float = FRAME, pushes: Pushes | None = None):
        self.model, self.dt = model, dt
        self.graph: torch.cuda.CUDAGraph | None = None
        given = self._given(world, pushes)
        new = (x.clone(memory_format=torch.contiguous_format) for x in tensors(given))
        self.scene, self.state, self.points, self.pushes, self.time = rebuilt(given, new)
        if self.time.is_cuda:
            self._record()
            self._load(given)

    @torch.no_grad()
    def step(self) -> None:
        """Go on by dt."""
        if self.graph is None:
            self._step()
        else:
            self.graph.replay()

    @torch.no_grad()
    def restart(self, world: World, pushes: Pushes | None = None) -> None:
        """Begin anew, with a world and pushes of the same shapes."""
        self._load(self._given(world, pushes))

    def _given(self, world: World, pushes: Pushes | None) -> tuple[Any, tuple, Tensor, Pushes, Tensor]:
        scene = self.model.prepare(world)
        state = self.model.start(scene)
        pushes = Pushes.none(world) if pushes is None else pushes
        return scene, state, self.model.points(scene, state), pushes, state[0].new_zeros((), dtype=torch.int64)

    def _load(self, given: tuple) -> None:
        kept = tensors((self.scene, self.state, self.points, self.pushes, self.time))
        for mine, new in zip(kept, tensors(given), strict=True):
            if mine.shape != new.shape:
                raise ValueError(f"made for {tuple(mine.shape)}, not {tuple(new.shape)}")
            mine.copy_(new)

    def _step(self) -> None:
        _advance(self.model, self.scene, self.state, self.points, self.pushes, self.time, self.dt)

    def _record(self) -> None:
        """Capture a step, after two that load and tune whatever is used."""
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(2):
                self._step()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self._step()
        self.graph = graph


def _advance(
    model: Dynamics, scene: Any, state: tuple, points: Tensor, pushes: Pushes, time: Tensor, dt: float
) -> None:
    """A step in place; `time` counts steps, so that it stays exact."""
    new = model.step(scene, state, time.to(state[0]) * dt, dt, pushes)
    torch._foreach_copy_([*state, points], [*new, model.points(scene, new)])  # on a GPU all in one kernel
    time += 1


@torch.no_grad()
def rollout(
    model: Dynamics, world: World, steps: int, dt: float = FRAME, pushes: Pushes | None = None
) -> Float[Tensor, "b t o n 3"]:
    """What `model.rollout` gives, with the speed of a Stepper: keypoints in `steps` frames, the first the start."""
    out = frames(Stepper(model, world, dt, pushes), steps)
    return out.masked_fill_(~world.valid[:, None, ..., None], 0.0)


@torch.no_grad()
def frames(stepper: Stepper, steps: int) -> Float[Tensor, "b t o n 3"]:
    """Keypoints now and after each of steps - 1 further steps; anything where padded."""
    b, o, n, _ = stepper.points.shape
    out = stepper.points.new_empty(b, steps, o, n, 3)
    for t in range(steps):
        if t:
            stepper.step()
        out[:, t] = stepper.points
    return out
