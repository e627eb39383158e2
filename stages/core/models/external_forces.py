"""Force prompts as tensors: who is pushed, how hard, when, and who is held."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.models.field.equivariant import symmetric_solve
from stages.core.models.initial_conditions import InitialConditions, centre_of_mass, inertia
from stages.core.physics.forces import ForcePrompts


@dataclass(frozen=True)
class ExternalForces:
    """Pushes j of each scene; one without force and torque is padding."""

    object: Int[Tensor, "b j"]  # row of the object that is pushed
    force: Float[Tensor, "b j 3"]  # [N]
    torque: Float[Tensor, "b j 3"]  # about the centre of mass [N m]
    start: Float[Tensor, "b j"]  # [s]
    end: Float[Tensor, "b j"]  # [s]
    point: Int[Tensor, "b j"]  # the keypoint that is pushed; -1 is the whole object
    pinned: Bool[Tensor, "b o"]  # objects that stay where they are

    @classmethod
    def none(cls, initial: InitialConditions) -> ExternalForces:
        """Nobody is pushed or held."""
        return cls.none_for(initial.valid, initial.points)

    @classmethod
    def none_for(cls, valid: Bool[Tensor, "b o n"], like: Tensor) -> ExternalForces:
        """The same for objects of whose world only `valid` is at hand, in the precision of `like`."""
        b, o, _ = valid.shape
        whole, real, vector = valid.new_zeros(b, 0, dtype=torch.int64), like.new_zeros(b, 0), like.new_zeros(b, 0, 3)
        return cls(whole, vector, vector, real, real, whole, valid.new_zeros(b, o))

    @classmethod
    def from_prompts(cls, initial: InitialConditions, prompts: ForcePrompts, ids: list[int]) -> ExternalForces:
        """The pushes and pins of a user's prompts for a world of one scene, whose rows are the objects `ids`.

        A push at a place takes hold of the keypoint nearest to it. Velocities and lifts belong into the world.
        """
        real = {"dtype": initial.points.dtype, "device": initial.points.device}
        forces = prompts.forces
        rows = torch.tensor([[ids.index(f.object_id) for f in forces]], dtype=torch.int64, device=real["device"])
        held = torch.tensor([[i in prompts.pinned for i in ids]], device=real["device"])
        points = [-1 if f.at is None else _nearest(initial, ids.index(f.object_id), f.at) for f in forces]
        return cls(
            rows,
            torch.tensor([[f.force for f in forces]], **real).reshape(1, -1, 3),
            torch.tensor([[f.torque for f in forces]], **real).reshape(1, -1, 3),
            torch.tensor([[f.start for f in forces]], **real),
            torch.tensor([[f.end for f in forces]], **real),
            torch.tensor([points], dtype=torch.int64, device=real["device"]),
            held,
        )

    def to(self, target: torch.device | str) -> ExternalForces:
        """On another device."""
        return ExternalForces(**{f.name: getattr(self, f.name).to(target) for f in fields(self)})

    def active_fraction(self, t: Tensor | float, dt: float = 0.0) -> Float[Tensor, "b j"]:
        """Share of the time from `t` to `t + dt` [s] in which each push acts; of the instant t (1 or 0) for dt = 0."""
        if not dt:
            return ((self.start < t) & (t < self.end)).to(self.force)
        last = torch.clamp(self.end, max=t + dt)
        return (last - torch.clamp(self.start, min=t)).clamp_min(0) / dt

    def wrench(
        self, points: Float[Tensor, "b o n 3"], com: Float[Tensor, "b o 3"], t: Tensor | float, dt: float = 0.0
    ) -> tuple[Float[Tensor, "b o 3"], Float[Tensor, "b o 3"]]:
        """Force [N] and torque about the centre of mass [N m] on each object, its keypoints being at `points`."""
        if not self.object.shape[1]:
            return torch.zeros_like(com), torch.zeros_like(com)
        on = self.active_fraction(t, dt)[..., None]
        force, torque = on * self.force, on * self.torque
        scene = torch.arange(len(points), device=points.device)[:, None]
        arm = points[scene, self.object, self.point.clamp_min(0)] - com[scene, self.object]
        torque = torque + torch.where(self.point[..., None] >= 0, torch.linalg.cross(arm, force), 0.0)
        row = self.object[..., None].expand_as(force)
        none_for = torch.zeros_like(com)
        return none_for.scatter_add(1, row, force), none_for.scatter_add(1, row, torque)

    def acceleration(
        self, initial: InitialConditions, points: Float[Tensor, "b o n 3"], t: Tensor | float, dt: float = 0.0
    ) -> Float[Tensor, "b o n 3"]:
        """What the pushes add to the acceleration of every keypoint, taking each object as rigid [m/s^2]."""
        if not self.object.shape[1]:
            return torch.zeros_like(points)
        com = centre_of_mass(initial, points)
        force, torque = self.wrench(points, com, t, dt)
        arm = torch.where(initial.valid[..., None], points - com[:, :, None], 0.0)
        (turning,) = symmetric_solve(inertia(initial.mass_fraction, arm), torque)
        spun = torch.linalg.cross(turning[:, :, None].expand_as(arm), arm)
        return torch.where(initial.valid[..., None], (force[:, :, None] + spun) / initial.mass[..., None, None], 0.0)


def _nearest(initial: InitialConditions, row: int, place: tuple[float, float, float]) -> int:
    distance = (initial.points[0, row] - torch.tensor(place).to(initial.points)).norm(dim=-1)
    return int(torch.where(initial.valid[0, row], distance, math.inf).argmin())
