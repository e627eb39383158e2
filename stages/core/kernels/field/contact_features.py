"""Input features of contact points: vectors and scalars for each block of the contact lists from `broad_phase`.

A block of ROWS contact points is one record (see `layers`). Reference: `stages.core.models.field.contact_points`.
Written in Triton (see `compilers`).
"""

import triton
import triton.language as tl

from stages.core.kernels.field.bodies import (
    ARM,
    BODY_SIZE,
    INVERSE_INERTIA,
    NORMAL,
    POINT,
    POINT_SIZE,
    SPEED,
    VELOCITY,
    nearest_wall,
)
from stages.core.kernels.field.broad_phase import other_object
from stages.core.kernels.field.layers import FIRST_SCALAR, MAX_VECTORS, ROWS
from stages.core.kernels.field.vec3 import add, dot, load3, read3, read9, scale3, solve_symmetric, store3, sub

GATE = tl.constexpr(38)  # column of the contact gate, which is one of the scalars
MASS_FRACTION = tl.constexpr(43)  # column of the point's mass fraction, which is not a network input
COLUMNS = tl.constexpr(44)


@triton.jit
def contact_list(lists, slot, m):
    """Return the index of the list that a slot belongs to (other objects, floor, walls), and the list's first slot."""
    k = tl.minimum(slot // lists.wide, m)
    start = k * lists.wide
    if slot >= lists.slots - lists.narrow:
        k, start = m + 1, lists.slots - lists.narrow
    return k, start


@triton.jit
def _response(J, r):
    """Inverse effective mass 1 - [r] J [r] of a point at arm r of a body of unit mass: velocity per unit impulse.

    J is the inverse inertia. The result is symmetric and returned as xx, xy, xz, yy, yz, zz.
    """
    a = sub(scale3(r[2], (J[1], J[4], J[7])), scale3(r[1], (J[2], J[5], J[8])))
    b = sub(scale3(r[0], (J[2], J[5], J[8])), scale3(r[2], (J[0], J[3], J[6])))
    c = sub(scale3(r[1], (J[0], J[3], J[6])), scale3(r[0], (J[1], J[4], J[7])))
    return (1 - r[1] * a[2] + r[2] * a[1], r[0] * a[2] - r[2] * a[0], r[1] * a[0] - r[0] * a[1],
            1 - r[2] * b[0] + r[0] * b[2], r[1] * b[0] - r[0] * b[1], 1 - r[0] * c[1] + r[1] * c[0])  # fmt: skip


@triton.jit
def _fade(x, start: tl.constexpr, end: tl.constexpr):
    """Smoothstep: 1 up to `start`, 0 from `end`."""
    s = tl.minimum(tl.maximum((end - x) / (end - start), 0.0), 1.0)
    return s * s * (3 - 2 * s)


@triton.jit
def _length(a):
    """Length of a vector, regularised at 0."""
    return tl.sqrt(dot(a, a) + 1e-12)


@triton.jit
def contact_features(inputs, drifted, lists, C: tl.constexpr):
    """Write the features of a block of contact points into the lists' `record`.

    Contacts with another object have 10 vectors and 7 scalars, contacts with floor or walls 8 vectors and 5 scalars.
    """
    i, o, n, slots = tl.program_id(0), inputs.o, inputs.n, lists.slots
    m, slot = o - 1, tl.program_id(1) * ROWS
    k, start = contact_list(lists, slot, m)
    r = tl.arange(0, ROWS)
    listed = slot - start + r < tl.load(lists.count + i * (o + 1) + k)
    if slot - start < tl.load(lists.count + i * (o + 1) + k):
        to = lists.record + (i * slots + slot) * COLUMNS + r
        own = tl.load(lists.point + i * slots + slot + r, mask=listed, other=0)
        at = drifted.points + POINT_SIZE * i * n + own
        x, speed = load3(at + POINT * n, n, listed), load3(at + SPEED * n, n, listed)
        normal, arm = load3(at + NORMAL * n, n, listed), load3(at + ARM * n, n, listed)
        tl.store(to + MASS_FRACTION * ROWS, tl.load(inputs.mass_fraction + i * n + own, mask=listed, other=0.0))
        gap = tl.load(inputs.spacing + i * n + own, mask=listed, other=0.0) / C.GAP_UNIT
        extent = tl.log(tl.load(inputs.size + i))
        zero = x[0] * 0.0
        gravity_term = add(scale3(0.2, read3(inputs.gravity + 3 * (i // o))), (zero, zero, zero))
        v = read3(drifted.body + BODY_SIZE * i + VELOCITY)
        own_response = _response(read9(drifted.body + BODY_SIZE * i + INVERSE_INERTIA), arm)
        if k < m:
            j = other_object(i, k, o)
            other = tl.load(lists.partner + i * slots + slot + r, mask=listed, other=0)
            at = drifted.points + POINT_SIZE * j * n + other
            offset, rate = sub(x, load3(at + POINT * n, n, listed)), sub(speed, load3(at + SPEED * n, n, listed))
            other_normal, other_arm = load3(at + NORMAL * n, n, listed), load3(at + ARM * n, n, listed)
            own_mass, other_mass = (
                tl.maximum(tl.load(inputs.mass + i), 1e-6),
                tl.maximum(tl.load(inputs.mass + j), 1e-6),
            )
            other_response = _response(read9(drifted.body + BODY_SIZE * j + INVERSE_INERTIA), other_arm)
            f = other_mass / (own_mass + other_mass)
            g = 1 - f
            K = (f * own_response[0] + g * other_response[0], f * own_response[1] + g * other_response[1],
                 f * own_response[2] + g * other_response[2], f * own_response[3] + g * other_response[3],
                 f * own_response[4] + g * other_response[4], f * own_response[5] + g * other_response[5])  # fmt: skip
            now, ahead = _length(offset), _length(add(offset, scale3(C.FRAME, rate)))
            a, b = solve_symmetric(K, rate, other_normal)
            relative_velocity = sub(v, read3(drifted.body + BODY_SIZE * j + VELOCITY))
            store3(to, MAX_VECTORS * ROWS, scale3(1 / C.GAP_UNIT, offset), listed)
            store3(to + ROWS, MAX_VECTORS * ROWS, normal, listed)
            store3(to + 2 * ROWS, MAX_VECTORS * ROWS, other_normal, listed)
            store3(to + 3 * ROWS, MAX_VECTORS * ROWS, rate, listed)
            store3(to + 4 * ROWS, MAX_VECTORS * ROWS, scale3(1 / C.ARM_UNIT, arm), listed)
            store3(to + 5 * ROWS, MAX_VECTORS * ROWS, scale3(1 / C.ARM_UNIT, other_arm), listed)
            store3(to + 6 * ROWS, MAX_VECTORS * ROWS, add(relative_velocity, (zero, zero, zero)), listed)
            store3(to + 7 * ROWS, MAX_VECTORS * ROWS, gravity_term, listed)
            store3(to + 8 * ROWS, MAX_VECTORS * ROWS, a, listed)
            store3(to + 9 * ROWS, MAX_VECTORS * ROWS, b, listed)
            to += FIRST_SCALAR * ROWS
            tl.store(to, now / C.GAP_UNIT, mask=listed)
            tl.store(to + ROWS, ahead / C.GAP_UNIT, mask=listed)
            tl.store(to + 2 * ROWS, _fade(tl.minimum(now, ahead), C.FULL_CONTACT, C.NO_CONTACT), mask=listed)
            tl.store(to + 3 * ROWS, gap, mask=listed)
            tl.store(
                to + 4 * ROWS, tl.load(inputs.spacing + j * n + other, mask=listed, other=0.0) / C.GAP_UNIT, mask=listed
            )
            tl.store(to + 5 * ROWS, extent + zero, mask=listed)
            tl.store(to + 6 * ROWS, tl.log(tl.load(inputs.size + j)) + zero, mask=listed)
        else:
            bounds = inputs.box + 6 * i
            now, inward = nearest_wall(x, bounds)
            if k == m:
                now, inward = x[2] - tl.load(bounds + 2), (zero, zero, zero + 1)
            ahead = now + C.FRAME * dot(speed, inward)
            a, b = solve_symmetric(own_response, speed, inward)
            store3(to, MAX_VECTORS * ROWS, inward, listed)
            store3(to + ROWS, MAX_VECTORS * ROWS, normal, listed)
            store3(to + 2 * ROWS, MAX_VECTORS * ROWS, speed, listed)
            store3(to + 3 * ROWS, MAX_VECTORS * ROWS, scale3(1 / C.ARM_UNIT, arm), listed)
            store3(to + 4 * ROWS, MAX_VECTORS * ROWS, add(v, (zero, zero, zero)), listed)
            store3(to + 5 * ROWS, MAX_VECTORS * ROWS, gravity_term, listed)
            store3(to + 6 * ROWS, MAX_VECTORS * ROWS, a, listed)
            store3(to + 7 * ROWS, MAX_VECTORS * ROWS, b, listed)
            to += FIRST_SCALAR * ROWS
            tl.store(to, tl.minimum(tl.maximum(now / C.GAP_UNIT, -2.0), 2.0), mask=listed)
            tl.store(to + ROWS, tl.minimum(tl.maximum(ahead / C.GAP_UNIT, -2.0), 2.0), mask=listed)
            tl.store(to + 2 * ROWS, _fade(tl.minimum(now, ahead), C.FULL_CONTACT, C.NO_CONTACT), mask=listed)
            tl.store(to + 3 * ROWS, gap, mask=listed)
            tl.store(to + 4 * ROWS, extent + zero, mask=listed)
