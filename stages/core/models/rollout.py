"""Rollouts at the speed of the device: on CUDA preparing a scene and a step are recorded once and replayed, without
Python in between.

    stepper = Stepper(model, world)
    for _ in range(steps):
        stepper.step()
        stepper.points  # where the keypoints are now

A step of a model is hundreds of small kernels, whose launches take ten times as long as their work. A CUDA graph
launches them all at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.models.dynamics import FRAME, Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions
from stages.core.models.trees import leaf_tensors, replace_tensors


class TimeStepper:
    """A scene that moves on by dt [s] with every `step`; on other devices than CUDA simply the model's own step.

    `state`, `points`, `pushes` and `time` (steps so far) are tensors that stay where they are: their contents change,
    and `pushes` and `time` may be written to between steps.
    """

    @torch.no_grad()
    def __init__(
        self, model: Dynamics, initial: InitialConditions, dt: float = FRAME, external: ExternalForces | None = None
    ):
        self.model, self.dt = model, dt
        given = initial, ExternalForces.none(initial) if external is None else external
        self.initial, self.external = _copy(given)
        self.step_count = torch.zeros((), dtype=torch.int64, device=initial.points.device)
        self.scene, state, points = self._given()
        self.state, self.points = _copy((state, points))
        self.begin, self.advance = self._begin, self._step
        if self.step_count.is_cuda:
            self.begin = _recorded(self._begin)
            self.advance = _recorded(self._step)
            self.begin()

    @torch.no_grad()
    def step(self) -> None:
        """Go on by dt."""
        self.advance()

    @torch.no_grad()
    def restart(self, initial: InitialConditions, external: ExternalForces | None = None) -> None:
        """Begin anew, with a world and pushes of the same shapes."""
        _load((self.initial, self.external), (initial, ExternalForces.none(initial) if external is None else external))
        self.begin()

    def _given(self) -> tuple[Any, tuple, Tensor]:
        """The scene, its state at time 0, and where the keypoints are."""
        scene = self.model.prepare(self.initial)
        state = self.model.initial_state(scene)
        return scene, state, self.model.points(scene, state)

    def _begin(self) -> None:
        self.scene, state, points = self._given()  # a recorded scene lies in the memory of its graph
        _load((self.state, self.points), (state, points))
        self.step_count.zero_()

    def _step(self) -> None:
        _advance(self.model, self.scene, self.state, self.points, self.external, self.step_count, self.dt)


def _copy(tree: Any) -> Any:
    """The same with tensors of their own, each one block of memory."""
    return replace_tensors(tree, (x.clone(memory_format=torch.contiguous_format) for x in leaf_tensors(tree)))


def _load(mine: tuple, new: tuple) -> None:
    for x, y in zip(leaf_tensors(mine), leaf_tensors(new), strict=True):
        if x.shape != y.shape:
            raise ValueError(f"made for {tuple(x.shape)}, not {tuple(y.shape)}")
    torch._foreach_copy_(list(leaf_tensors(mine)), list(leaf_tensors(new)))  # on a GPU all in one kernel


def _recorded(work: Callable[[], None]) -> Callable[[], None]:
    """What replays the launches of `work`. It is also done, twice before, to load and tune whatever it uses, and after,
    as recording alone leaves what it makes empty."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(2):
            work()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        work()
    graph.replay()
    return graph.replay


def _advance(
    model: Dynamics, scene: Any, state: tuple, points: Tensor, external: ExternalForces, time: Tensor, dt: float
) -> None:
    """A step in place; `time` counts steps, so that it stays exact."""
    new = model.step(scene, state, time.to(state[0]) * dt, dt, external)
    torch._foreach_copy_([*state, points], [*new, model.points(scene, new)])  # on a GPU all in one kernel
    time += 1


@torch.no_grad()
def rollout(
    model: Dynamics, initial: InitialConditions, steps: int, dt: float = FRAME, external: ExternalForces | None = None
) -> Float[Tensor, "b t o n 3"]:
    """What `model.rollout` gives, with the speed of a Stepper: keypoints in `steps` frames, the first the start."""
    out = record_frames(TimeStepper(model, initial, dt, external), steps)
    return out.masked_fill_(~initial.valid[:, None, ..., None], 0.0)


@torch.no_grad()
def record_frames(stepper: TimeStepper, steps: int) -> Float[Tensor, "b t o n 3"]:
    """Keypoints now and after each of steps - 1 further steps; anything where padded."""
    b, o, n, _ = stepper.points.shape
    out = stepper.points.new_empty(b, steps, o, n, 3)
    for t in range(steps):
        if t:
            stepper.step()
        out[:, t] = stepper.points
    return out
