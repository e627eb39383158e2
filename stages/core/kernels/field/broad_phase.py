"""Broad and narrow phase of the force field's contacts: compact lists of the contact points of each object.

`gather_candidates` (broad phase) lists the points of each object near the bounding box of each other object.
`nearest_candidates` (narrow phase) finds the other object's nearest point for each listed point. `select_contacts`
keeps the closest of these pairs, and of the points near the floor and the walls, as contact points.
Reference: `stages.core.models.field.contact_points`. Written in Triton (see `compilers`).
"""

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from stages.core.kernels.field.bodies import BODY_SIZE, BOX_HIGH, BOX_LOW, CONTACT_RADIUS, POINT, POINT_SIZE, SPEED
from stages.core.kernels.field.vec3 import add, dot, load3, scale3, store3, sub

QUERY_BLOCK, CANDIDATE_CHUNK = tl.constexpr(16), tl.constexpr(128)  # points per program, candidates per iteration


class NearPoints(NamedTuple):
    """Points of each object near the bounding box of each of the k = o - 1 other objects."""

    position: Tensor  # (b o k 3 n) [m]
    which: Tensor  # (b o k n) indices within the object
    count: Tensor  # (b o k)
    key: Tensor  # (b o k n) distance to the nearest point of the other object [m], the smaller of now and one FRAME on
    partner: Tensor  # (b o k n) index of this nearest point


class ContactLists(NamedTuple):
    """Contact points of each object in consecutive lists: one per other object, then the floor, then the walls."""

    count: Tensor  # (b o, o + 1) contact points in each list
    point: Tensor  # (b o, slots) keypoint of each contact point
    partner: Tensor  # (b o, slots) keypoint of the other object
    record: Tensor  # (b o, slots COLUMNS) features, see `contact_features`
    acceleration: Tensor  # (b o, o + 1, 3, n) acceleration of the keypoints due to each list [m/s^2]
    wide: int  # slots of each list of contacts with another object
    narrow: int  # slots of the list of contacts with walls
    slots: int  # slots of all lists
    o: int  # objects per scene
    n: int  # keypoints per object
    FLOOR_BLOCKS: tl.constexpr  # blocks of rows in the floor's list, padded to a power of two
    PLANE_BLOCKS: tl.constexpr  # blocks of rows in the lists of floor and walls, padded to a power of two


@triton.jit
def other_object(i, k, o):
    """Index of the k-th other object of object i's scene."""
    return i - i % o + k + (k >= i % o)


@triton.jit
def _contact_distance(body, i, j, SEARCH_RADIUS: tl.constexpr):
    """Distance [m] beyond which two objects cannot touch within one FRAME."""
    radius = tl.load(body + BODY_SIZE * i + CONTACT_RADIUS) + tl.load(body + BODY_SIZE * j + CONTACT_RADIUS)
    return tl.minimum(radius, SEARCH_RADIUS)


@triton.jit
def gather_candidates(valid, drifted, candidates, C: tl.constexpr):
    """List the points of object i within contact distance of another object's bounding box.

    Writes `position`, `which` and `count` of the candidates.
    """
    i, k, o, n = tl.program_id(0), tl.program_id(1), drifted.o, drifted.n
    j = other_object(i, k, o)
    radius = _contact_distance(drifted.body, i, j, C.SEARCH_RADIUS)
    r = tl.arange(0, drifted.BLOCK)
    near = tl.load(valid + i * n + r, mask=r < n, other=0) != 0
    x = load3(drifted.points + (POINT_SIZE * i + POINT) * n + r, n, r < n)
    for axis in tl.static_range(3):
        near &= x[axis] > tl.load(drifted.body + BODY_SIZE * j + BOX_LOW + axis) - radius
        near &= x[axis] < tl.load(drifted.body + BODY_SIZE * j + BOX_HIGH + axis) + radius
    row = i * (o - 1) + k
    slot = tl.cumsum(near.to(tl.int32), 0) - 1
    store3(candidates.position + 3 * row * n + slot, n, x, near)
    tl.store(candidates.which + row * n + slot, r, mask=near)
    tl.store(candidates.count + row, tl.sum(near.to(tl.int32)))


@triton.jit
def nearest_candidates(drifted, candidates, C: tl.constexpr):
    """Find the other object's nearest listed point for each listed point; writes `partner` and `key`."""
    o, n = drifted.o, drifted.n
    i, k = tl.program_id(0) // (o - 1), tl.program_id(0) % (o - 1)
    j = other_object(i, k, o)
    row, other = i * (o - 1) + k, j * (o - 1) + i % o - (i > j)
    count, last = tl.load(candidates.count + row), tl.load(candidates.count + other)
    first = tl.program_id(1) * QUERY_BLOCK
    if first < count:
        radius = _contact_distance(drifted.body, i, j, C.SEARCH_RADIUS)
        infinity: tl.constexpr = float("inf")
        e = first + tl.arange(0, QUERY_BLOCK)
        x = load3(candidates.position + 3 * row * n + e, n, e < count)
        column = tl.arange(0, CANDIDATE_CHUNK)
        smallest = tl.full([QUERY_BLOCK, CANDIDATE_CHUNK], infinity, tl.float32)
        chunk = tl.zeros([QUERY_BLOCK, CANDIDATE_CHUNK], tl.int32)
        for start in range(0, last, CANDIDATE_CHUNK):
            s = start + column
            y = load3(candidates.position + 3 * other * n + s, n, s < last, infinity)
            dx, dy, dz = x[0][:, None] - y[0][None, :], x[1][:, None] - y[1][None, :], x[2][:, None] - y[2][None, :]
            squared = dx * dx + dy * dy + dz * dz
            chunk = tl.where(squared < smallest, start, chunk)
            smallest = tl.minimum(squared, smallest)
        best = tl.min(smallest, 1)
        entry = tl.min(tl.where(smallest == best[:, None], chunk + column[None, :], n), 1)
        found = (e < count) & (best < radius * radius)
        own_point = tl.load(candidates.which + row * n + e, mask=found, other=0)
        other_point = tl.load(candidates.which + other * n + entry, mask=found, other=0)
        at_own = drifted.points + POINT_SIZE * i * n + own_point
        at_other = drifted.points + POINT_SIZE * j * n + other_point
        offset = sub(x, load3(at_other + POINT * n, n, found))
        rate = sub(load3(at_own + SPEED * n, n, found), load3(at_other + SPEED * n, n, found))
        offset = add(offset, scale3(C.FRAME, rate))
        key = tl.where(found, tl.sqrt(tl.minimum(best, dot(offset, offset))), infinity)
        tl.store(candidates.key + row * n + e, key, mask=e < count)
        tl.store(candidates.partner + row * n + e, other_point, mask=e < count)


@triton.jit
def _smallest(key, near, count):
    """Return the keys as sortable integers, and the `count`-th smallest one among `near`, found bit by bit."""
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
def select_contacts(valid, drifted, candidates, lists, C: tl.constexpr):
    """Select the closest contact points of an object with another object, the floor or the walls.

    Keeps at most a fraction (PAIR_FRACTION, 1, WALL_FRACTION) of the object's points. Writes `count`, `point` and
    `partner` of the lists, and sets the accelerations to zero.
    """
    i, k, o, n = tl.program_id(0), tl.program_id(1), drifted.o, drifted.n
    m = o - 1
    r = tl.arange(0, drifted.BLOCK)
    limit_count = tl.sum(tl.load(valid + i * n + r, mask=r < n, other=0).to(tl.int32))
    infinity: tl.constexpr = float("inf")
    zero = tl.zeros([drifted.BLOCK], tl.float32)
    store3(lists.acceleration + (i * (o + 1) + k) * 3 * n + r, n, (zero, zero, zero), r < n)
    to = i * lists.slots + k * lists.wide
    if k < m:
        row = i * m + k
        listed = r < tl.load(candidates.count + row)
        key = tl.load(candidates.key + row * n + r, mask=listed, other=infinity)
        own = tl.load(candidates.which + row * n + r, mask=listed, other=0)
        other = tl.load(candidates.partner + row * n + r, mask=listed, other=0)
        limit_count = tl.ceil(C.PAIR_FRACTION * limit_count).to(tl.int32)
    else:
        key = tl.load(drifted.planes + (2 * i + k - m) * n + r, mask=r < n, other=infinity)
        own, other = r, r
        if k > m:
            to = (i + 1) * lists.slots - lists.narrow
            limit_count = tl.ceil(C.WALL_FRACTION * limit_count).to(tl.int32)
    near = key < C.NO_CONTACT
    if tl.sum(near.to(tl.int32)) > limit_count:
        bits, limit = _smallest(key, near, limit_count)
        near &= bits <= limit
    slot = tl.cumsum(near.to(tl.int32), 0) - 1
    near &= slot < limit_count  # equal keys can exceed the limit
    tl.store(lists.point + to + slot, own, mask=near)
    tl.store(lists.partner + to + slot, other, mask=near)
    tl.store(lists.count + i * (o + 1) + k, tl.sum(near.to(tl.int32)))
