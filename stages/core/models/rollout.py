"""Fast rollouts without gradients; on CUDA, `prepare` and `step` are captured as CUDA graphs.

    stepper = TimeStepper(model, initial)
    for _ in range(steps):
        stepper.step()
        stepper.points  # positions of the keypoints at the new time

A step of a model launches hundreds of small kernels; launching them one by one takes about ten times as long as running
them. A graph launches all of them at once. `step` is captured at its first call, `prepare` at the first `restart`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.kernels.cuda_graphs import captured
from stages.core.models.dynamics import FRAME, Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions
from stages.core.models.trees import leaf_tensors, replace_tensors


class TimeStepper:
    """A batch of scenes that advances by dt [s] with every `step`.

    `state`, `points` [m], `external` and `step_count` are tensors at fixed addresses: only their contents change, and
    `external` and `step_count` may be written to between steps.
    `method` is "step", the model's own step, or a solver of `integrate.METHODS`. Only "step" is captured as a CUDA
    graph, because the solvers of torchdiffeq synchronise with the host.
    """

    @torch.no_grad()
    def __init__(
        self, model: Dynamics, initial: InitialConditions, dt: float = FRAME, external: ExternalForces | None = None,
        method: str = "step",
    ):  # fmt: skip
        self.model, self.dt, self.method = model, dt, method
        inputs = initial, ExternalForces.none(initial) if external is None else external
        self.initial, self.external = _copy(inputs)
        self.step_count = torch.zeros((), dtype=torch.int64, device=initial.points.device)
        self.scene, state, points = self._prepared()
        self.state, self.points = _copy((state, points))
        self._replay_begin: Callable[[], None] | None = None
        self._replay_step: Callable[[], None] | None = None

    @torch.no_grad()
    def step(self) -> None:
        """Advance by dt."""
        if not self.step_count.is_cuda or self.method != "step":
            return self._step()
        if self._replay_step is None:
            self._replay_step = self._captured_step()
        self._replay_step()

    @torch.no_grad()
    def restart(self, initial: InitialConditions, external: ExternalForces | None = None) -> None:
        """Restart at time 0 from inputs of the same shapes. Raises ValueError for other shapes."""
        external = ExternalForces.none(initial) if external is None else external
        _load((self.initial, self.external), (initial, external))
        if not self.step_count.is_cuda:
            return self._begin()
        if self._replay_begin is None:  # recapture the step too: it must read the scene in the memory of this graph
            self._replay_begin, self._replay_step = _captured(self._begin), None
        self._replay_begin()

    @torch.no_grad()
    def change(self, initial: InitialConditions) -> None:
        """Continue from the current state with other masses, materials or gravity, for the same shapes."""
        _load((self.initial,), (initial,))
        _load((self.scene,), (self.model.prepare(self.initial),))

    def saved(self) -> list[Tensor]:
        """Return a copy of the tensors that a step changes, for `restore`."""
        return [x.clone() for x in self._changing]

    def restore(self, saved: list[Tensor]) -> None:
        """Return to the state that `saved` returned."""
        torch._foreach_copy_(self._changing, saved)

    @property
    def _changing(self) -> list[Tensor]:
        return [*self.state, self.points, self.step_count]

    def _prepared(self) -> tuple[Any, tuple, Tensor]:
        """Return the scene, its state at time 0 and the positions of its keypoints."""
        scene = self.model.prepare(self.initial)
        state = self.model.initial_state(scene)
        return scene, state, self.model.points(scene, state)

    def _begin(self) -> None:
        self.scene, state, points = self._prepared()
        _load((self.state, self.points), (state, points))
        self.step_count.zero_()

    def _step(self) -> None:
        """Advance in place; time is counted in steps, so that it does not accumulate rounding errors."""
        interval = self.step_count.to(self.state[0]) * self.dt, self.dt
        new = self.model.advance(self.scene, self.state, interval, self.external, self.method)
        # one kernel for all copies on a GPU
        torch._foreach_copy_([*self.state, self.points], [*new, self.model.points(self.scene, new)])
        self.step_count += 1

    def _captured_step(self) -> Callable[[], None]:
        """Capture `_step` as a CUDA graph, and restore the state, since the capture runs some steps."""
        before = self.saved()
        replay = _captured(self._step)
        self.restore(before)
        return replay


def _copy(tree: Any) -> Any:
    """Return the same structure with contiguous copies of its tensors."""
    return replace_tensors(tree, (x.clone(memory_format=torch.contiguous_format) for x in leaf_tensors(tree)))


def _load(target: tuple, source: tuple) -> None:
    for x, y in zip(leaf_tensors(target), leaf_tensors(source), strict=True):
        if x.shape != y.shape:
            raise ValueError(f"made for {tuple(x.shape)}, not {tuple(y.shape)}")
    torch._foreach_copy_(list(leaf_tensors(target)), list(leaf_tensors(source)))  # one kernel for all on a GPU


def _captured(work: Callable[[], None]) -> Callable[[], None]:
    """Capture `work` as a CUDA graph; calling the result replays its kernel launches.

    `work` runs twice before the capture, to load and tune kernels; the capture itself does not execute them.
    """
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(2):
            work()
    torch.cuda.current_stream().wait_stream(side)
    return captured(work).replay


@torch.no_grad()
def record_frames(stepper: TimeStepper, steps: int) -> Float[Tensor, "b t o n 3"]:
    """Return keypoints [m] now and after each of `steps` - 1 further steps; undefined where padded."""
    b, o, n, _ = stepper.points.shape
    out = stepper.points.new_empty(b, steps, o, n, 3)
    for t in range(steps):
        if t:
            stepper.step()
        out[:, t] = stepper.points
    return out
