"""What all dynamics models share: an ODE right-hand side, a step, a rollout.

scene = model.prepare(world)
state = model.initial_state(scene)
state = model.step(scene, state, t, dt, pushes)  # as often as you like, with pushes that change
model.points(scene, state)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions, offsets
from stages.core.models.integrate import solve_ode

FRAME = 0.02  # time between the frames that maps from frame to frame were made for [s]


class Dynamics(nn.Module, ABC):
    """A model of how keypoints move. A model defines `start`, `observe`, `derivative` and `points`.

    `told` are the fields of World that reach the model; the rest it cannot know about, and whoever runs it can warn.
    `config` are the arguments that build it again.
    """

    inputs: ClassVar[frozenset[str]] = frozenset()
    config: dict

    def precompute(self, initial: InitialConditions) -> Any:
        """What can be computed of a world without any parameter; it can be indexed by scenes as a world can."""
        return initial

    def prepare(self, initial: InitialConditions) -> Any:
        """The `scene` of the other methods: the world, with whatever a model computes once for a rollout."""
        return self.encode(self.precompute(initial))

    def encode(self, rest: Any) -> Any:
        """The second half of `prepare`, which depends on parameters."""
        return rest

    @abstractmethod
    def initial_state(self, scene: Any) -> tuple:
        """The state at time 0: a NamedTuple of tensors with the batch first."""

    @abstractmethod
    def state_from_motion(self, scene: Any, points: Float[Tensor, "b o n 3"], speed: Float[Tensor, "b o n 3"]) -> tuple:
        """The state in which keypoints are at `points` [m] and move with `speed` [m/s]: to start amid a motion."""

    @abstractmethod
    def derivative(self, scene: Any, t: Tensor | float, state: tuple, external: ExternalForces) -> tuple:
        """Rate of change of the state [per s] at time t [s]."""

    @abstractmethod
    def points(self, scene: Any, state: tuple) -> Float[Tensor, "b o n 3"]:
        """Where the keypoints are in a state [m]."""

    def point_velocity(self, scene: Any, state: tuple, external: ExternalForces) -> Float[Tensor, "b o n 3"]:
        """How fast the keypoints move in a state [m/s]. Unless a model knows better: along the rate of the state."""
        rate = self.derivative(scene, 0.0, state, external)
        return torch.func.jvp(lambda *y: self.points(scene, type(state)(*y)), tuple(state), tuple(rate))[1]

    def step(self, scene: Any, state: tuple, t: Tensor | float, dt: float, external: ExternalForces) -> tuple:
        """The state dt [s] later. Unless a model knows better: one explicit Euler step."""
        rate = self.derivative(scene, t, state, external)
        return type(state)(*(y + dt * dy for y, dy in zip(state, rate, strict=True)))

    def rollout(
        self, initial: InitialConditions, steps: int, dt: float = FRAME, method: str = "step",
        external: ExternalForces | None = None,
        substeps: int = 1, adjoint: bool = False,
        start: tuple[Float[Tensor, "b o n 3"], Float[Tensor, "b o n 3"]] | None = None,
    ) -> Float[Tensor, "b t o n 3"]:  # fmt: skip
        """Keypoints in `steps` frames dt [s] apart, the first being the start; 0 where padded.

        `method` is "step", the model's own, or one of `integrate.METHODS`; `substeps` cuts each frame into so many.
        `start` are keypoints and their speeds to begin with, instead of those of the world, whose shapes stay those at
        rest. With `adjoint` (not for "step"), gradients of the parameters come from the adjoint equation.
        """
        if adjoint and method == "step":
            raise ValueError("the adjoint equation needs an ODE method")
        external = ExternalForces.none(initial) if external is None else external
        scene = self.prepare(initial)
        start = self.initial_state(scene) if start is None else self.state_from_motion(scene, *start)
        if method == "step":
            states = self._walk(scene, start, steps, dt, external, substeps)
        else:
            times = dt * torch.arange(steps, dtype=start[0].dtype, device=start[0].device)
            rows = solve_ode(
                lambda t, state: self.derivative(scene, t, state, external), start, times, method, substeps,
                self.adjoint_tensors(scene) if adjoint else None,
            )  # fmt: skip
            states = (type(start)(*(y[i] for y in rows)) for i in range(steps))
        points = torch.stack([self.points(scene, state) for state in states], 1)
        return points.masked_fill(~initial.valid[:, None, ..., None], 0.0)

    def _walk(
        self, scene: Any, state: tuple, steps: int, dt: float, external: ExternalForces, substeps: int
    ) -> Iterator[tuple]:
        """The states of each frame."""
        yield state
        for frame in range(steps - 1):
            for i in range(substeps):
                state = self.step(scene, state, dt * (frame + i / substeps), dt / substeps, external)
            yield state

    def adjoint_tensors(self, scene: Any) -> list[Tensor]:
        """Tensors between which and the motion the adjoint equation shall find gradients."""
        return list(self.parameters())


class PointState(NamedTuple):
    """Every keypoint on its own."""

    position: Float[Tensor, "b o n 3"]  # [m]
    velocity: Float[Tensor, "b o n 3"]  # [m/s]


class PointDynamics(Dynamics):
    """A model whose state is the position and the velocity of every keypoint."""

    def initial_state(self, initial: InitialConditions) -> PointState:
        arm = offsets(initial, initial.points)
        spun = torch.linalg.cross(initial.spin[:, :, None].expand_as(arm), arm)
        return PointState(
            initial.points, torch.where(initial.valid[..., None], initial.velocity[:, :, None] + spun, 0.0)
        )

    def state_from_motion(
        self, initial: InitialConditions, points: Float[Tensor, "b o n 3"], speed: Float[Tensor, "b o n 3"]
    ) -> PointState:
        there = initial.valid[..., None]
        return PointState(torch.where(there, points, 0.0), torch.where(there, speed, 0.0))

    def points(self, initial: InitialConditions, state: PointState) -> Float[Tensor, "b o n 3"]:
        return state.position


def movable(initial: InitialConditions, external: ExternalForces) -> Bool[Tensor, "b o n 1"]:
    """Keypoints that may move: neither padding nor of a pinned object."""
    return (initial.valid & ~external.pinned[..., None])[..., None]
