"""State and per-rollout data of the force field, shared by the PyTorch step and the fused step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from stages.core.models.field.rest_shape import RestShape

MAX_SPEED = 8.0  # upper limit of the speeds of bodies and of deformation rates [m/s]; hand-chosen, no source
MAX_SPIN = 60.0  # upper limit of angular velocities [rad/s]; hand-chosen, no source


class BodyState(NamedTuple):
    """Rigid pose and motion of each body, and the displacements of its keypoints in the body frame."""

    com: Float[Tensor, "b o 3"]  # centre of mass [m]
    quat: Float[Tensor, "b o 4"]  # orientation w x y z, relative to the rest shape
    velocity: Float[Tensor, "b o 3"]  # of the centre of mass [m/s]
    momentum: Float[Tensor, "b o 3"]  # angular, about the centre of mass, per unit of mass, world axes [m^2/s]
    u: Float[Tensor, "b o n 3"]  # displacement from the rest shape, body frame [m]
    du: Float[Tensor, "b o n 3"]  # rate of the displacement [m/s]


@dataclass(frozen=True)
class FieldScene:
    """Values computed once per rollout: the rest shapes, and the network outputs for shape and material."""

    shape: RestShape
    embedding: Float[Tensor, "b o h"]  # embedding of each object's shape and material
    stiffness: Float[Tensor, "b o"]  # stiffness of the springs to the rest shape, per unit of mass [1/s^2]
    damping: Float[Tensor, "b o"]  # damping of the displacement rates [1/s]
    compliance_scale: Float[
        Tensor, "b o"
    ]  # stiffness given to the network / true stiffness; 1 within the trained range


class Accelerations(NamedTuple):
    """Forces and torques on the bodies per unit of mass, internal accelerations and the friction threshold."""

    force: Float[Tensor, "b o 3"]  # [m/s^2]
    torque: Float[Tensor, "b o 3"]  # about the centre of mass [m^2/s^2]
    internal: Float[Tensor, "b o n 3"]  # acceleration of the displacements, body frame [m/s^2]
    friction_speed: Float[Tensor, "b o 1"]  # bodies slower than this are stopped by dry friction [m/s]
