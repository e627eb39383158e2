"""Free rigid-body motion in one launch with a thread per body, instead of dozens of small tensor operations."""

import warp as wp
from torch import Tensor

from stages.core.kernels.interop import device_of, launch, view
from stages.core.kernels.operators import operator


@wp.func
def matrix(quat: wp.vec4):
    """Rotation matrix of a quaternion w x y z of any norm."""
    return wp.quat_to_matrix(wp.normalize(wp.quat(quat[1], quat[2], quat[3], quat[0])))


@wp.func
def spin_of(momentum: wp.vec3, inverse: wp.mat33, R: wp.mat33):
    """Angular velocity from angular momentum and the inverse inertia in the body frame."""
    return R * (inverse * (wp.transpose(R) * momentum))


@wp.func
def rotated(quat: wp.vec4, rotation: wp.vec3):
    """Quaternion w x y z after the rotation vector `rotation` [rad] in world axes."""
    half = wp.sqrt(wp.length_sq(rotation) + 1.0e-24) / 2.0
    by = rotation * (wp.sin(half) / half / 2.0)
    q = wp.normalize(wp.quat(by[0], by[1], by[2], wp.cos(half)) * wp.quat(quat[1], quat[2], quat[3], quat[0]))
    return wp.vec4(q[3], q[0], q[1], q[2])


@wp.struct
class Placement:
    """Poses of bodies."""

    com: wp.array[wp.vec3]  # centre of mass [m]
    quat: wp.array[wp.vec4]


@wp.kernel(enable_backward=False)
def _drift(
    start: Placement, velocity: wp.array[wp.vec3], momentum: wp.array[wp.vec3], inverse: wp.array[wp.mat33], dt: float,
    end: Placement,
):  # fmt: skip
    i = wp.tid()
    q, L = start.quat[i], momentum[i]
    spin = spin_of(L, inverse[i], matrix(q))
    spin = spin_of(L, inverse[i], matrix(rotated(q, dt / 2.0 * spin)))
    end.com[i] = start.com[i] + dt * velocity[i]
    end.quat[i] = rotated(q, dt * spin)


@wp.kernel(enable_backward=False)
def _pose(quat: wp.array[wp.vec4], momentum: wp.array[wp.vec3], inverse: wp.array[wp.mat33],
          R: wp.array[wp.mat33], spin: wp.array[wp.vec3]):  # fmt: skip
    i = wp.tid()
    R[i] = matrix(quat[i])
    spin[i] = spin_of(momentum[i], inverse[i], R[i])


def _rows(x: Tensor, dims: int, dtype) -> wp.array:
    return view(x.contiguous().flatten(0, -1 - dims), dtype)


def _placement(com: Tensor, quat: Tensor) -> Placement:
    out = Placement()
    out.com, out.quat = _rows(com, 1, wp.vec3), _rows(quat, 1, wp.vec4)
    return out


def _drift_shapes(com, quat, velocity, momentum, inverse, dt):
    return com.new_empty(com.shape), quat.new_empty(quat.shape)


@operator("drift", _drift_shapes)
def drift(
    com: Tensor, quat: Tensor, velocity: Tensor, momentum: Tensor, inverse: Tensor, dt: float
) -> tuple[Tensor, Tensor]:
    """Return centres of mass (..., 3) and quaternions (..., 4) after free motion for dt [s], without gradients.

    `momentum` is the angular momentum, `inverse` (..., 3, 3) the inverse inertia in the body frame, both per unit of
    mass.
    Reference: `stages.core.models.field.rigid_body.drift`.
    """
    moved, turned = com.new_empty(com.shape), quat.new_empty(quat.shape)
    launch(_drift, com.numel() // 3, [
        _placement(com, quat), _rows(velocity, 1, wp.vec3), _rows(momentum, 1, wp.vec3), _rows(inverse, 2, wp.mat33),
        dt, _placement(moved, turned),
    ], device=device_of(com))  # fmt: skip
    return moved, turned


def _pose_shapes(quat, momentum, inverse):
    return inverse.new_empty(inverse.shape), momentum.new_empty(momentum.shape)


@operator("pose", _pose_shapes)
def pose(quat: Tensor, momentum: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """Return rotation matrices (..., 3, 3) and angular velocities (..., 3) [rad/s] of bodies, without gradients.

    Reference: `stages.core.models.field.rigid_body.pose`.
    """
    R, spin = inverse.new_empty(inverse.shape), momentum.new_empty(momentum.shape)
    launch(_pose, momentum.numel() // 3, [
        _rows(quat, 1, wp.vec4), _rows(momentum, 1, wp.vec3), _rows(inverse, 2, wp.mat33),
    ], [_rows(R, 2, wp.mat33), _rows(spin, 1, wp.vec3)], device_of(quat))  # fmt: skip
    return R, spin
