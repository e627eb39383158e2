"""Units of the learned model: every scene is scaled to the size, mass and gravity of the training data.

Motion under gravity is invariant to size if times scale with the square root of length over gravity, and to the unit of
mass if stresses and forces scale with it (dynamic similarity). So neither the size of a scene nor a common factor of
its masses and Young's moduli changes the motion. With L model metres per metre, M model kilograms per kilogram, and
T = sqrt(L g / g') model seconds per second, stresses scale by M / (L T^2) and forces by M L / T^2; g is the gravity of
the scene and g' that of the model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.upright_boxes import longest_side
from stages.core.models.initial_conditions import FLOOR
from stages.core.physics.forces import Force
from stages.core.scene.field_start import UnitFactors

TYPICAL_SIZE = 0.55  # median longest side of the objects of the training data [m]
TYPICAL_MASS = 8.0  # geometric mean of the masses of these objects; the published ones are all hollow [kg]
TRAINING_GRAVITY = 5.0  # gravity of the training data [m/s^2]


@dataclass(frozen=True)
class ModelUnits(UnitFactors):
    """Unit factors of the model, its origin and its gravity."""

    origin: Float[Tensor, "3"]  # scene point that is mapped to (0, 0, FLOOR) [scene units]
    gravity: float  # downward gravity in model units [m/s^2]

    @staticmethod
    def for_objects(
        keypoints: list[Float[Tensor, "k 3"]], masses: Float[Tensor, "o"], floor: float, unit: float, gravity: float
    ) -> ModelUnits:
        """Choose units in which the geometric means of sizes and masses, and gravity, are those of the training data.

        `keypoints` of each object and the height `floor` are in scene units of `unit` metres, `masses` in kg;
        `gravity` is downwards [m/s^2].
        """
        sides = torch.tensor([longest_side(p) for p in keypoints]).clamp_min(1e-9)
        scale = TYPICAL_SIZE / (unit * float(sides.double().log().mean().exp()))
        model_gravity = math.copysign(TRAINING_GRAVITY, gravity) if abs(gravity) > 1e-3 else 0.0
        gravity_ratio = model_gravity / gravity if model_gravity else 1.0  # does not apply without gravity
        middle = torch.cat(keypoints).mean(0)
        origin = torch.tensor([float(middle[0]), float(middle[1]), floor])
        mass = TYPICAL_MASS / float(masses.double().clamp_min(1e-30).log().mean().exp())
        return ModelUnits(scale * unit, scale, math.sqrt(scale / gravity_ratio), mass, origin, model_gravity)

    @property
    def force(self) -> float:
        """Model newtons per newton."""
        return self.mass * self.scale / self.time**2

    @property
    def stress(self) -> float:
        """Model pascals per pascal."""
        return self.force / self.scale**2

    def to_model(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Convert points from scene units to model metres."""
        return (points - self.origin) * self.length + torch.tensor([0.0, 0.0, FLOOR])

    def forces(self, forces: Sequence[Force], lift: Float[Tensor, "o 3"], ids: list[int]) -> tuple[Force, ...]:
        """Convert forces to model units; points of application move with the `lift` of their object [scene units]."""

        def scaled(f: Force) -> Force:
            at = None
            if f.at is not None:
                at = tuple(self.to_model(torch.tensor(f.at) + lift[ids.index(f.object_id)]).tolist())
            newton, newton_metre = self.force, self.force * self.scale
            return replace(
                f, force=tuple(newton * v for v in f.force), torque=tuple(newton_metre * v for v in f.torque),
                start=f.start * self.time, end=f.end * self.time, at=at,
            )  # fmt: skip

        return tuple(scaled(f) for f in forces)
