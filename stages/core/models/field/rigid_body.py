"""Rigid-body motion: rotation vectors, quaternions, force-free drift, and the least-squares fit to moving points."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.rotations import matrix, multiply, nearest_rotation
from stages.core.kernels.field import rigid_motion as kernels
from stages.core.models.field.equivariant import matvec
from stages.core.models.field.kernel_choice import kernels_allowed


def exponential(rotation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternion w x y z of a rotation vector [rad]; smooth at zero."""
    squared = rotation.square().sum(-1, keepdim=True)
    half = (squared + 1e-24).sqrt() / 2
    # sin(a / 2) / a without dividing by zero: torch.sinc(x) = sin(pi x) / (pi x)
    return torch.cat([half.cos(), rotation * torch.sinc(half / torch.pi) / 2], -1)


def rotated(quats: Float[Tensor, "*b 4"], rotation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4"]:
    """Orientations (unit quaternions w x y z) after a further rotation vector in world axes [rad]."""
    q = multiply(exponential(rotation), quats)
    return q / q.norm(dim=-1, keepdim=True)


def angular_velocity(
    momentum: Float[Tensor, "*b 3"], inverse: Float[Tensor, "*b 3 3"], R: Float[Tensor, "*b 3 3"]
) -> Float[Tensor, "*b 3"]:
    """Angular velocity [rad/s] for an angular momentum per unit of mass [m^2/s], both in world axes.

    `inverse` is the inverse inertia tensor per unit of mass in the rest orientation [1/m^2], R the rotation from it.
    """
    return matvec(R, matvec(inverse, matvec(R.mT, momentum)))


def pose(
    quat: Float[Tensor, "*b 4"], momentum: Float[Tensor, "*b 3"], inverse: Float[Tensor, "*b 3 3"]
) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]]:
    """Rotation matrices, and angular velocities [rad/s]; see `angular_velocity`.

    Uses one kernel without gradients where `kernel_choice.kernels_allowed`.
    """
    if kernels_allowed(quat):
        return kernels.pose(quat, momentum, inverse)
    R = matrix(quat)
    return R, angular_velocity(momentum, inverse, R)


def drift(
    com: Float[Tensor, "*b 3"], quat: Float[Tensor, "*b 4"], velocity: Float[Tensor, "*b 3"],
    momentum: Float[Tensor, "*b 3"], inverse: Float[Tensor, "*b 3 3"], dt: float,
) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 4"]]:  # fmt: skip
    """Centres of mass [m] and orientations after dt [s] of force-free motion.

    Rotations use the angular velocity at half the step (explicit midpoint rule, second order). Uses one kernel without
    gradients where `kernel_choice.kernels_allowed`.
    """
    if kernels_allowed(quat):
        return kernels.drift(com, quat, velocity, momentum, inverse, dt)
    spin = pose(quat, momentum, inverse)[1]
    spin = pose(rotated(quat, dt / 2 * spin), momentum, inverse)[1]
    return com + dt * velocity, rotated(quat, dt * spin)


def clamp_norm(x: Float[Tensor, "*b 3"], maximum: float) -> Float[Tensor, "*b 3"]:
    """Vectors scaled to a norm of at most `maximum`."""
    return x * (maximum / x.norm(dim=-1, keepdim=True).clamp_min(maximum))


class RigidFit(NamedTuple):
    """Least-squares rigid motion of moving points; the residual is the deformation."""

    R: Float[Tensor, "b o 3 3"]
    com: Float[Tensor, "b o 3"]  # [m]
    velocity: Float[Tensor, "b o 3"]  # [m/s]
    spin: Float[Tensor, "b o 3"]  # angular velocity [rad/s]
    u: Float[Tensor, "b o n 3"]  # residual displacements, body frame [m]
    du: Float[Tensor, "b o n 3"]  # residual velocities, body frame [m/s]


def fit_rigid_motion(
    mass_fraction: Float[Tensor, "b o n"], arm: Float[Tensor, "b o n 3"], inverse: Float[Tensor, "b o 3 3"],
    points: Float[Tensor, "b o n 3"], velocities: Float[Tensor, "b o n 3"],
) -> RigidFit:  # fmt: skip
    """Fit a rigid motion to `points` [m] moving with `velocities` [m/s], whose offsets at rest are `arm` [m].

    `inverse` is the inverse inertia tensor per unit of mass at rest [1/m^2].
    Source: Mueller et al. 2005, "Meshless deformations based on shape matching", section 3.
    """
    weight = mass_fraction[..., None]
    com, velocity = (weight * points).sum(2), (weight * velocities).sum(2)
    present = weight > 0
    offset = torch.where(present, points - com[:, :, None], 0.0)
    relative = torch.where(present, velocities - velocity[:, :, None], 0.0)
    # regularise by a small multiple of the identity: collinear or coplanar points do not determine a rotation
    eye = torch.eye(3, dtype=arm.dtype, device=arm.device)
    spread = (weight * arm.square()).sum((2, 3))[..., None, None]
    R = nearest_rotation((weight * offset).mT @ arm + 1e-6 * (spread + 1e-6) * eye)
    momentum = torch.linalg.cross(weight * offset, relative).sum(2)
    spin = angular_velocity(momentum, inverse, R)
    rotating = torch.linalg.cross(spin[:, :, None].expand_as(offset), offset)
    return RigidFit(
        R, com, velocity, spin, offset @ R - arm, torch.where(present, relative - rotating, 0.0) @ R
    )  # fmt: skip
