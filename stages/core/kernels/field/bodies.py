"""Body state of the force-field step: half a drift step, and world positions of the points.

One Triton program per object holds all of its points in registers. Reference:
`stages.core.models.field.force_field`.

Shapes: i is the index over b x o objects with n points each. Body rows are (b o, BODY_SIZE); point arrays are
(b o, POINT_SIZE, n) and (b o, FIELD_SIZE, n), with each component contiguous over the points.
"""

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from stages.core.kernels.field.vec3 import (
    add,
    angular_velocity,
    cross,
    dot,
    drift,
    load3,
    matvec3,
    max3,
    read3,
    read4,
    read9,
    rotate_tensor,
    rotation_matrix,
    scale3,
    store3,
    where3,
    write3,
    write4,
    write9,
)

# columns of a body row: centre of mass, velocity, angular momentum, rotation matrix, inverse inertia in world axes,
# quaternion, bounding box, and contact radius (bodies farther apart than the sum of their radii cannot touch)
BODY_SIZE = tl.constexpr(40)
COM, VELOCITY, MOMENTUM, ROTATION, INVERSE_INERTIA, QUAT, BOX_LOW, BOX_HIGH, CONTACT_RADIUS = (
    tl.constexpr(i) for i in (0, 3, 6, 9, 18, 27, 31, 34, 37)
)
# columns of a point: in the world frame, and in the body frame (displacement, displacement rate, virial field)
POINT_SIZE, FIELD_SIZE = tl.constexpr(12), tl.constexpr(9)
POINT, SPEED, NORMAL, ARM = (tl.constexpr(i) for i in (0, 3, 6, 9))
U, DU, VIRIAL = (tl.constexpr(i) for i in (0, 3, 6))
WRENCH_SIZE = tl.constexpr(6)  # columns: force and torque


class FieldConstants(NamedTuple):
    """Constants of the force field; they are defined in the modules of `stages.core.models.field`."""

    FRAME: float
    SEARCH_RADIUS: float
    NO_CONTACT: float
    FULL_CONTACT: float
    PAIR_FRACTION: float
    WALL_FRACTION: float
    GAP_UNIT: float
    ARM_UNIT: float
    CONTACT_SATURATION: float
    ACCELERATION_UNIT: float
    SEPARATION_SPEED: float
    MAX_FRICTION_SPEED: float
    FRICTION_CUTOFF_SPEED: float
    MAX_PENETRATION: float
    MAX_RECOVERY_SPEED: float
    MAX_SPEED: float
    MAX_SPIN: float
    MAX_DISPLACEMENT: float
    MAX_SPRING_WEIGHT: float
    MAX_DAMPER_WEIGHT: float


class StepInputs(NamedTuple):
    """Inputs of a step: contiguous arrays over the objects, their number, and the time step."""

    arm: Tensor  # (b o n 3) keypoints in the body frame [m]
    normal: Tensor  # (b o n 3)
    valid: Tensor  # (b o n)
    mass_fraction: Tensor  # (b o n)
    spacing: Tensor  # (b o n) [m]
    size: Tensor  # (b o) [m]
    mass: Tensor  # (b o) [kg]
    inverse: Tensor  # (b o 3 3) inverse inertia per unit of mass, body frame [1/m^2]
    keypoint_inverse: Tensor  # (b o 3 3) the same for the keypoints as point masses
    pinned: Tensor  # (b o)
    box: Tensor  # (b o 6) room that each object moves in: low and high corner [m]
    gravity: Tensor  # (b 3) [m/s^2]
    embedding: Tensor  # (b o h)
    stiffness: Tensor  # (b o) [1/s^2]
    damping: Tensor  # (b o) [1/s]
    compliance_scale: Tensor  # (b o)
    o: int  # objects per scene
    n: int  # keypoints per object
    dt: float  # [s]
    BLOCK: tl.constexpr  # n, padded to a power of two


class Kinematics(NamedTuple):
    """Bodies and keypoints after half a drift step."""

    body: Tensor  # (b o, BODY_SIZE)
    points: Tensor  # (b o, POINT_SIZE, n)
    field: Tensor  # (b o, FIELD_SIZE, n)
    planes: Tensor  # (b o, 2, n) distance to the floor and to the nearest wall [m], the smaller of now and one FRAME on
    o: int  # objects per scene
    n: int  # keypoints per object
    BLOCK: tl.constexpr  # n, padded to a power of two


@triton.jit
def nearest_wall(x, room):
    """Signed distance [m] to the nearest of the four walls and the ceiling, and its inward normal."""
    distance, other = x[0] - tl.load(room), x[1] - tl.load(room + 1)
    nx, ny, nz = tl.where(other < distance, 0.0, 1.0), tl.where(other < distance, 1.0, 0.0), tl.zeros_like(distance)
    distance = tl.minimum(distance, other)
    for axis in tl.static_range(3):
        other = tl.load(room + 3 + axis) - x[axis]
        nx = tl.where(other < distance, -1.0 if axis == 0 else 0.0, nx)
        ny = tl.where(other < distance, -1.0 if axis == 1 else 0.0, ny)
        nz = tl.where(other < distance, -1.0 if axis == 2 else 0.0, nz)
        distance = tl.minimum(distance, other)
    return distance, (nx, ny, nz)


@triton.jit
def clamp_displacements(u, size, MAX_DISPLACEMENT: tl.constexpr):
    """Scale all displacements so that the largest is at most MAX_DISPLACEMENT times the object's size [m]."""
    limit = MAX_DISPLACEMENT * size
    return scale3(limit / tl.maximum(tl.sqrt(tl.max(dot(u, u))), limit), u)


@triton.jit
def drift_half_step(state, inputs, drifted, C: tl.constexpr):
    """Drift bodies by dt / 2 and evaluate their points at that time; writes `drifted`. C is the FieldConstants."""
    i, n, dt = tl.program_id(0), inputs.n, inputs.dt
    free = 1 - tl.load(inputs.pinned + i).to(tl.float32)
    inertia = read9(inputs.inverse + 9 * i)
    v, L = scale3(free, read3(state.velocity + 3 * i)), scale3(free, read3(state.momentum + 3 * i))
    c, q = drift(read3(state.com + 3 * i), read4(state.quat + 4 * i), v, L, inertia, dt / 2)
    R, spin = rotation_matrix(q), angular_velocity(q, L, inertia)
    to = drifted.body + BODY_SIZE * i
    write3(to + COM, c)
    write3(to + VELOCITY, v)
    write3(to + MOMENTUM, L)
    write9(to + ROTATION, R)
    write9(to + INVERSE_INERTIA, rotate_tensor(R, inertia))
    write4(to + QUAT, q)

    r = tl.arange(0, inputs.BLOCK)
    inside = r < n
    at = (i * n + r) * 3
    rate = scale3(free, load3(state.du + at, 1, inside))
    shift = add(load3(state.u + at, 1, inside), scale3(dt / 2, rate))
    shift = clamp_displacements(shift, tl.load(inputs.size + i), C.MAX_DISPLACEMENT)
    lever = matvec3(R, add(load3(inputs.arm + at, 1, inside), shift))
    speed = add(add(v, cross(spin, lever)), matvec3(R, rate))
    x = add(c, lever)
    at_field = drifted.field + FIELD_SIZE * i * n + r
    store3(at_field + U * n, n, shift, inside)
    store3(at_field + DU * n, n, rate, inside)
    at_moved = drifted.points + POINT_SIZE * i * n + r
    store3(at_moved + POINT * n, n, x, inside)
    store3(at_moved + SPEED * n, n, speed, inside)
    store3(at_moved + NORMAL * n, n, matvec3(R, load3(inputs.normal + at, 1, inside)), inside)
    store3(at_moved + ARM * n, n, lever, inside)

    infinity: tl.constexpr = float("inf")
    is_valid = tl.load(inputs.valid + i * n + r, mask=inside, other=0) != 0
    write3(to + BOX_LOW, scale3(-1.0, max3(where3(is_valid, scale3(-1.0, x), -infinity))))
    write3(to + BOX_HIGH, max3(where3(is_valid, x, -infinity)))
    fastest = tl.sqrt(tl.max(tl.where(is_valid, dot(speed, speed), 0.0)))
    tl.store(to + CONTACT_RADIUS, C.NO_CONTACT / 2 + C.FRAME * fastest)
    bounds = inputs.box + 6 * i
    height = x[2] - tl.load(bounds + 2)
    key = tl.where(is_valid, tl.minimum(height, height + C.FRAME * speed[2]), infinity)
    tl.store(drifted.planes + 2 * i * n + r, key, mask=inside)
    height, inward = nearest_wall(x, bounds)
    key = tl.where(is_valid, tl.minimum(height, height + C.FRAME * dot(speed, inward)), infinity)
    tl.store(drifted.planes + (2 * i + 1) * n + r, key, mask=inside)


@triton.jit
def world_points(state, arm, points, n, BLOCK: tl.constexpr):
    """Compute the world positions (b o, n, 3) of the displaced points of bodies."""
    i, r = tl.program_id(0), tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    at, inside = (i * n + r) * 3, r < n
    x = add(load3(arm + at, 1, inside), load3(state.u + at, 1, inside))
    x = matvec3(rotation_matrix(read4(state.quat + 4 * i)), x)
    store3(points + at, 1, add(read3(state.com + 3 * i), x), inside)
