"""External forces (force prompts) and pinned objects as tensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.symmetric_matrices import symmetric_solve
from stages.core.models.initial_conditions import InitialConditions, centre_of_mass, inertia
from stages.core.physics.forces import ForcePrompts


@dataclass(frozen=True)
class ExternalForces:
    """External forces j of each scene and pinned objects; entries with zero force and torque are padding."""

    object: Int[Tensor, "b j"]  # row of the object acted on
    force: Float[Tensor, "b j 3"]  # [N]
    torque: Float[Tensor, "b j 3"]  # about the centre of mass [N m]
    start: Float[Tensor, "b j"]  # [s]
    end: Float[Tensor, "b j"]  # [s]
    point: Int[Tensor, "b j"]  # keypoint at which the force acts; -1: at the centre of mass
    pinned: Bool[Tensor, "b o"]  # objects that do not move

    @classmethod
    def none(cls, initial: InitialConditions) -> ExternalForces:
        """No forces and no pinned objects."""
        return cls.none_for(initial.valid, initial.points)

    @classmethod
    def none_for(cls, valid: Bool[Tensor, "b o n"], like: Tensor) -> ExternalForces:
        """As `none`, but from the `valid` mask alone, in the precision of `like`."""
        b, o, _ = valid.shape
        whole, real, vector = valid.new_zeros(b, 0, dtype=torch.int64), like.new_zeros(b, 0), like.new_zeros(b, 0, 3)
        return cls(whole, vector, vector, real, real, whole, valid.new_zeros(b, o))

    @classmethod
    def from_prompts(cls, initial: InitialConditions, prompts: ForcePrompts, ids: list[int]) -> ExternalForces:
        """Convert a user's prompts to forces and pins for a batch of one scene, whose rows are the objects `ids`.

        A force at a point acts at the nearest keypoint. Velocities and lifts are not applied here; they belong in
        `initial`.
        """
        real = {"dtype": initial.points.dtype, "device": initial.points.device}
        forces = prompts.forces
        rows = torch.tensor([[ids.index(f.object_id) for f in forces]], dtype=torch.int64, device=real["device"])
        pinned = torch.tensor([[i in prompts.pinned for i in ids]], device=real["device"])
        points = [-1 if f.at is None else _nearest_keypoint(initial, ids.index(f.object_id), f.at) for f in forces]
        return cls(
            rows,
            torch.tensor([[f.force for f in forces]], **real).reshape(1, -1, 3),
            torch.tensor([[f.torque for f in forces]], **real).reshape(1, -1, 3),
            torch.tensor([[f.start for f in forces]], **real),
            torch.tensor([[f.end for f in forces]], **real),
            torch.tensor([points], dtype=torch.int64, device=real["device"]),
            pinned,
        )

    def to(self, target: torch.device | str) -> ExternalForces:
        """Return a copy on another device."""
        return ExternalForces(**{f.name: getattr(self, f.name).to(target) for f in fields(self)})

    def active_fraction(self, t: Tensor | float, dt: float = 0.0) -> Float[Tensor, "b j"]:
        """Fraction of the time from `t` to `t + dt` [s] that each force acts; for dt = 0, 1 if it acts at time t."""
        if not dt:
            return ((self.start < t) & (t < self.end)).to(self.force)
        last = torch.clamp(self.end, max=t + dt)
        return (last - torch.clamp(self.start, min=t)).clamp_min(0) / dt

    def wrench(
        self, points: Float[Tensor, "b o n 3"], com: Float[Tensor, "b o 3"], t: Tensor | float, dt: float = 0.0
    ) -> tuple[Float[Tensor, "b o 3"], Float[Tensor, "b o 3"]]:
        """Mean force [N] and torque about the centre of mass [N m] on each object from t to t + dt [s].

        `points` are the positions of the keypoints and `com` the centres of mass [m].
        """
        if not self.object.shape[1]:
            return torch.zeros_like(com), torch.zeros_like(com)
        on = self.active_fraction(t, dt)[..., None]
        force, torque = on * self.force, on * self.torque
        scene = torch.arange(len(points), device=points.device)[:, None]
        arm = points[scene, self.object, self.point.clamp_min(0)] - com[scene, self.object]
        torque = torque + torch.where(self.point[..., None] >= 0, torch.linalg.cross(arm, force), 0.0)
        row = self.object[..., None].expand_as(force)
        zero = torch.zeros_like(com)
        return zero.scatter_add(1, row, force), zero.scatter_add(1, row, torque)

    def acceleration(
        self, initial: InitialConditions, points: Float[Tensor, "b o n 3"], t: Tensor | float, dt: float = 0.0
    ) -> Float[Tensor, "b o n 3"]:
        """Acceleration of every keypoint due to the external forces [m/s^2], with each object taken as rigid."""
        if not self.object.shape[1]:
            return torch.zeros_like(points)
        com = centre_of_mass(initial, points)
        force, torque = self.wrench(points, com, t, dt)
        arm = torch.where(initial.valid[..., None], points - com[:, :, None], 0.0)
        (angular,) = symmetric_solve(inertia(initial.mass_fraction, arm), torque)
        rotation = torch.linalg.cross(angular[:, :, None].expand_as(arm), arm)
        return torch.where(
            initial.valid[..., None], (force[:, :, None] + rotation) / initial.mass[..., None, None], 0.0
        )


def _nearest_keypoint(initial: InitialConditions, row: int, at: tuple[float, float, float]) -> int:
    distance = (initial.points[0, row] - torch.tensor(at).to(initial.points)).norm(dim=-1)
    return int(torch.where(initial.valid[0, row], distance, math.inf).argmin())
