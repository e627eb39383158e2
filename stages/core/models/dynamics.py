"""Interface of all dynamics models: the right-hand side of an ODE, a step and a rollout.

scene = model.prepare(initial)
state = model.initial_state(scene)
state = model.step(scene, state, t, dt, external)  # external forces may change between steps
model.points(scene, state)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions, offsets
from stages.core.models.integrate import Integration, solve_ode

FRAME = 0.02  # time between frames of the training data, and time step of frame-to-frame models [s]


class Dynamics(nn.Module, ABC):
    """A model of the motion of keypoints.

    A model defines `initial_state`, `state_from_motion`, `derivative` and `points`.
    `inputs`: the fields of InitialConditions that the model uses; callers warn about fields that it ignores.
    `config`: the constructor arguments, from which the model can be rebuilt.
    A step must not synchronise with the GPU, since steps are captured as CUDA graphs.
    """

    inputs: ClassVar[frozenset[str]] = frozenset()
    config: dict

    def precompute(self, initial: InitialConditions) -> Any:
        """The part of `prepare` without parameters; like InitialConditions it can be indexed by scene."""
        return initial

    def prepare(self, initial: InitialConditions) -> Any:
        """Return the `scene` argument of the other methods: all values that a model computes once per rollout."""
        return self.encode(self.precompute(initial))

    def encode(self, precomputed: Any) -> Any:
        """The part of `prepare` that depends on parameters."""
        return precomputed

    @abstractmethod
    def initial_state(self, scene: Any) -> tuple:
        """Return the state at time 0: a NamedTuple of tensors, batch first."""

    @abstractmethod
    def state_from_motion(
        self, scene: Any, points: Float[Tensor, "b o n 3"], velocities: Float[Tensor, "b o n 3"]
    ) -> tuple:
        """Return the state with keypoints at `points` [m] moving with `velocities` [m/s], to start during a motion."""

    @abstractmethod
    def derivative(self, scene: Any, t: Tensor | float, state: tuple, external: ExternalForces) -> tuple:
        """Return the rate of change of the state [1/s] at time t [s]."""

    @abstractmethod
    def points(self, scene: Any, state: tuple) -> Float[Tensor, "b o n 3"]:
        """Return the positions of the keypoints in a state [m]."""

    def point_velocity(self, scene: Any, state: tuple, external: ExternalForces) -> Float[Tensor, "b o n 3"]:
        """Return the velocities of the keypoints in a state [m/s]; by default the time derivative of `points`."""
        rate = self.derivative(scene, 0.0, state, external)
        return torch.func.jvp(lambda *y: self.points(scene, type(state)(*y)), tuple(state), tuple(rate))[1]

    def step(self, scene: Any, state: tuple, t: Tensor | float, dt: float, external: ExternalForces) -> tuple:
        """Return the state dt [s] later; by default by one explicit Euler step."""
        rate = self.derivative(scene, t, state, external)
        return type(state)(*(y + dt * dy for y, dy in zip(state, rate, strict=True)))

    def stepping(self, scene: Any, dt: float, external: ExternalForces) -> Callable[[tuple, Tensor | float], tuple]:
        """Return `step` as a function of state and time, for many steps with the same other arguments."""
        return lambda state, t: self.step(scene, state, t, dt, external)

    def advance(
        self, scene: Any, state: tuple, interval: tuple[Tensor, float], external: ExternalForces, method: str = "step"
    ) -> tuple:
        """Return the state at the end of `interval` (t, dt) [s]; `method` as in `Integration`."""
        t, dt = interval
        if method == "step":
            return self.step(scene, state, t, dt, external)
        ends = solve_ode(
            lambda time, y: self.derivative(scene, time, y, external), state, torch.stack([t, t + dt]), method
        )  # fmt: skip
        return type(state)(*(y[-1] for y in ends))

    def rollout(
        self, initial: InitialConditions, steps: int, dt: float = FRAME, external: ExternalForces | None = None,
        integration: Integration = Integration(),  # noqa: B008 -- frozen
        start: tuple[Float[Tensor, "b o n 3"], Float[Tensor, "b o n 3"]] | None = None,
    ) -> Float[Tensor, "b t o n 3"]:  # fmt: skip
        """Return keypoints [m] in `steps` frames dt [s] apart, the first at time 0; 0 where padded.

        start: positions [m] and velocities [m/s] of the keypoints at time 0, which replace those of `initial`; the rest
            shapes remain those of `initial`.
        """
        external = ExternalForces.none(initial) if external is None else external
        scene = self.prepare(initial)
        state = self.initial_state(scene) if start is None else self.state_from_motion(scene, *start)
        if integration.method == "step":
            states = self._states(scene, state, (steps, dt, integration.substeps), external)
        else:
            times = dt * torch.arange(steps, dtype=state[0].dtype, device=state[0].device)
            rows = solve_ode(
                lambda t, y: self.derivative(scene, t, y, external), state, times, integration.method,
                integration.substeps, list(self.parameters()) if integration.adjoint else None,
            )  # fmt: skip
            states = (type(state)(*(y[i] for y in rows)) for i in range(steps))
        points = torch.stack([self.points(scene, state) for state in states], 1)
        return points.masked_fill(~initial.valid[:, None, ..., None], 0.0)

    def _states(
        self, scene: Any, state: tuple, grid: tuple[int, float, int], external: ExternalForces
    ) -> Iterator[tuple]:
        """Yield the state of each frame; `grid` is the number of frames, the time between them [s], steps per frame."""
        frames, dt, substeps = grid
        step = self.stepping(scene, dt / substeps, external)
        yield state
        for frame in range(frames - 1):
            for i in range(substeps):
                state = step(state, dt * (frame + i / substeps))
            yield state


class PointState(NamedTuple):
    """Positions and velocities of all keypoints."""

    position: Float[Tensor, "b o n 3"]  # [m]
    velocity: Float[Tensor, "b o n 3"]  # [m/s]


class PointDynamics(Dynamics):
    """A model whose state is a PointState and whose `scene` is the InitialConditions."""

    def initial_state(self, scene: InitialConditions) -> PointState:
        """Return keypoints in rigid motion with the velocity and spin of their object; velocity 0 where padded."""
        arm = offsets(scene, scene.points)
        velocity = scene.velocity[:, :, None] + torch.linalg.cross(scene.spin[:, :, None].expand_as(arm), arm)
        return PointState(scene.points, torch.where(scene.valid[..., None], velocity, 0.0))

    def state_from_motion(
        self, scene: InitialConditions, points: Float[Tensor, "b o n 3"], velocities: Float[Tensor, "b o n 3"]
    ) -> PointState:
        """Return the given positions [m] and velocities [m/s]; 0 where padded."""
        valid = scene.valid[..., None]
        return PointState(torch.where(valid, points, 0.0), torch.where(valid, velocities, 0.0))

    def points(self, scene: InitialConditions, state: PointState) -> Float[Tensor, "b o n 3"]:
        """Return the positions of the state [m]."""
        return state.position


def movable(initial: InitialConditions, external: ExternalForces) -> Bool[Tensor, "b o n 1"]:
    """Mask of keypoints that may move: not padding, and not of a pinned object."""
    return (initial.valid & ~external.pinned[..., None])[..., None]
