"""Turning: rotation vectors, quaternions and spin from angular momentum."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.rotations import matrix, multiply, nearest_rotation
from stages.core.kernels.field import rigid_motion as kernels
from stages.core.models.field.equivariant import matvec


def exponential(turn: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4"]:
    """The quaternion w x y z of a rotation vector [rad]; smooth at zero."""
    squared = turn.square().sum(-1, keepdim=True)
    half = (squared + 1e-24).sqrt() / 2
    # sin(a / 2) / a without dividing by zero: torch.sinc(x) = sin(pi x) / (pi x)
    return torch.cat([half.cos(), turn * torch.sinc(half / torch.pi) / 2], -1)


def rotated(quats: Float[Tensor, "*b 4"], turn: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4"]:
    """Orientations after a rotation about world axes [rad], of unit length."""
    q = multiply(exponential(turn), quats)
    return q / q.norm(dim=-1, keepdim=True)


def angular_velocity(
    momentum: Float[Tensor, "*b 3"], inverse: Float[Tensor, "*b 3 3"], R: Float[Tensor, "*b 3 3"]
) -> Float[Tensor, "*b 3"]:
    """Angular velocity [rad/s], world axes, of an angular momentum per mass [m^2/s]; `inverse` inertia at rest."""
    return matvec(R, matvec(inverse, matvec(R.mT, momentum)))


def pose(
    quat: Float[Tensor, "*b 4"], momentum: Float[Tensor, "*b 3"], inverse: Float[Tensor, "*b 3 3"]
) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]]:
    """Rotation matrices, and spins as `spin_of` has them."""
    if _at_once(quat):
        return kernels.pose(quat, momentum, inverse)
    R = matrix(quat)
    return R, angular_velocity(momentum, inverse, R)


def drift(
    com: Float[Tensor, "*b 3"], quat: Float[Tensor, "*b 4"], velocity: Float[Tensor, "*b 3"],
    momentum: Float[Tensor, "*b 3"], inverse: Float[Tensor, "*b 3 3"], dt: float,
) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 4"]]:  # fmt: skip
    """Centres of mass and orientations after dt [s] without forces. The spin is that of the middle of the way (second
    order)."""
    if _at_once(quat):
        return kernels.drift(com, quat, velocity, momentum, inverse, dt)
    spin = pose(quat, momentum, inverse)[1]
    spin = pose(rotated(quat, dt / 2 * spin), momentum, inverse)[1]
    return com + dt * velocity, rotated(quat, dt * spin)


def _at_once(x: Tensor) -> bool:
    """Whether one kernel can do it."""
    return x.dtype == torch.float32 and not torch.is_grad_enabled()


def clamp_norm(x: Float[Tensor, "*b 3"], most: float) -> Float[Tensor, "*b 3"]:
    """Vectors made no longer than `most`."""
    return x * (most / x.norm(dim=-1, keepdim=True).clamp_min(most))


class RigidFit(NamedTuple):
    """The rigid motion that comes nearest to that of some points; what is left is deformation."""

    R: Float[Tensor, "b o 3 3"]
    com: Float[Tensor, "b o 3"]
    velocity: Float[Tensor, "b o 3"]
    momentum: Float[Tensor, "b o 3"]  # angular, per unit of mass, about the centre
    u: Float[Tensor, "b o n 3"]  # in the object's frame
    du: Float[Tensor, "b o n 3"]


def fit_rigid_motion(
    mass_fraction: Float[Tensor, "b o n"], arm: Float[Tensor, "b o n 3"], inverse: Float[Tensor, "b o 3 3"],
    points: Float[Tensor, "b o n 3"], speed: Float[Tensor, "b o n 3"],
) -> RigidFit:  # fmt: skip
    """Rigid motion of points whose arms at rest are known.

    Source: Mueller et al. 2005, "Meshless deformations based on shape matching", section 3.
    """
    weight = mass_fraction[..., None]
    com, velocity = (weight * points).sum(2), (weight * speed).sum(2)
    there = weight > 0
    offset = torch.where(there, points - com[:, :, None], 0.0)
    drift = torch.where(there, speed - velocity[:, :, None], 0.0)
    # a little of the identity: points on a line or in a plane leave a turn open
    eye = torch.eye(3, dtype=arm.dtype, device=arm.device)
    spread = (weight * arm.square()).sum((2, 3))[..., None, None]
    R = nearest_rotation((weight * offset).mT @ arm + 1e-6 * (spread + 1e-6) * eye)
    momentum = torch.linalg.cross(weight * offset, drift).sum(2)
    spin = angular_velocity(momentum, inverse, R)
    turning = torch.linalg.cross(spin[:, :, None].expand_as(offset), offset)
    return RigidFit(R, com, velocity, momentum, offset @ R - arm, torch.where(there, drift - turning, 0.0) @ R)
