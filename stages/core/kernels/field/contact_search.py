"""Contact points of rigid bodies, a group of threads for each scene: samples of one surface near another.

Of the samples of a body near another one, or near a plane, those are kept that span the contact in eight directions
across its normal, and the deepest: for each of six directions of the normal, in world axes. The others lie within the
polygon of these and would bear a load that these can bear. A sample counts for less by ten times its gap, so that those
that touch come before those that only may.
Source: manifold reduction by extremes: Moravanszky and Terdiman 2004, "Fast contact reduction for dynamics simulation".
"""

from __future__ import annotations

import warp as wp

from stages.core.geometry import surface_faces as faces
from stages.core.kernels.field.groups import wait_for_group
from stages.core.kernels.field.surface_lookup import SurfaceArrays, beyond_grid, closest_point, depth_at, nearest_node

SIDES = wp.constant(6)  # directions of normals, and of planes: +x, +y, +z, -x, -y, -z
EXTREMES = wp.constant(9)  # kept of each: in eight directions, and the deepest
SLOTS = wp.constant(6 * 9)
NONE = wp.constant(-1)
DIAGONAL = wp.constant(0.70710678)
GAP_WEIGHT = wp.constant(10.0)  # of a gap against the distance along a direction
MARGIN = wp.constant(0.05)  # gap up to which points count, in addition to the way of a step [m]; a tenth of an object
# Least cosine of the angle at which two surfaces face each other in a contact; .58 for a cube standing on its corner.
MIN_FACING = wp.constant(0.3)
OPPOSED, CURVED, FACES = wp.constant(faces.OPPOSED), wp.constant(faces.CURVED), wp.constant(faces.FACES)
STEP_OF_A_CELL = wp.constant(0.25)  # way of a sample in a step that matters for its contact, in nodes of the grid
NO_DISTANCE = wp.constant(1e-6)  # in radii of a ball, that has no direction


@wp.struct
class BodyPoses:
    """Where the bodies of each scene are."""

    com: wp.array2d[wp.vec3]
    R: wp.array2d[wp.mat33]
    low: wp.array2d[wp.vec3]  # the room of each body
    high: wp.array2d[wp.vec3]
    margin: wp.array2d[float]  # gap up to which contacts are looked for [m]
    pinned: wp.array2d[wp.bool]
    velocity: wp.array2d[wp.vec3]
    spin: wp.array2d[wp.vec3]
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
class NearPoint:
    """A point of body a near body b or near a plane."""

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
def _plane_gap(poses: BodyPoses, scene: int, a: int, side: int, x: wp.vec3) -> float:
    axis = side % 3
    if side < 3:
        return x[axis] - poses.low[scene, a][axis]
    return poses.high[scene, a][axis] - x[axis]


@wp.func
def _local(poses: BodyPoses, scene: int, body: int, x: wp.vec3) -> wp.vec3:
    return wp.transpose(poses.R[scene, body]) * (x - poses.com[scene, body])


@wp.func
def _relative_velocity(poses: BodyPoses, scene: int, a: int, b: int, x: wp.vec3) -> wp.vec3:
    """Velocity of body a relative to b at x."""
    own = poses.velocity[scene, a] + wp.cross(poses.spin[scene, a], x - poses.com[scene, a])
    return own - poses.velocity[scene, b] - wp.cross(poses.spin[scene, b], x - poses.com[scene, b])


@wp.func
def sample_near(s: SurfaceArrays, poses: BodyPoses, scene: int, a: int, b: int, q: int) -> NearPoint:
    """Sample q of body a at body b."""
    out = NearPoint()
    R = poses.R[scene, b]
    out.at = poses.com[scene, a] + poses.R[scene, a] * s.samples[a, q]
    x = _local(poses, scene, b, out.at)
    found = depth_at(s, b, x)
    way = poses.step * (wp.transpose(R) * _relative_velocity(poses, scene, a, b, out.at))
    if wp.length(way) > STEP_OF_A_CELL * s.spacing[b]:
        later = depth_at(s, b, x + way)
        if later[3] < 0.0:  # it stays outside, and may pass an edge whose normal would stop it
            later[3] = later[3] - wp.dot(wp.vec3(later[0], later[1], later[2]), way)
            found = later
    out.normal = -(R * wp.vec3(found[0], found[1], found[2]))
    out.gap = s.overlap[a, b] - found[3]
    own = poses.R[scene, a] * s.normals[a, q]
    out.facing = -wp.dot(own, out.normal) > MIN_FACING
    # Where b has an edge its depths increase in an oblique direction. The normal is that of a face: of faces that are
    # parallel the one of the flatter surface, else that of a if its sample is on one.
    p = s.point[a, q]
    r = s.nearest[nearest_node(s, b, x)]
    most = float(-1.0)
    opposite = wp.vec3()
    if r >= 0:
        to_b = wp.transpose(R) * poses.R[scene, a]
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
def ball_near(s: SurfaceArrays, poses: BodyPoses, scene: int, a: int, b: int) -> NearPoint:
    """The point of a ball a that is nearest to body b."""
    out = NearPoint()
    centre = poses.com[scene, a] + poses.R[scene, a] * s.centre[a]
    apart = centre - (poses.com[scene, b] + poses.R[scene, b] * s.centre[b])
    out.normal = wp.normalize(apart)
    out.gap = wp.length(apart) - s.radius[a] - s.radius[b]
    if s.radius[b] == 0.0:
        on = closest_point(s, b, _local(poses, scene, b, centre))
        outward = centre - (poses.com[scene, b] + poses.R[scene, b] * on.at)
        normal = poses.R[scene, b] * on.normal
        side = wp.where(wp.dot(outward, normal) < 0.0, -1.0, 1.0)  # the centre may be inside
        out.gap = side * wp.length(outward) - s.radius[a]
        out.normal = wp.where(wp.length(outward) > NO_DISTANCE * s.radius[a], side * wp.normalize(outward), normal)
    out.at = centre - s.radius[a] * out.normal
    out.gap += s.overlap[a, b]
    out.facing = True
    return out


@wp.func
def plane_near(s: SurfaceArrays, poses: BodyPoses, scene: int, a: int, side: int, q: int) -> NearPoint:
    """Sample q of body a, or the point of a ball, at a plane."""
    out = NearPoint()
    out.normal = _inward(side)
    if s.radius[a] > 0.0:
        out.at = poses.com[scene, a] + poses.R[scene, a] * s.centre[a] - s.radius[a] * out.normal
    else:
        out.at = poses.com[scene, a] + poses.R[scene, a] * s.samples[a, q]
    out.gap = _plane_gap(poses, scene, a, side, out.at)
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
def _possible(s: SurfaceArrays, poses: BodyPoses, scene: int, a: int, b: int) -> bool:
    """Whether contacts of body a with b, or with the planes if b = a, are to be looked for."""
    if poses.pinned[scene, a] and (a == b or poses.pinned[scene, b]):
        return False
    if a != b and s.radius[b] > 0.0 and (s.radius[a] == 0.0 or b < a):
        return False  # it is a contact of b with a
    com = poses.com[scene, a]
    if a != b:
        reach = s.reach[a] + s.reach[b] + poses.margin[scene, a] + poses.margin[scene, b]
        return wp.length(com - poses.com[scene, b]) < reach
    out = bool(False)
    for side in range(SIDES):
        out = out or _plane_gap(poses, scene, a, side, com) < s.reach[a] + poses.margin[scene, a]
    return out


@wp.func
def _margin(poses: BodyPoses, scene: int, a: int, b: int) -> float:
    return poses.margin[scene, a] + wp.where(a == b, 0.0, poses.margin[scene, b])


@wp.func
def _look_at(s: SurfaceArrays, poses: BodyPoses, found: Found, scene: int, pair: int, q: int):
    """Sample q of a pair: its gap and the side of its normal, if it is near."""
    a = pair // s.near.shape[0]
    b = pair % s.near.shape[0]
    found.side[scene, pair, q] = wp.int8(NONE)
    if s.near[a, q] == NONE:
        return
    margin = _margin(poses, scene, a, b)
    at = poses.com[scene, a] + poses.R[scene, a] * s.samples[a, q]
    if a == b:
        least = margin  # of a sample near several planes the nearest one counts
        for side in range(SIDES):
            gap = _plane_gap(poses, scene, a, side, at)
            if gap < least:
                least = gap
                found.gap[scene, pair, q] = gap
                found.side[scene, pair, q] = wp.int8(side)
        return
    x = _local(poses, scene, b, at)
    if beyond_grid(s, b, x) < margin:
        point = sample_near(s, poses, scene, a, b, q)
        if point.gap < margin and point.facing:
            found.gap[scene, pair, q] = point.gap
            found.side[scene, pair, q] = wp.int8(_side_of(point.normal))
            found.other[scene, pair, q] = s.keypoint[nearest_node(s, b, x)]


@wp.func
def _list_near(s: SurfaceArrays, poses: BodyPoses, found: Found, scene: int, pair: int):
    count = int(0)
    for q in range(s.near.shape[1]):
        if found.side[scene, pair, q] != wp.int8(NONE):
            found.near[scene, pair, count] = q
            count += 1
    found.near_count[scene, pair] = count


@wp.func
def _keep_extremes(s: SurfaceArrays, poses: BodyPoses, found: Found, scene: int, pair: int, k: int):
    """Fill the slots of the k-th direction on all sides."""
    a = pair // s.near.shape[0]
    for side in range(SIDES):
        found.row[scene, pair * SLOTS + side * EXTREMES + k] = NONE
    for i in range(found.near_count[scene, pair]):
        q = found.near[scene, pair, i]
        side = int(found.side[scene, pair, q])
        gap = found.gap[scene, pair, q]
        value = -gap
        if k < EXTREMES - 1:
            arm = poses.R[scene, a] * s.samples[a, q]
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
        if found.row[scene, slot] == NONE or value > found.score[scene, slot]:
            found.score[scene, slot] = value
            found.row[scene, slot] = q


@wp.func
def _count_contacts(s: SurfaceArrays, poses: BodyPoses, found: Found, scene: int, pair: int):
    """Empty slots whose sample is in an earlier one of the same side, and count the others; a ball has one contact."""
    a = pair // s.near.shape[0]
    b = pair % s.near.shape[0]
    count = int(0)
    for slot in range(SLOTS):
        at = pair * SLOTS + slot
        if s.radius[a] > 0.0:
            touches = bool(False)
            if a == b and slot % EXTREMES == 0:
                touches = plane_near(s, poses, scene, a, slot // EXTREMES, 0).gap < poses.margin[scene, a]
            elif slot == 0:
                touches = ball_near(s, poses, scene, a, b).gap < _margin(poses, scene, a, b)
            found.row[scene, at] = wp.where(touches, 0, NONE)
        for other in range(slot - slot % EXTREMES, slot):
            if found.row[scene, pair * SLOTS + other] == found.row[scene, at]:
                found.row[scene, at] = NONE
        if found.row[scene, at] != NONE:
            count += 1
    found.count[scene, pair] = count


@wp.func
def search(s: SurfaceArrays, poses: BodyPoses, found: Found, scene: int, lane: int, lanes: int):
    """Find the contacts of all pairs: their slots and number, and the samples that are near."""
    bodies = s.near.shape[0]
    samples = s.near.shape[1]
    pairs = bodies * bodies
    for pair in range(lane, pairs, lanes):
        found.possible[scene, pair] = _possible(s, poses, scene, pair // bodies, pair % bodies)
        found.count[scene, pair] = 0
    wait_for_group()
    for pair in range(pairs):
        if found.possible[scene, pair]:
            for q in range(lane, samples, lanes):
                _look_at(s, poses, found, scene, pair, q)
    wait_for_group()
    for pair in range(lane, pairs, lanes):
        if found.possible[scene, pair]:
            _list_near(s, poses, found, scene, pair)
    wait_for_group()
    for row in range(lane, pairs * EXTREMES, lanes):
        pair = row // EXTREMES
        if found.possible[scene, pair] and s.radius[pair // bodies] == 0.0:
            _keep_extremes(s, poses, found, scene, pair, row % EXTREMES)
    wait_for_group()
    for pair in range(lane, pairs, lanes):
        if found.possible[scene, pair]:
            _count_contacts(s, poses, found, scene, pair)
    wait_for_group()


@wp.func
def contact_in_slot(s: SurfaceArrays, poses: BodyPoses, found: Found, scene: int, pair: int, slot: int) -> NearPoint:
    """The contact that `search` has put there."""
    a = pair // s.near.shape[0]
    b = pair % s.near.shape[0]
    q = found.row[scene, pair * SLOTS + slot]
    if a == b:
        return plane_near(s, poses, scene, a, slot // EXTREMES, q)
    if s.radius[a] > 0.0:
        return ball_near(s, poses, scene, a, b)
    return sample_near(s, poses, scene, a, b, q)
