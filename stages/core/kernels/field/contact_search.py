"""Contact points of rigid bodies, a group of threads for each scene: samples of one surface near another.

Of the samples of a body near another one, or near a plane, those are kept that span the contact in eight directions
across its normal, and the deepest: for each of six directions of the normal, in world axes. The others lie within the
polygon of these and would bear a load that these can bear. A sample counts for less by ten times its gap, so that those
that touch come before those that only may.

Contacts are found before bodies touch, up to the way of a step, and limit the velocity to the gap over the step.
Samples and balls that would pass through a wall meet it at the first place of their way that is inside.
Sources: manifold reduction by extremes: Moravanszky and Terdiman 2004, "Fast contact reduction for dynamics
simulation"; contacts before bodies touch: Stewart and Trinkle 1996, "An implicit time-stepping scheme for rigid body
dynamics with inelastic collisions and Coulomb friction".
"""

from __future__ import annotations

import warp as wp

from stages.core.geometry import surface_faces as faces
from stages.core.kernels.field.groups import GroupThread, wait_for_group
from stages.core.kernels.field.surface_lookup import (
    SurfaceArrays,
    beyond_grid,
    closest_point,
    depth_at,
    first_inside,
    nearest_node,
)

SIDES = wp.constant(6)  # directions of normals, and of planes: +x, +y, +z, -x, -y, -z
EXTREMES = wp.constant(9)  # kept of each: in eight directions, and the deepest
SLOTS = wp.constant(6 * 9)
NONE = wp.constant(-1)
DIAGONAL = wp.constant(0.70710678)
GAP_WEIGHT = wp.constant(10.0)  # of a gap against the distance along a direction
AHEAD = wp.constant(9)  # slot of the point of a ball that meets another body in a step; that of the nearest one is 0
NO_CONTACT = wp.constant(1.0e18)  # gap [m]
MARGIN = wp.constant(0.05)  # gap up to which points count, in addition to the way of a step [m]; a tenth of an object
# Least cosine of the angle at which two surfaces face each other in a contact; .58 for a cube standing on its corner.
MIN_FACING = wp.constant(0.3)
OPPOSED, CURVED, FACES = wp.constant(faces.OPPOSED), wp.constant(faces.CURVED), wp.constant(faces.FACES)
STEP_OF_A_CELL = wp.constant(0.25)  # way of a sample in a step that matters for its contact, in nodes of the grid
THINNEST = wp.constant(2.0)  # a way that may lead through a wall, in nodes of the grid: sheets have three voxels
NO_DISTANCE = wp.constant(1e-6)  # in radii of a ball, that has no direction


@wp.struct
class BodyMotion:
    """Where the bodies of each scene are, and how they move."""

    com: wp.array2d[wp.vec3]
    quat: wp.array2d[wp.vec4]
    R: wp.array2d[wp.mat33]
    velocity: wp.array2d[wp.vec3]
    momentum: wp.array2d[wp.vec3]  # angular, per unit of mass
    spin: wp.array2d[wp.vec3]
    low: wp.array2d[wp.vec3]  # the room of each body
    high: wp.array2d[wp.vec3]
    margin: wp.array2d[float]  # gap up to which contacts are looked for [m]
    pinned: wp.array2d[wp.bool]
    step: float  # [s]


@wp.struct
class Found:
    """What was found for each pair of bodies a and b; that of a body with itself is for the planes around it."""

    possible: wp.array2d[wp.bool]  # whether both are near each other
    side: wp.array3d[wp.int8]  # of the normal at each sample; NONE where it is not near
    gap: wp.array3d[float]  # of each sample [m]
    other: wp.array3d[int]  # keypoint of b near each sample
    near: wp.array3d[int]  # samples that are near, one after the other
    near_count: wp.array2d[int]
    score: wp.array2d[float]  # of each slot
    row: wp.array2d[int]  # sample in each slot
    count: wp.array2d[int]  # contacts


@wp.struct
class CollisionWorld:
    """The surfaces of the bodies of each scene, where these are, and what of them is near others."""

    surfaces: SurfaceArrays
    motion: BodyMotion
    found: Found


@wp.struct
class NearPoint:
    """A point of body a near body b or near a plane."""

    a: int
    b: int  # a at a plane
    at: wp.vec3  # of a [m]
    gap: float  # [m]
    normal: wp.vec3  # of b, towards a
    facing: bool  # whether both surfaces face each other


@wp.func
def _inward(side: int) -> wp.vec3:
    """Normal of a plane of the room."""
    out = wp.vec3()
    out[side % 3] = wp.where(side < 3, 1.0, -1.0)
    return out


@wp.func
def _plane_gap(motion: BodyMotion, scene: int, a: int, side: int, x: wp.vec3) -> float:
    axis = side % 3
    if side < 3:
        return x[axis] - motion.low[scene, a][axis]
    return motion.high[scene, a][axis] - x[axis]


@wp.func
def _local(motion: BodyMotion, scene: int, body: int, x: wp.vec3) -> wp.vec3:
    return wp.transpose(motion.R[scene, body]) * (x - motion.com[scene, body])


@wp.func
def _way_of_a_step(motion: BodyMotion, scene: int, a: int, b: int, x: wp.vec3) -> wp.vec3:
    """The way of body a at x in a step, in the frame of body b and relative to it [m]."""
    velocity = motion.velocity[scene, a] + wp.cross(motion.spin[scene, a], x - motion.com[scene, a])
    velocity -= motion.velocity[scene, b] + wp.cross(motion.spin[scene, b], x - motion.com[scene, b])
    return motion.step * (wp.transpose(motion.R[scene, b]) * velocity)


@wp.func
def sample_near(s: SurfaceArrays, motion: BodyMotion, scene: int, a: int, b: int, q: int) -> NearPoint:
    """Sample q of body a at body b."""
    out = NearPoint()
    out.a = a
    out.b = b
    R = motion.R[scene, b]
    out.at = motion.com[scene, a] + motion.R[scene, a] * s.samples[a, q]
    x = _local(motion, scene, b, out.at)
    found = depth_at(s, b, x)
    way = _way_of_a_step(motion, scene, a, b, out.at)
    if wp.length(way) > STEP_OF_A_CELL * s.spacing[b]:
        share = float(1.0)
        if wp.length(way) > THINNEST * s.spacing[b]:
            share = first_inside(s, b, x, way, -s.overlap[a, b])
            way *= share
        later = depth_at(s, b, x + way)
        if share < 1.0:  # it meets a wall, which it may have passed at the end
            x += way
        if share < 1.0 or later[3] < 0.0:  # else it stays outside, and may pass an edge whose normal would stop it
            later[3] = later[3] - wp.dot(wp.vec3(later[0], later[1], later[2]), way)
            found = later
    out.normal = -(R * wp.vec3(found[0], found[1], found[2]))
    out.gap = s.overlap[a, b] - found[3]
    own = motion.R[scene, a] * s.normals[a, q]
    out.facing = -wp.dot(own, out.normal) > MIN_FACING
    # Where b has an edge its depths increase in an oblique direction. The normal is that of a face: of faces that are
    # parallel the one of the flatter surface, else that of a if its sample is on one.
    p = s.point[a, q]
    r = s.nearest[nearest_node(s, b, x)]
    most = float(-1.0)
    opposite = wp.vec3()
    if r >= 0:
        to_b = wp.transpose(R) * motion.R[scene, a]
        for i in range(FACES):
            for j in range(FACES):
                facing = -wp.dot(to_b * s.faces[p, i], s.faces[r, j])
                if facing > most and wp.length_sq(s.faces[p, i]) > 0.0 and wp.length_sq(s.faces[r, j]) > 0.0:
                    most = facing
                    opposite = s.faces[r, j]
        if most > -1.0:
            out.facing = most > MIN_FACING
    if most > OPPOSED and (s.flatness[p] == 0.0 or s.flatness[r] > s.flatness[p] + CURVED):
        out.normal = R * opposite
    elif s.flatness[p] > 0.0:
        out.normal = -own
    return out


@wp.func
def ball_near(s: SurfaceArrays, motion: BodyMotion, scene: int, a: int, b: int) -> NearPoint:
    """The point of a ball a that is nearest to body b."""
    out = NearPoint()
    out.a = a
    out.b = b
    centre = motion.com[scene, a] + motion.R[scene, a] * s.centre[a]
    apart = centre - (motion.com[scene, b] + motion.R[scene, b] * s.centre[b])
    out.normal = wp.normalize(apart)
    out.gap = wp.length(apart) - s.radius[a] - s.radius[b]
    if s.radius[b] == 0.0:
        on = closest_point(s, b, _local(motion, scene, b, centre))
        outward = centre - (motion.com[scene, b] + motion.R[scene, b] * on.at)
        normal = motion.R[scene, b] * on.normal
        side = wp.where(wp.dot(outward, normal) < 0.0, -1.0, 1.0)  # the centre may be inside
        out.gap = side * wp.length(outward) - s.radius[a]
        out.normal = wp.where(wp.length(outward) > NO_DISTANCE * s.radius[a], side * wp.normalize(outward), normal)
    out.at = centre - s.radius[a] * out.normal
    out.gap += s.overlap[a, b]
    out.facing = True
    return out


@wp.func
def ball_ahead(s: SurfaceArrays, motion: BodyMotion, scene: int, a: int, b: int) -> NearPoint:
    """The point of a ball a that meets body b in a step, where that is not convex: the nearest point may be of another
    side. The gap is infinite where it meets none, or moves by less than its radius.
    """
    out = NearPoint()
    out.a = a
    out.b = b
    out.gap = NO_CONTACT
    out.facing = True
    if s.radius[b] > 0.0 or s.hull_faces[b] > 0:
        return out
    centre = motion.com[scene, a] + motion.R[scene, a] * s.centre[a]
    x = _local(motion, scene, b, centre)
    way = _way_of_a_step(motion, scene, a, b, centre)
    if wp.length(way) > s.radius[a]:
        outside = s.radius[a] - s.overlap[a, b]
        share = first_inside(s, b, x, way, outside)
        if share < 1.0:
            found = depth_at(s, b, x + share * way)
            inward = wp.vec3(found[0], found[1], found[2])
            out.normal = -(motion.R[scene, b] * inward)
            out.gap = share * wp.dot(inward, way) - found[3] - outside
            out.at = centre - s.radius[a] * out.normal
    return out


@wp.func
def plane_near(s: SurfaceArrays, motion: BodyMotion, scene: int, a: int, side: int, q: int) -> NearPoint:
    """Sample q of body a, or the point of a ball, at a plane."""
    out = NearPoint()
    out.a = a
    out.b = a
    out.normal = _inward(side)
    if s.radius[a] > 0.0:
        out.at = motion.com[scene, a] + motion.R[scene, a] * s.centre[a] - s.radius[a] * out.normal
    else:
        out.at = motion.com[scene, a] + motion.R[scene, a] * s.samples[a, q]
    out.gap = _plane_gap(motion, scene, a, side, out.at)
    out.facing = True
    return out


@wp.func
def _side_of(normal: wp.vec3) -> int:
    """The axis nearest to a normal."""
    axis = int(0)
    for i in range(1, 3):
        if wp.abs(normal[i]) > wp.abs(normal[axis]):
            axis = i
    return wp.where(normal[axis] < 0.0, axis + 3, axis)


@wp.func
def _possible(s: SurfaceArrays, motion: BodyMotion, scene: int, a: int, b: int) -> bool:
    """Whether contacts of body a with b, or with the planes if b = a, are to be looked for."""
    if motion.pinned[scene, a] and (a == b or motion.pinned[scene, b]):
        return False
    if a != b and s.radius[b] > 0.0 and (s.radius[a] == 0.0 or b < a):
        return False  # it is a contact of b with a
    com = motion.com[scene, a]
    if a != b:
        reach = s.reach[a] + s.reach[b] + motion.margin[scene, a] + motion.margin[scene, b]
        return wp.length(com - motion.com[scene, b]) < reach
    out = bool(False)
    for side in range(SIDES):
        out = out or _plane_gap(motion, scene, a, side, com) < s.reach[a] + motion.margin[scene, a]
    return out


@wp.func
def _margin(motion: BodyMotion, scene: int, a: int, b: int) -> float:
    return motion.margin[scene, a] + wp.where(a == b, 0.0, motion.margin[scene, b])


@wp.func
def _look_at(w: CollisionWorld, scene: int, pair: int, q: int):
    """Sample q of a pair: its gap and the side of its normal, if it is near."""
    a = pair // w.surfaces.near.shape[0]
    b = pair % w.surfaces.near.shape[0]
    w.found.side[scene, pair, q] = wp.int8(NONE)
    if w.surfaces.near[a, q] == NONE:
        return
    margin = _margin(w.motion, scene, a, b)
    at = w.motion.com[scene, a] + w.motion.R[scene, a] * w.surfaces.samples[a, q]
    if a == b:
        least = margin  # of a sample near several planes the nearest one counts
        for side in range(SIDES):
            gap = _plane_gap(w.motion, scene, a, side, at)
            if gap < least:
                least = gap
                w.found.gap[scene, pair, q] = gap
                w.found.side[scene, pair, q] = wp.int8(side)
        return
    x = _local(w.motion, scene, b, at)
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
    """Fill the slots of the k-th direction on all sides."""
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
    """Empty slots whose sample is in an earlier one of the same side, and count the others; a ball has one or two."""
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
            elif slot == 0:
                touches = ball_near(w.surfaces, w.motion, scene, a, b).gap < _margin(w.motion, scene, a, b)
            elif slot == AHEAD and a != b:
                touches = ball_ahead(w.surfaces, w.motion, scene, a, b).gap < _margin(w.motion, scene, a, b)
            w.found.row[scene, at] = wp.where(touches, 0, NONE)
        for other in range(slot - slot % EXTREMES, slot):
            if w.found.row[scene, pair * SLOTS + other] == w.found.row[scene, at]:
                w.found.row[scene, at] = NONE
        if w.found.row[scene, at] != NONE:
            count += 1
    w.found.count[scene, pair] = count


@wp.func
def search(w: CollisionWorld, thread: GroupThread):
    """Find the contacts of all pairs: their slots and number, and the samples that are near."""
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
    """The contact that `search` has put there."""
    a = pair // w.surfaces.near.shape[0]
    b = pair % w.surfaces.near.shape[0]
    q = w.found.row[scene, pair * SLOTS + slot]
    if a == b:
        return plane_near(w.surfaces, w.motion, scene, a, slot // EXTREMES, q)
    if w.surfaces.radius[a] > 0.0:
        if slot == AHEAD:
            return ball_ahead(w.surfaces, w.motion, scene, a, b)
        return ball_near(w.surfaces, w.motion, scene, a, b)
    return sample_near(w.surfaces, w.motion, scene, a, b, q)
