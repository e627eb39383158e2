"""What all dynamics models share: an ODE right-hand side, a step, a rollout.

    scene = model.prepare(world)
    state = model.start(scene)
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

from stages.core.models.external_forces import Pushes
from stages.core.models.initial_conditions import World, offsets
from stages.core.models.integrate import solve

FRAME = 0.02  # time between the frames that maps from frame to frame were made for [s]


class Dynamics(nn.Module, ABC):
    """A model of how keypoints move. A model defines `start`, `observe`, `derivative` and `points`.

    `told` are the fields of World that reach the model; the rest it cannot know about, and whoever runs it can warn.
    `config` are the arguments that build it again.
    """

    told: ClassVar[frozenset[str]] = frozenset()
    config: dict

    def rest(self, world: World) -> Any:
        """What can be computed of a world without any parameter; it can be indexed by scenes as a world can."""
        return world

    def prepare(self, world: World) -> Any:
        """The `scene` of the other methods: the world, with whatever a model computes once for a rollout."""
        return self.informed(self.rest(world))

    def informed(self, rest: Any) -> Any:
        """The second half of `prepare`, which depends on parameters."""
        return rest

    @abstractmethod
    def start(self, scene: Any) -> tuple:
        """The state at time 0: a NamedTuple of tensors with the batch first."""

    @abstractmethod
    def observe(self, scene: Any, points: Float[Tensor, "b o n 3"], speed: Float[Tensor, "b o n 3"]) -> tuple:
        """The state in which keypoints are at `points` [m] and move with `speed` [m/s]: to start amid a motion."""

    @abstractmethod
    def derivative(self, scene: Any, t: Tensor | float, state: tuple, pushes: Pushes) -> tuple:
        """Rate of change of the state [per s] at time t [s]."""

    @abstractmethod
    def points(self, scene: Any, state: tuple) -> Float[Tensor, "b o n 3"]:
        """Where the keypoints are in a state [m]."""

    def speed(self, scene: Any, state: tuple, pushes: Pushes) -> Float[Tensor, "b o n 3"]:
        """How fast the keypoints move in a state [m/s]. Unless a model knows better: along the rate of the state."""
        rate = self.derivative(scene, 0.0, state, pushes)
        return torch.func.jvp(lambda *y: self.points(scene, type(state)(*y)), tuple(state), tuple(rate))[1]

    def step(self, scene: Any, state: tuple, t: Tensor | float, dt: float, pushes: Pushes) -> tuple:
        """The state dt [s] later. Unless a model knows better: one explicit Euler step."""
        rate = self.derivative(scene, t, state, pushes)
        return type(state)(*(y + dt * dy for y, dy in zip(state, rate, strict=True)))

    def rollout(
        self, world: World, steps: int, dt: float = FRAME, method: str = "step", pushes: Pushes | None = None,
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
        pushes = Pushes.none(world) if pushes is None else pushes
        scene = self.prepare(world)
        start = self.start(scene) if start is None else self.observe(scene, *start)
        if method == "step":
            states = self._walk(scene, start, steps, dt, pushes, substeps)
        else:
            times = dt * torch.arange(steps, dtype=start[0].dtype, device=start[0].device)
            rows = solve(
                lambda t, state: self.derivative(scene, t, state, pushes), start, times, method, substeps,
                self.learned(scene) if adjoint else None,
            )  # fmt: skip
            states = (type(start)(*(y[i] for y in rows)) for i in range(steps))
        points = torch.stack([self.points(scene, state) for state in states], 1)
        return points.masked_fill(~world.valid[:, None, ..., None], 0.0)

    def _walk(
        self, scene: Any, state: tuple, steps: int, dt: float, pushes: Pushes, substeps: int
    ) -> Iterator[tuple]:
        """The states of each frame."""
        yield state
        for frame in range(steps - 1):
            for i in range(substeps):
                state = self.step(scene, state, dt * (frame + i / substeps), dt / substeps, pushes)
            yield state

    def learned(self, scene: Any) -> list[Tensor]:
        """Tensors between which and the motion the adjoint equation shall find gradients."""
        return list(self.parameters())


class PointState(NamedTuple):
    """Every keypoint on its own."""

    position: Float[Tensor, "b o n 3"]  # [m]
    velocity: Float[Tensor, "b o n 3"]  # [m/s]


class PointDynamics(Dynamics):
    """A model whose state is the position and the velocity of every keypoint."""

    def start(self, world: World) -> PointState:
        arm = offsets(world, world.points)
        spun = torch.linalg.cross(world.spin[:, :, None].expand_as(arm), arm)
        return PointState(world.points, torch.where(world.valid[..., None], world.velocity[:, :, None] + spun, 0.0))

    def observe(
        self, world: World, points: Float[Tensor, "b o n 3"], speed: Float[Tensor, "b o n 3"]
    ) -> PointState:
        there = world.valid[..., None]
        return PointState(torch.where(there, points, 0.0), torch.where(there, speed, 0.0))

    def points(self, world: World, state: PointState) -> Float[Tensor, "b o n 3"]:
        return state.position


def free(world: World, pushes: Pushes) -> Bool[Tensor, "b o n 1"]:
    """Keypoints that may move: neither padding nor of a pinned object."""
    return (world.valid & ~pushes.pinned[..., None])[..., None]
