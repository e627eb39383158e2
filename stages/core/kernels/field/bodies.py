"""Bodies in the step of the force field: one program an object, all of its points in registers.

`advance` drifts them for half a step and places their points in the world; `place` does only the latter. The same in
PyTorch, their reference, is in `stages.core.models.field.force_field`. Written in Triton (see `compilers`).
"""

import triton
import triton.language as tl

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

# a row for each body holds these, from these columns on
BODY_SIZE = tl.constexpr(40)
COM, VELOCITY, MOMENTUM, ROTATION, INVERSE_INERTIA, QUAT, BOX_LOW, BOX_HIGH, CONTACT_RADIUS = (
    tl.constexpr(i) for i in (0, 3, 6, 9, 18, 27, 31, 34, 37)
)
# and for each of its points, in the world and in its own frame
POINT_SIZE, FIELD_SIZE = tl.constexpr(12), tl.constexpr(9)
POINT, SPEED, NORMAL, ARM = (tl.constexpr(i) for i in (0, 3, 6, 9))
U, DU, VIRIAL = (tl.constexpr(i) for i in (0, 3, 6))
WRENCH_SIZE = tl.constexpr(6)  # force and torque


@triton.jit
def nearest_wall(x, room):
    """Distance to the nearest of four walls and the ceiling [m], and its normal."""
    near, other = x[0] - tl.load(room), x[1] - tl.load(room + 1)
    nx, ny, nz = tl.where(other < near, 0.0, 1.0), tl.where(other < near, 1.0, 0.0), tl.zeros_like(near)
    near = tl.minimum(near, other)
    for axis in tl.static_range(3):
        other = tl.load(room + 3 + axis) - x[axis]
        nx = tl.where(other < near, -1.0 if axis == 0 else 0.0, nx)
        ny = tl.where(other < near, -1.0 if axis == 1 else 0.0, ny)
        nz = tl.where(other < near, -1.0 if axis == 2 else 0.0, nz)
        near = tl.minimum(near, other)
    return near, (nx, ny, nz)


@triton.jit
def clamp_displacements(u, size, FARTHEST: tl.constexpr):
    """Displacements kept below a share of the object's size."""
    most = FARTHEST * size
    return scale3(most / tl.maximum(tl.sqrt(tl.max(dot(u, u))), most), u)


@triton.jit
def drift_half_step(
    com, quat, velocity, momentum, u, du, arm, normal, valid, size, inverse, pinned, box, body, moved, field, keys,
    o, n, dt, FARTHEST: tl.constexpr, FAR: tl.constexpr, FRAME: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Half a drift, and where everything is then. `keys` are distances to the floor and to a wall, now or soon."""
    i = tl.program_id(0)
    free = 1 - tl.load(pinned + i).to(tl.float32)
    inertia = read9(inverse + 9 * i)
    v, L = scale3(free, read3(velocity + 3 * i)), scale3(free, read3(momentum + 3 * i))
    c, q = drift(read3(com + 3 * i), read4(quat + 4 * i), v, L, inertia, dt / 2)
    R, spin = rotation_matrix(q), angular_velocity(q, L, inertia)
    to = body + BODY_SIZE * i
    write3(to + COM, c)
    write3(to + VELOCITY, v)
    write3(to + MOMENTUM, L)
    write9(to + ROTATION, R)
    write9(to + INVERSE_INERTIA, rotate_tensor(R, inertia))
    write4(to + QUAT, q)

    r = tl.arange(0, BLOCK)
    inside = r < n
    at = (i * n + r) * 3
    rate = scale3(free, load3(du + at, 1, inside))
    shift = add(load3(u + at, 1, inside), scale3(dt / 2, rate))
    shift = clamp_displacements(shift, tl.load(size + i), FARTHEST)
    turning = matvec3(R, add(load3(arm + at, 1, inside), shift))
    speed = add(add(v, cross(spin, turning)), matvec3(R, rate))
    x = add(c, turning)
    own = field + FIELD_SIZE * i * n + r
    store3(own + U * n, n, shift, inside)
    store3(own + DU * n, n, rate, inside)
    own = moved + POINT_SIZE * i * n + r
    store3(own + POINT * n, n, x, inside)
    store3(own + SPEED * n, n, speed, inside)
    store3(own + NORMAL * n, n, matvec3(R, load3(normal + at, 1, inside)), inside)
    store3(own + ARM * n, n, turning, inside)

    far: tl.constexpr = float("inf")
    there = tl.load(valid + i * n + r, mask=inside, other=0) != 0
    write3(to + BOX_LOW, scale3(-1.0, max3(where3(there, scale3(-1.0, x), -far))))
    write3(to + BOX_HIGH, max3(where3(there, x, -far)))
    fastest = tl.sqrt(tl.max(tl.where(there, dot(speed, speed), 0.0)))
    tl.store(to + CONTACT_RADIUS, FAR / 2 + FRAME * fastest)  # two objects farther apart than both say cannot touch
    room = box + 6 * i
    height = x[2] - tl.load(room + 2)
    key = tl.where(there, tl.minimum(height, height + FRAME * speed[2]), far)
    tl.store(keys + 2 * i * n + r, key, mask=inside)
    height, inward = nearest_wall(x, room)
    key = tl.where(there, tl.minimum(height, height + FRAME * dot(speed, inward)), far)
    tl.store(keys + (2 * i + 1) * n + r, key, mask=inside)


@triton.jit
def world_points(com, quat, u, arm, points, n, BLOCK: tl.constexpr):
    """Where the points of displaced bodies are."""
    i, r = tl.program_id(0), tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    at, inside = (i * n + r) * 3, r < n
    x = matvec3(rotation_matrix(read4(quat + 4 * i)), add(load3(arm + at, 1, inside), load3(u + at, 1, inside)))
    store3(points + at, 1, add(read3(com + 3 * i), x), inside)
