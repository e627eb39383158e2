"""Contact search and contact reduction for rigid bodies, one group of threads per scene.

Contact points are samples of one body's surface near another body or a plane. The samples of a pair are sorted by the
world axis (of six) closest to the contact normal. For each axis, contact reduction keeps the deepest sample and the
extreme samples in eight tangential directions; the other samples lie within the polygon of these, which can bear their
load. The extent of a sample along a direction is reduced by ten times its gap, so that touching samples take precedence
over those that are only close.

Source: manifold reduction by extremes: Moravanszky and Terdiman 2004, "Fast contact reduction for dynamics simulation".
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.field.groups import GroupThread, wait_for_group
from stages.core.kernels.field.near_points import (
    BodyMotion,
    NearPoint,
    ball_ahead,
    ball_near,
    in_body_frame,
    plane_gap,
    plane_near,
    sample_at_plane,
    sample_near,
)
from stages.core.kernels.field.surface_lookup import SurfaceArrays, beyond_grid, nearest_node

SIDES = wp.constant(6)  # directions of normals, and of planes: +x, +y, +z, -x, -y, -z
EXTREMES = wp.constant(9)  # contacts kept per direction of the normal: eight tangential extremes, and the deepest
SLOTS = wp.constant(6 * 9)  # contact slots of a pair
NONE = wp.constant(-1)
DIAGONAL = wp.constant(0.70710678)  # 1 / sqrt(2)
GAP_WEIGHT = wp.constant(10.0)  # factor by which a sample's gap reduces its extent along a direction
AHEAD = wp.constant(9)  # slot of the point where a ball hits another body during a step
RANKS = wp.constant(3)  # nearest points of a ball on different sides of another body, in the first slots


@wp.struct
class Found:
    """Results of the search for each pair of bodies a and b; the pair of a body with itself is for its planes."""

    possible: wp.array2d[wp.bool]  # whether the bodies are close enough for contact (broad phase)
    side: wp.array3d[wp.int8]  # side of the contact normal at each sample; NONE where the sample is not near
    gap: wp.array3d[float]  # gap of each near sample [m]
    other: wp.array3d[int]  # keypoint of b nearest to each near sample
    near: wp.array3d[int]  # compact list of the near samples
    near_count: wp.array2d[int]  # length of `near`
    score: wp.array2d[float]  # extent of the sample in each slot along the slot's direction
    row: wp.array2d[int]  # sample in each slot; NONE if empty
    count: wp.array2d[int]  # number of contacts


@wp.struct
class CollisionWorld:
    """Surfaces and motion of the bodies of each scene, and the results of the search."""

    surfaces: SurfaceArrays
    motion: BodyMotion
    found: Found


@wp.func
def _side_of(normal: wp.vec3) -> int:
    """Index (see SIDES) of the signed axis closest to a normal."""
    axis = int(0)
    for i in range(1, 3):
        if wp.abs(normal[i]) > wp.abs(normal[axis]):
            axis = i
    return wp.where(normal[axis] < 0.0, axis + 3, axis)


@wp.func
def _possible(s: SurfaceArrays, motion: BodyMotion, scene: int, a: int, b: int) -> bool:
    """Broad phase: whether body a may touch body b, or the planes if b = a."""
    if motion.pinned[scene, a] and (a == b or motion.pinned[scene, b]):
        return False
    if a != b and s.radius[b] > 0.0 and (s.radius[a] == 0.0 or b < a):
        return False  # treated as a contact of ball b with a
    com = motion.com[scene, a]
    if a != b:
        reach = s.reach[a] + s.reach[b] + motion.margin[scene, a] + motion.margin[scene, b]
        return wp.length(com - motion.com[scene, b]) < reach
    out = bool(False)
    for side in range(SIDES):
        out = out or plane_gap(motion, scene, a, side, com) < s.reach[a] + motion.margin[scene, a]
    return out


@wp.func
def _margin(motion: BodyMotion, scene: int, a: int, b: int) -> float:
    return motion.margin[scene, a] + wp.where(a == b, 0.0, motion.margin[scene, b])


@wp.func
def _look_at(w: CollisionWorld, scene: int, pair: int, q: int):
    """Narrow phase for sample q of a pair: set its gap and the side of its normal if it is near."""
    a = pair // w.surfaces.near.shape[0]
    b = pair % w.surfaces.near.shape[0]
    w.found.side[scene, pair, q] = wp.int8(NONE)
    if w.surfaces.near[a, q] == NONE:
        return
    margin = _margin(w.motion, scene, a, b)
    if a == b:
        least = margin  # a sample near several planes touches only the nearest one
        for side in range(SIDES):
            gap = plane_gap(w.motion, scene, a, side, sample_at_plane(w.surfaces, w.motion, scene, a, side, q))
            if gap < least:
                least = gap
                w.found.gap[scene, pair, q] = gap
                w.found.side[scene, pair, q] = wp.int8(side)
        return
    at = w.motion.com[scene, a] + w.motion.R[scene, a] * w.surfaces.samples[a, q]
    x = in_body_frame(w.motion, scene, b, at)
    if beyond_grid(w.surfaces, b, x) < margin:
        point = sample_near(w.surfaces, w.motion, scene, a, b, q)
        if point.gap < margin and point.facing:
            w.found.gap[scene, pair, q] = point.gap
            w.found.side[scene, pair, q] = wp.int8(_side_of(point.normal))
            w.found.other[scene, pair, q] = w.surfaces.keypoint[nearest_node(w.surfaces, b, x)]


@wp.func
def _list_near(w: CollisionWorld, scene: int, pair: int):
    count = int(0)
    for q in range(w.surfaces.near.shape[1]):
        if w.found.side[scene, pair, q] != wp.int8(NONE):
            w.found.near[scene, pair, count] = q
            count += 1
    w.found.near_count[scene, pair] = count


@wp.func
def _keep_extremes(w: CollisionWorld, scene: int, pair: int, k: int):
    """Fill the slots of the k-th direction for all sides; the last direction is depth."""
    a = pair // w.surfaces.near.shape[0]
    for side in range(SIDES):
        w.found.row[scene, pair * SLOTS + side * EXTREMES + k] = NONE
    for i in range(w.found.near_count[scene, pair]):
        q = w.found.near[scene, pair, i]
        side = int(w.found.side[scene, pair, q])
        gap = w.found.gap[scene, pair, q]
        value = -gap
        if k < EXTREMES - 1:
            arm = w.motion.R[scene, a] * w.surfaces.samples[a, q]
            u = arm[(side + 1) % 3]
            v = arm[(side + 2) % 3]
            if k < 4:  # diagonals
                value = DIAGONAL * (wp.where(k < 2, u, -u) + wp.where(k % 2 == 0, v, -v))
            elif k < 6:
                value = wp.where(k == 4, u, -u)
            else:
                value = wp.where(k == 6, v, -v)
            value -= GAP_WEIGHT * wp.max(gap, 0.0)
        slot = pair * SLOTS + side * EXTREMES + k
        if w.found.row[scene, slot] == NONE or value > w.found.score[scene, slot]:
            w.found.score[scene, slot] = value
            w.found.row[scene, slot] = q


@wp.func
def _count_contacts(w: CollisionWorld, scene: int, pair: int):
    """Clear slots whose sample is in an earlier slot of the same side, and count the rest; a ball has few slots."""
    a = pair // w.surfaces.near.shape[0]
    b = pair % w.surfaces.near.shape[0]
    count = int(0)
    for slot in range(SLOTS):
        at = pair * SLOTS + slot
        if w.surfaces.radius[a] > 0.0:
            touches = bool(False)
            if a == b and slot % EXTREMES == 0:
                gap = plane_near(w.surfaces, w.motion, scene, a, slot // EXTREMES, 0).gap
                touches = gap < w.motion.margin[scene, a]
            elif a != b and slot < RANKS:
                touches = ball_near(w.surfaces, w.motion, scene, a, b, slot).gap < _margin(w.motion, scene, a, b)
            elif slot == AHEAD and a != b:
                touches = ball_ahead(w.surfaces, w.motion, scene, a, b).gap < _margin(w.motion, scene, a, b)
            w.found.row[scene, at] = wp.where(touches, slot % EXTREMES, NONE)
        for other in range(slot - slot % EXTREMES, slot):
            if w.found.row[scene, pair * SLOTS + other] == w.found.row[scene, at]:
                w.found.row[scene, at] = NONE
        if w.found.row[scene, at] != NONE:
            count += 1
    w.found.count[scene, pair] = count


@wp.func
def search(w: CollisionWorld, thread: GroupThread):
    """Find the contacts of all pairs: fill their slots, count them, and list the near samples."""
    scene = thread.scene
    bodies = w.surfaces.near.shape[0]
    samples = w.surfaces.near.shape[1]
    pairs = bodies * bodies
    for pair in range(thread.lane, pairs, thread.lanes):
        w.found.possible[scene, pair] = _possible(w.surfaces, w.motion, scene, pair // bodies, pair % bodies)
        w.found.count[scene, pair] = 0
    wait_for_group()
    for pair in range(pairs):
        if w.found.possible[scene, pair]:
            for q in range(thread.lane, samples, thread.lanes):
                _look_at(w, scene, pair, q)
    wait_for_group()
    for pair in range(thread.lane, pairs, thread.lanes):
        if w.found.possible[scene, pair]:
            _list_near(w, scene, pair)
    wait_for_group()
    for row in range(thread.lane, pairs * EXTREMES, thread.lanes):
        pair = row // EXTREMES
        if w.found.possible[scene, pair] and w.surfaces.radius[pair // bodies] == 0.0:
            _keep_extremes(w, scene, pair, row % EXTREMES)
    wait_for_group()
    for pair in range(thread.lane, pairs, thread.lanes):
        if w.found.possible[scene, pair]:
            _count_contacts(w, scene, pair)
    wait_for_group()


@wp.func
def contact_in_slot(w: CollisionWorld, scene: int, pair: int, slot: int) -> NearPoint:
    """Return the contact that `search` has put in a slot of a pair."""
    a = pair // w.surfaces.near.shape[0]
    b = pair % w.surfaces.near.shape[0]
    q = w.found.row[scene, pair * SLOTS + slot]
    if a == b:
        return plane_near(w.surfaces, w.motion, scene, a, slot // EXTREMES, q)
    if w.surfaces.radius[a] > 0.0:
        if slot == AHEAD:
            return ball_ahead(w.surfaces, w.motion, scene, a, b)
        return ball_near(w.surfaces, w.motion, scene, a, b, slot)
    return sample_near(w.surfaces, w.motion, scene, a, b, q)
