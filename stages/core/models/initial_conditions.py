"""Initial conditions of a batch of scenes, the input of every dynamics model: objects, materials and room.

Lengths are in metres, z is up. Scenes of a batch may have different numbers of objects and keypoints; the rest is
padding, marked in `valid`, which never changes a result.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

FLOOR = -0.94  # height of the floor in the published simulation [m]
BOX = ((-1.94, -1.94, FLOOR), (1.94, 1.94, 2.94))  # lower and upper corner of the room in the published simulation [m]
GRAVITY = (0.0, 0.0, -5.0)  # gravity in the published simulation [m/s^2]


@dataclass(frozen=True)
class InitialConditions:
    """A batch of scenes at time 0; `InitialConditions.of` fills in defaults."""

    points: Float[Tensor, "b o n 3"]  # keypoints of the undeformed objects at time 0 [m]; 0 where padded
    valid: Bool[Tensor, "b o n"]  # False where padded
    mass_fraction: Float[Tensor, "b o n"]  # share of each keypoint in its object's mass; sums to 1, 0 where padded
    mass: Float[Tensor, "b o"]  # [kg]
    E: Float[Tensor, "b o"]  # Young's modulus [Pa]
    solidity: Float[Tensor, "b o"]  # stiffness relative to a hollow or thin body of the same E, see field.solidity
    nu: Float[Tensor, "b o"]  # Poisson's ratio
    friction: Float[Tensor, "b o"]  # Coulomb coefficient
    loss: Float[Tensor, "b o"]  # loss factor of the material, see physics.materials
    velocity: Float[Tensor, "b o 3"]  # of the centre of mass [m/s]
    spin: Float[Tensor, "b o 3"]  # angular velocity, world axes [rad/s]
    gravity: Float[Tensor, "b 3"]  # [m/s^2]
    body_inertia: Float[Tensor, "b o 3 3"]  # inertia about the centre of mass at time 0, per unit of mass [m^2]
    box: Float[Tensor, "b o 2 3"]  # lower and upper corner of the room for each object; the floor is the lower z [m]

    @classmethod
    def of(
        cls, points: Float[Tensor, "b o n 3"], valid: Bool[Tensor, "b o n"] | None = None, **given: Tensor
    ) -> InitialConditions:
        """Build initial conditions from keypoints; other fields by keyword, broadcast to their shape.

        Defaults: 1 kg, 1e5 Pa, solidity 1, Poisson 0.3, friction 0.5, loss factor 0.1, at rest, the published gravity
        and room, and the inertia of the keypoints, which is that of a hollow body.
        Raises TypeError for an unknown field.
        """
        b, o, n, _ = points.shape
        valid = points.new_ones(b, o, n, dtype=torch.bool) if valid is None else valid
        if "mass_fraction" not in given:
            mass_fraction = valid.to(points)
            given["mass_fraction"] = mass_fraction / mass_fraction.sum(-1, keepdim=True).clamp_min(1)
        if "body_inertia" not in given:
            fraction = given["mass_fraction"].to(points)
            x = torch.where(valid[..., None], points, 0.0)
            arm = x - (fraction[..., None] * x).sum(2, keepdim=True)
            given["body_inertia"] = inertia(fraction, torch.where(valid[..., None], arm, 0.0))
        default = {
            "mass": 1.0, "E": 1e5, "solidity": 1.0, "nu": 0.3, "friction": 0.5, "loss": 0.1, "velocity": 0.0,
            "spin": 0.0, "gravity": GRAVITY, "box": BOX,
        }  # fmt: skip
        shape = {
            "mass_fraction": (b, o, n),
            "body_inertia": (b, o, 3, 3),
            "velocity": (b, o, 3),
            "spin": (b, o, 3),
            "gravity": (b, 3),
            "box": (b, o, 2, 3),
        }
        filled = {
            name: torch.as_tensor(given.pop(name, default.get(name))).to(points)
            for name in ("mass_fraction", "body_inertia", *default)
        }
        # contiguous, since kernels would otherwise copy them at every step
        filled = {name: x.expand(shape.get(name, (b, o))).contiguous() for name, x in filled.items()}
        if given:
            raise TypeError(f"InitialConditions has no field {', '.join(given)}")
        return cls(torch.where(valid[..., None], points, 0.0), valid, **filled)

    @property
    def present(self) -> Bool[Tensor, "b o"]:
        """Mask of objects that are not padding."""
        return self.valid.any(-1)

    @property
    def floor(self) -> Float[Tensor, "b o"]:
        """Height of the floor under each object [m]."""
        return self.box[..., 0, 2]

    def to(self, target: torch.device | torch.dtype | str) -> InitialConditions:
        """Return a copy on another device or in another precision (`valid` stays boolean)."""
        dtype = isinstance(target, torch.dtype)
        moved = {f.name: getattr(self, f.name) for f in fields(self)}
        return InitialConditions(
            **{k: x if dtype and x.dtype == torch.bool else x.to(target) for k, x in moved.items()}
        )

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: slice | Tensor) -> InitialConditions:
        """The scenes `rows`, still a batch."""
        return InitialConditions(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


def centre_of_mass(initial: InitialConditions, points: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o 3"]:
    """Centre of mass [m] of each object whose keypoints are at `points` [m]; also averages velocities."""
    return (initial.mass_fraction[..., None] * points).sum(2)


def offsets(initial: InitialConditions, points: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o n 3"]:
    """Keypoints relative to their object's centre of mass [m]; 0 where padded."""
    return torch.where(initial.valid[..., None], points - centre_of_mass(initial, points)[:, :, None], 0.0)


def inertia(mass_fraction: Float[Tensor, "b o n"], arm: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o 3 3"]:
    """Inertia tensor per unit of mass about the origin of `arm` [m^2].

    A thousandth of the trace of the second moments, plus 1 mm^2, is added to the diagonal, so that the tensor of a rod
    or of a single point is invertible.
    """
    moment = torch.einsum("boni,bonj->boij", mass_fraction[..., None] * arm, arm)
    trace = moment.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(3, dtype=arm.dtype, device=arm.device)
    return (1.001 * trace + 1e-6) * eye - moment
