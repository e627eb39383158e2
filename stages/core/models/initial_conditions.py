"""What every dynamics model is told: the objects at rest, what they are made of, and the room they are in.

Lengths are metres, z is up. Scenes of a batch may have different numbers of objects and keypoints: what is missing is
padding, marked in `valid`, and never changes a result.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

FLOOR = -0.94
BOX = ((-1.94, -1.94, FLOOR), (1.94, 1.94, 2.94))  # the published simulation's [m]
GRAVITY = (0.0, 0.0, -5.0)  # the published simulation's [m/s^2]


@dataclass(frozen=True)
class InitialConditions:
    """A batch of scenes at time 0; `World.of` fills in what is not given."""

    points: Float[Tensor, "b o n 3"]  # keypoints at rest, where they start [m]; 0 where padded
    valid: Bool[Tensor, "b o n"]
    mass_fraction: Float[Tensor, "b o n"]  # of the object's mass that a keypoint stands for; sums to 1, 0 where padded
    mass: Float[Tensor, "b o"]  # [kg]
    E: Float[Tensor, "b o"]  # Young's modulus [Pa]
    solidity: Float[Tensor, "b o"]  # how many times stiffer than a hollow or thin body of that modulus
    nu: Float[Tensor, "b o"]  # Poisson's ratio
    friction: Float[Tensor, "b o"]  # Coulomb's coefficient
    velocity: Float[Tensor, "b o 3"]  # at the start [m/s]
    spin: Float[Tensor, "b o 3"]  # angular velocity at the start, world axes [rad/s]
    gravity: Float[Tensor, "b 3"]  # [m/s^2]
    box: Float[Tensor, "b o 2 3"]  # corners of the room as each finds it; the floor under it is the lower z [m]

    @classmethod
    def of(
        cls, points: Float[Tensor, "b o n 3"], valid: Bool[Tensor, "b o n"] | None = None, **given: Tensor
    ) -> InitialConditions:
        """A world of these keypoints; fields not given take 1 kg, 1e5 Pa, hollow, 0.3, 0.5, rest, and the published
        room.

        A given tensor needs only be broadcastable to its field.
        """
        b, o, n, _ = points.shape
        valid = points.new_ones(b, o, n, dtype=torch.bool) if valid is None else valid
        if "mass_fraction" not in given:
            mass_fraction = valid.to(points)
            given["mass_fraction"] = mass_fraction / mass_fraction.sum(-1, keepdim=True).clamp_min(1)
        default = {
            "mass": 1.0, "E": 1e5, "solidity": 1.0, "nu": 0.3, "friction": 0.5, "velocity": 0.0, "spin": 0.0,
            "gravity": GRAVITY, "box": BOX,
        }  # fmt: skip
        shape = {
            "mass_fraction": (b, o, n),
            "velocity": (b, o, 3),
            "spin": (b, o, 3),
            "gravity": (b, 3),
            "box": (b, o, 2, 3),
        }
        filled = {
            name: torch.as_tensor(given.pop(name, default.get(name))).to(points) for name in ("mass_fraction", *default)
        }
        # in memory of their own, or kernels would copy them at every step
        filled = {name: x.expand(shape.get(name, (b, o))).contiguous() for name, x in filled.items()}
        if given:
            raise TypeError(f"a World has no {', '.join(given)}")
        return cls(torch.where(valid[..., None], points, 0.0), valid, **filled)

    @property
    def present(self) -> Bool[Tensor, "b o"]:
        """Objects that are there; the others are padding."""
        return self.valid.any(-1)

    @property
    def floor(self) -> Float[Tensor, "b o"]:
        """Height of the floor under each object [m]."""
        return self.box[..., 0, 2]

    def to(self, target: torch.device | torch.dtype | str) -> InitialConditions:
        """On another device, or in another precision (`valid` stays boolean)."""
        dtype = isinstance(target, torch.dtype)
        moved = {f.name: getattr(self, f.name) for f in fields(self)}
        return InitialConditions(
            **{k: x if dtype and x.dtype == torch.bool else x.to(target) for k, x in moved.items()}
        )

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: slice | Tensor) -> InitialConditions:
        """Some of the scenes, still a batch."""
        return InitialConditions(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


def centre_of_mass(initial: InitialConditions, points: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o 3"]:
    """Centre of mass of each object whose keypoints are at `points` [m]."""
    return (initial.mass_fraction[..., None] * points).sum(2)


def offsets(initial: InitialConditions, points: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o n 3"]:
    """Keypoints relative to their object's centre of mass [m]; 0 where padded."""
    return torch.where(initial.valid[..., None], points - centre_of_mass(initial, points)[:, :, None], 0.0)


def inertia(mass_fraction: Float[Tensor, "b o n"], arm: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o 3 3"]:
    """Inertia tensor per unit of mass about the origin of `arm` [m^2].

    A thousandth of the trace is added to the diagonal (and 1 mm^2, for a single point), so that a rod and a point can
    be turned about any axis.
    """
    moment = torch.einsum("boni,bonj->boij", mass_fraction[..., None] * arm, arm)
    trace = moment.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(3, dtype=arm.dtype, device=arm.device)
    return (1.001 * trace + 1e-6) * eye - moment
