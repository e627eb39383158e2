"""Broad and narrow phase of the force field's contacts: compact lists of the contact points of each object.

`gather_candidates` (broad phase) lists the points of each object near the bounding box of each other object,
`nearest_candidates` (narrow phase) finds for each of them the other object's nearest point, and `select_contacts` keeps
the closest of these, and of the points near floor and walls, as contact points.
Reference: `stages.core.models.field.contact_points`. Written in Triton (see `compilers`).
"""

import triton
import triton.language as tl

from stages.core.kernels.field.bodies import BODY_SIZE, BOX_HIGH, BOX_LOW, CONTACT_RADIUS, POINT, POINT_SIZE, SPEED
from stages.core.kernels.field.vec3 import add, dot, load3, scale3, store3, sub

QUERY_BLOCK, CANDIDATE_CHUNK = 16, 128  # points per program, and candidates that it reads at a time


@triton.jit
def other_object(i, k, o):
    """Index of the k-th other object of object i's scene."""
    return i - i % o + k + (k >= i % o)


@triton.jit
def _contact_distance(body, i, j, SEARCH_RADIUS: tl.constexpr):
    """Distance [m] beyond which two objects cannot touch within a frame."""
    radius = tl.load(body + BODY_SIZE * i + CONTACT_RADIUS) + tl.load(body + BODY_SIZE * j + CONTACT_RADIUS)
    return tl.minimum(radius, SEARCH_RADIUS)


@triton.jit
def gather_candidates(
    body, moved, valid, positions, which, candidates, o, n, SEARCH_RADIUS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """List the points of object i within contact distance of another object's bounding box: `positions`,
    `which` (point indices) and `candidates` (their number)."""
    i, k = tl.program_id(0), tl.program_id(1)
    j = other_object(i, k, o)
    radius = _contact_distance(body, i, j, SEARCH_RADIUS)
    r = tl.arange(0, BLOCK)
    near = tl.load(valid + i * n + r, mask=r < n, other=0) != 0
    x = load3(moved + (POINT_SIZE * i + POINT) * n + r, n, r < n)
    for axis in tl.static_range(3):
        near &= x[axis] > tl.load(body + BODY_SIZE * j + BOX_LOW + axis) - radius
        near &= x[axis] < tl.load(body + BODY_SIZE * j + BOX_HIGH + axis) + radius
    row = i * (o - 1) + k
    slot = tl.cumsum(near.to(tl.int32), 0) - 1
    store3(positions + 3 * row * n + slot, n, x, near)
    tl.store(which + row * n + slot, r, mask=near)
    tl.store(candidates + row, tl.sum(near.to(tl.int32)))


@triton.jit
def nearest_candidates(
    body, moved, positions, which, candidates, keys, partner, o, n, SEARCH_RADIUS: tl.constexpr, FRAME: tl.constexpr,
    QUERY_BLOCK: tl.constexpr, CANDIDATE_CHUNK: tl.constexpr,
):  # fmt: skip
    """For each listed point find the other object's nearest listed point: `partner` (its index) and `keys` (its
    distance [m], the smaller of now and FRAME seconds ahead)."""
    i, k = tl.program_id(0) // (o - 1), tl.program_id(0) % (o - 1)
    j = other_object(i, k, o)
    row, other = i * (o - 1) + k, j * (o - 1) + i % o - (i > j)
    count, last = tl.load(candidates + row), tl.load(candidates + other)
    first = tl.program_id(1) * QUERY_BLOCK
    if first < count:
        radius = _contact_distance(body, i, j, SEARCH_RADIUS)
        infinity: tl.constexpr = float("inf")
        e = first + tl.arange(0, QUERY_BLOCK)
        x = load3(positions + 3 * row * n + e, n, e < count)
        column = tl.arange(0, CANDIDATE_CHUNK)
        smallest = tl.full([QUERY_BLOCK, CANDIDATE_CHUNK], infinity, tl.float32)
        chunk = tl.zeros([QUERY_BLOCK, CANDIDATE_CHUNK], tl.int32)
        for start in range(0, last, CANDIDATE_CHUNK):
            s = start + column
            y = load3(positions + 3 * other * n + s, n, s < last, infinity)
            dx, dy, dz = x[0][:, None] - y[0][None, :], x[1][:, None] - y[1][None, :], x[2][:, None] - y[2][None, :]
            squared = dx * dx + dy * dy + dz * dz
            chunk = tl.where(squared < smallest, start, chunk)
            smallest = tl.minimum(squared, smallest)
        best = tl.min(smallest, 1)
        entry = tl.min(tl.where(smallest == best[:, None], chunk + column[None, :], n), 1)
        found = (e < count) & (best < radius * radius)
        own_point = tl.load(which + row * n + e, mask=found, other=0)
        other_point = tl.load(which + other * n + entry, mask=found, other=0)
        at_own, at_other = moved + POINT_SIZE * i * n + own_point, moved + POINT_SIZE * j * n + other_point
        offset = sub(x, load3(at_other + POINT * n, n, found))
        rate = sub(load3(at_own + SPEED * n, n, found), load3(at_other + SPEED * n, n, found))
        offset = add(offset, scale3(FRAME, rate))
        key = tl.where(found, tl.sqrt(tl.minimum(best, dot(offset, offset))), infinity)
        tl.store(keys + row * n + e, key, mask=e < count)
        tl.store(partner + row * n + e, other_point, mask=e < count)


@triton.jit
def _smallest(key, near, count):
    """The keys as sortable integers, and the `count`-th smallest of those with `near`, found by bisection over bits."""
    bits = key.to(tl.int32, bitcast=True).to(tl.int64)
    bits = tl.where(bits < 0, -1 - (bits & 0x7FFFFFFF), bits) + 0x80000000
    bits = tl.where(near, bits, 0x1FFFFFFFF)
    limit = tl.full([], 0, tl.int64)
    step = tl.full([], 0x80000000, tl.int64)
    for _ in range(32):
        limit = tl.where(tl.sum((bits < limit + step).to(tl.int32)) < count, limit + step, limit)
        step = step >> 1
    return bits, limit


@triton.jit
def select_contacts(
    keys, planes, which, partner, candidates, valid, count, point, other_point, accelerations, o, n, wide, narrow,
    slots, PAIR_FRACTION: tl.constexpr, WALL_FRACTION: tl.constexpr, NO_CONTACT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Select the contact points of an object with one other object, the floor or the walls: the closest ones, at most
    a fraction (PAIR_FRACTION, 1, WALL_FRACTION) of the object's points. Writes the indices of its points and of the
    other object's, and counts.

    The lists of an object are stored one after the other: other objects (`wide` slots each), floor, walls (`narrow`
    slots), `slots` in all.
    """
    i, k, m = tl.program_id(0), tl.program_id(1), o - 1
    r = tl.arange(0, BLOCK)
    limit_count = tl.sum(tl.load(valid + i * n + r, mask=r < n, other=0).to(tl.int32))
    infinity: tl.constexpr = float("inf")
    zero = tl.zeros([BLOCK], tl.float32)
    store3(accelerations + (i * (o + 1) + k) * 3 * n + r, n, (zero, zero, zero), r < n)
    to = i * slots + k * wide
    if k < m:
        row = i * m + k
        listed = r < tl.load(candidates + row)
        key = tl.load(keys + row * n + r, mask=listed, other=infinity)
        own = tl.load(which + row * n + r, mask=listed, other=0)
        other = tl.load(partner + row * n + r, mask=listed, other=0)
        limit_count = tl.ceil(PAIR_FRACTION * limit_count).to(tl.int32)
    else:
        key = tl.load(planes + (2 * i + k - m) * n + r, mask=r < n, other=infinity)
        own, other = r, r
        if k > m:
            to = (i + 1) * slots - narrow
            limit_count = tl.ceil(WALL_FRACTION * limit_count).to(tl.int32)
    near = key < NO_CONTACT
    if tl.sum(near.to(tl.int32)) > limit_count:
        bits, limit = _smallest(key, near, limit_count)
        near &= bits <= limit
    slot = tl.cumsum(near.to(tl.int32), 0) - 1
    near &= slot < limit_count  # ties
    tl.store(point + to + slot, own, mask=near)
    tl.store(other_point + to + slot, other, mask=near)
    tl.store(count + i * (o + 1) + k, tl.sum(near.to(tl.int32)))
