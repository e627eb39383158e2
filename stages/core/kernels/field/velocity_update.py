"""Velocity update and second half of the drift step: one program per object, with all of its points in registers.

`update_velocities` applies contact forces, gravity, external forces and friction to rigid bodies.
`update_displacements` applies the internal accelerations to their displacements. Reference: `ForceField.step` in
`stages.core.models.field.force_field`. Written in Triton (see `compilers`).
"""

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from stages.core.kernels.field.bodies import (
    ARM,
    BODY_SIZE,
    COM,
    DU,
    FIELD_SIZE,
    INVERSE_INERTIA,
    MOMENTUM,
    POINT,
    POINT_SIZE,
    QUAT,
    ROTATION,
    VELOCITY,
    VIRIAL,
    WRENCH_SIZE,
    U,
    clamp_displacements,
)
from stages.core.kernels.field.broad_phase import other_object
from stages.core.kernels.field.layers import ROWS
from stages.core.kernels.field.vec3 import (
    add,
    cross,
    dot,
    drift,
    load3,
    matvec3,
    max3,
    read3,
    read4,
    read9,
    scale3,
    store3,
    sub,
    sum3,
    transposed_matvec3,
    where3,
    write3,
    write4,
)


class SplitFields(NamedTuple):
    """Contact acceleration, displacement and displacement rate of the keypoints in the body frame, for `split_matmul`.

    Each value is unit x (high + low), with high and low in half precision.
    """

    high: Tensor  # (b o, 9, n)
    low: Tensor  # (b o, 9, n)
    unit: Tensor  # (b o, 9)


class ExternalWrench(NamedTuple):
    """External force on each object, and its torque about the centre of mass."""

    force: Tensor  # (b o 3) [N]
    torque: Tensor  # (b o 3) [N m]


@triton.jit
def _total(parts, blocks, BLOCKS: tl.constexpr):
    """Sum of force and torque over consecutive blocks of contact points."""
    k = tl.arange(0, BLOCKS)
    at, mask = parts + k * WRENCH_SIZE, k < blocks
    return sum3(load3(at, 1, mask)), sum3(load3(at + 3, 1, mask))


@triton.jit
def _contact(i, inputs, drifted, lists, wrenches):
    """Sum force, torque and the accelerations of the points of an object over its contacts, per unit of mass."""
    o, n = inputs.o, inputs.n
    first, index, m, kinds = i - i % o, i % o, o - 1, o + 1
    places, wide = lists.slots // ROWS, lists.wide // ROWS
    c = read3(drifted.body + BODY_SIZE * i + COM)
    mass_i, free = tl.maximum(tl.load(inputs.mass + i), 1e-6), 1 - tl.load(inputs.pinned + i).to(tl.float32)
    r = tl.arange(0, inputs.BLOCK)
    zero = tl.zeros([inputs.BLOCK], tl.float32)
    acceleration, force, torque = (zero, zero, zero), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for k in range(m):
        j = first + k + (k >= index)
        index_in_j = index - (index > j - first)  # index of i among the other objects of j
        mass_j = tl.maximum(tl.load(inputs.mass + j), 1e-6)
        free_j = 1 - tl.load(inputs.pinned + j).to(tl.float32)
        reduced = 1 / tl.maximum(free / mass_i + free_j / mass_j, 1e-9)
        own, others = (i * places + k * wide) * WRENCH_SIZE, (j * places + index_in_j * wide) * WRENCH_SIZE
        F, T = _total(wrenches + own, wide, lists.PLANE_BLOCKS)
        F_j, T_j = _total(wrenches + others, wide, lists.PLANE_BLOCKS)
        T_j = add(T_j, cross(sub(read3(drifted.body + BODY_SIZE * j + COM), c), F_j))
        ratio = reduced / mass_i
        force, torque = add(force, scale3(ratio, sub(F, F_j))), add(torque, scale3(ratio, sub(T, T_j)))
        of_contact = load3(lists.acceleration + (i * kinds + k) * 3 * n + r, n, r < n)
        acceleration = add(acceleration, scale3(ratio, of_contact))
    planes = wrenches + (i * places + m * wide) * WRENCH_SIZE  # floor and walls
    F, T = _total(planes, places - m * wide, lists.PLANE_BLOCKS)
    force, torque = add(force, F), add(torque, T)
    acceleration = add(acceleration, load3(lists.acceleration + (i * kinds + m) * 3 * n + r, n, r < n))
    acceleration = add(acceleration, load3(lists.acceleration + (i * kinds + m + 1) * 3 * n + r, n, r < n))
    return force, torque, acceleration


@triton.jit
def _limited(v, up, down, MAX_RECOVERY_SPEED: tl.constexpr):
    """Limit the velocity along one axis [m/s] to the range that keeps the points within the room.

    It is at least min(up, MAX_RECOVERY_SPEED) and at most max(down, -MAX_RECOVERY_SPEED).
    """
    return tl.minimum(tl.maximum(v, tl.minimum(up, MAX_RECOVERY_SPEED)), tl.maximum(down, -MAX_RECOVERY_SPEED))


@triton.jit
def update_velocities(inputs, drifted, lists, messages, external, new, split, C: tl.constexpr):
    """Update velocities by the forces, drift by dt / 2, and prepare the inputs of the neighbourhood averages.

    Writes the poses and motion of the bodies in the BodyState `new`, and `split`; `external` may be None.
    """
    i, o, n, dt = tl.program_id(0), inputs.o, inputs.n, inputs.dt
    force, torque, acceleration = _contact(i, inputs, drifted, lists, messages.wrenches)
    force = add(force, read3(inputs.gravity + 3 * (i // o)))
    if external is not None:
        mass_i = tl.maximum(tl.load(inputs.mass + i), 1e-6)
        force = add(force, scale3(1 / mass_i, read3(external.force + 3 * i)))
        torque = add(torque, scale3(1 / mass_i, read3(external.torque + 3 * i)))
    own_body = drifted.body + BODY_SIZE * i
    past_v = read3(own_body + VELOCITY)
    past_spin = matvec3(read9(own_body + INVERSE_INERTIA), read3(own_body + MOMENTUM))
    L = add(read3(own_body + MOMENTUM), scale3(dt, torque))
    v = add(past_v, scale3(dt, force))
    spin = matvec3(read9(own_body + INVERSE_INERTIA), L)
    spin_limit = C.MAX_SPIN / tl.maximum(tl.sqrt(dot(spin, spin)), C.MAX_SPIN)
    L, spin = scale3(spin_limit, L), scale3(spin_limit, spin)
    v = scale3(C.MAX_SPEED / tl.maximum(tl.sqrt(dot(v, v)), C.MAX_SPEED), v)
    extent, friction_speed = tl.load(inputs.size + i), tl.load(messages.friction + i)
    for k in range(o - 1):  # the friction of a supporting object applies to the objects that it carries as well
        contact_weight = 1 - C.CONTACT_SATURATION * tl.load(messages.scale + i * (o + 1) + k)  # approaches 1
        other_speed = tl.load(messages.friction + other_object(i, k, o))
        friction_speed = tl.maximum(friction_speed, contact_weight * other_speed)
    last = (dot(v, v) + extent * extent * dot(spin, spin)) / C.FRICTION_CUTOFF_SPEED
    past_v, past_spin = add(past_v, v), add(past_spin, spin)
    moving = (dot(past_v, past_v) + extent * extent * dot(past_spin, past_spin)) / 4 + last * last
    drag = dt / C.FRAME * friction_speed * friction_speed * friction_speed * friction_speed
    factor = (moving * moving + 1e-16) / (moving * moving + 1e-16 + drag)
    v, L, spin = scale3(factor, v), scale3(factor, L), scale3(factor, spin)

    r = tl.arange(0, inputs.BLOCK)
    inside = r < n
    valid_points = tl.load(inputs.valid + i * n + r, mask=inside, other=0) != 0
    at_point = drifted.points + POINT_SIZE * i * n + r
    x = add(load3(at_point + POINT * n, n, inside), scale3(dt / 2, cross(spin, load3(at_point + ARM * n, n, inside))))
    infinity: tl.constexpr = float("inf")
    bounds = inputs.box + 6 * i
    slack = (C.MAX_PENETRATION, C.MAX_PENETRATION, C.MAX_PENETRATION)
    deepest = max3(where3(valid_points, scale3(-1.0, x), -infinity))  # positions of the lowest points, negated [m]
    up = scale3(2 / dt, sub(add(read3(bounds), deepest), slack))
    down = scale3(2 / dt, add(sub(read3(bounds + 3), max3(where3(valid_points, x, -infinity))), slack))
    free = 1 - tl.load(inputs.pinned + i).to(tl.float32)
    v = (_limited(v[0], up[0], down[0], C.MAX_RECOVERY_SPEED), _limited(v[1], up[1], down[1], C.MAX_RECOVERY_SPEED),
         _limited(v[2], up[2], down[2], C.MAX_RECOVERY_SPEED))  # fmt: skip
    v = scale3(free, v)
    L = scale3(free, L)
    c, q = drift(read3(own_body + COM), read4(own_body + QUAT), v, L, read9(inputs.inverse + 9 * i), dt / 2)
    write3(new.com + 3 * i, c)
    write4(new.quat + 4 * i, q)
    write3(new.velocity + 3 * i, v)
    write3(new.momentum + 3 * i, L)

    part = tl.load(inputs.mass_fraction + i * n + r, mask=inside, other=0.0)
    inverse_fraction = tl.where(valid_points, 1 / tl.maximum(part, 1e-9), 0.0)
    acceleration = (
        inverse_fraction * acceleration[0],
        inverse_fraction * acceleration[1],
        inverse_fraction * acceleration[2],
    )
    acceleration = transposed_matvec3(read9(own_body + ROTATION), acceleration)
    arms = load3(inputs.arm + (i * n + r) * 3, 1, inside)
    at_point = drifted.field + FIELD_SIZE * i * n + r
    store3(at_point + VIRIAL * n, n, _spread(acceleration, arms, part, extent), inside)
    _split(acceleration, split, 9 * i, n, inside)
    _split(load3(at_point + U * n, n, inside), split, 9 * i + 3, n, inside)
    _split(load3(at_point + DU * n, n, inside), split, 9 * i + 6, n, inside)


@triton.jit
def _spread(acceleration, arm, mass_fraction, size):
    """Affine field from the virial of the contact accelerations: the symmetric virial matrix times the arms."""
    a, b, c = scale3(mass_fraction, acceleration)
    x, y, z = sum3(scale3(a, arm)), sum3(scale3(b, arm)), sum3(scale3(c, arm))
    M = (2 * x[0], x[1] + y[0], x[2] + z[0], x[1] + y[0], 2 * y[1], y[2] + z[1], x[2] + z[0], y[2] + z[1], 2 * z[2])
    return scale3(1 / (size * size), matvec3(M, arm))


@triton.jit
def _split(a, to, row, n, mask):
    """Write vectors to three rows of SplitFields, in units in which the largest absolute value is 1,024."""
    largest = max3((tl.abs(a[0]), tl.abs(a[1]), tl.abs(a[2])))
    at = row * n + tl.arange(0, a[0].shape[0])
    for axis in tl.static_range(3):
        unit = tl.maximum(largest[axis], 1e-30) / 1024
        x = a[axis] / unit
        half = x.to(tl.float16)
        tl.store(to.high + axis * n + at, half, mask=mask)
        tl.store(to.low + axis * n + at, (x - half.to(tl.float32)).to(tl.float16), mask=mask)
        tl.store(to.unit + row + axis, unit)


@triton.jit
def update_displacements(inputs, drifted, acceleration, new, C: tl.constexpr):
    """Update displacements and their rates in `new` by the internal accelerations (b o, 3, n).

    The mean and the net rotation of the accelerations are removed first.
    """
    i, n, dt = tl.program_id(0), inputs.n, inputs.dt
    r = tl.arange(0, inputs.BLOCK)
    inside = r < n
    valid_points = tl.load(inputs.valid + i * n + r, mask=inside, other=0) != 0
    part = tl.load(inputs.mass_fraction + i * n + r, mask=inside, other=0.0)
    arms = load3(inputs.arm + (i * n + r) * 3, 1, inside)
    a = load3(acceleration + 3 * i * n + r, n, inside)
    a = sub(a, sum3(scale3(part, a)))
    rotation_rate = matvec3(read9(inputs.keypoint_inverse + 9 * i), sum3(scale3(part, cross(arms, a))))
    a = sub(a, cross(rotation_rate, arms))
    a = where3(valid_points, a, 0.0)
    at_point = drifted.field + FIELD_SIZE * i * n + r
    displacement, rate = load3(at_point + U * n, n, inside), load3(at_point + DU * n, n, inside)
    k, c, extent = tl.load(inputs.stiffness + i), tl.load(inputs.damping + i), tl.load(inputs.size + i)
    rate = add(rate, scale3(dt, sub(a, scale3(k, displacement))))
    rate = scale3(1 / (1 + dt * c + dt * dt / 2 * k), rate)
    free = 1 - tl.load(inputs.pinned + i).to(tl.float32)
    rate = scale3(free, clamp_displacements(rate, C.MAX_SPEED * extent, C.MAX_DISPLACEMENT))
    displacement = add(displacement, scale3(dt / 2, rate))
    displacement = clamp_displacements(displacement, extent, C.MAX_DISPLACEMENT)
    at = (i * n + r) * 3
    store3(new.u + at, 1, displacement, inside)
    store3(new.du + at, 1, rate, inside)
