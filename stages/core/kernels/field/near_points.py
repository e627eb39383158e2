"""Narrow phase for rigid bodies: gaps and normals of points of one body near another body or a plane.

Contacts are detected before bodies touch, up to the distance travelled in a step, and limit the approach speed to the
gap divided by the step. A sample or ball that would pass through a thin wall makes contact at the first point of its
path that is inside.
Source: Stewart and Trinkle 1996, "An implicit time-stepping scheme for rigid body dynamics with inelastic collisions
and Coulomb friction".
"""

from __future__ import annotations

import warp as wp

from stages.core.geometry import surface_faces as faces
from stages.core.kernels.field.surface_lookup import (
    APART,
    SurfaceArrays,
    closest_point,
    depth_at,
    first_inside,
    nearest_node,
)

NO_CONTACT = wp.constant(1.0e18)  # gap that stands for "no contact" [m]
MARGIN = wp.constant(0.05)  # gap up to which contacts are detected, plus the travel in a step [m]; a tenth of an object
# Smallest cosine of the angle at which two surfaces must face each other to make contact; .58 for a cube on its corner.
MIN_FACING = wp.constant(0.3)
OPPOSED, CURVED, FACES = wp.constant(faces.OPPOSED), wp.constant(faces.CURVED), wp.constant(faces.FACES)
STEP_OF_A_CELL = wp.constant(0.25)  # travel of a sample in a step below which its contact ignores it [grid spacings]
THINNEST = wp.constant(2.0)  # travel that may cross a wall and is swept [grid spacings]: sheets have three voxels
ON_SIDE = wp.constant(0.98)  # distance from a cylinder's axis beyond which samples are on its lateral surface [radii]
TURNED = wp.constant(0.5)  # smallest cosine of the angle by which a sample may be rotated about a cylinder's axis
SMALL = wp.constant(0.25)  # size below which a body may lie between the samples of a cylinder [size of the cylinder]
LEANING = wp.constant(0.1)  # sine of the angle to a cylinder's axis below which a direction counts as axial
NO_DISTANCE = wp.constant(1e-6)  # distance from a ball's centre below which a direction is undefined [ball radii]


@wp.struct
class BodyMotion:
    """Poses and motion of the bodies of each scene."""

    com: wp.array2d[wp.vec3]  # centre of mass [m]
    quat: wp.array2d[wp.vec4]  # orientation w x y z
    R: wp.array2d[wp.mat33]  # rotation matrix of `quat`
    velocity: wp.array2d[wp.vec3]  # of the centre of mass [m/s]
    momentum: wp.array2d[wp.vec3]  # angular momentum per unit of mass [m^2/s]
    spin: wp.array2d[wp.vec3]  # angular velocity [rad/s]
    low: wp.array2d[wp.vec3]  # low corner of the room that each body moves in [m]
    high: wp.array2d[wp.vec3]  # high corner of this room [m]
    margin: wp.array2d[float]  # each body's part of the gap up to which contacts are detected [m]
    pinned: wp.array2d[wp.bool]
    step: float  # time step [s]


@wp.struct
class NearPoint:
    """A point of body a near body b or near a plane."""

    a: int
    b: int  # equal to a for a plane
    at: wp.vec3  # position on a, world axes [m]
    gap: float  # signed distance, negative for penetration [m]
    normal: wp.vec3  # contact normal, from b towards a
    facing: bool  # whether both surfaces face each other


@wp.func
def _inward(side: int) -> wp.vec3:
    """Inward normal of a plane of the room."""
    out = wp.vec3()
    out[side % 3] = wp.where(side < 3, 1.0, -1.0)
    return out


@wp.func
def plane_gap(motion: BodyMotion, scene: int, a: int, side: int, x: wp.vec3) -> float:
    """Signed distance of x from a plane of the room of body a [m]."""
    axis = side % 3
    if side < 3:
        return x[axis] - motion.low[scene, a][axis]
    return motion.high[scene, a][axis] - x[axis]


@wp.func
def in_body_frame(motion: BodyMotion, scene: int, body: int, x: wp.vec3) -> wp.vec3:
    """Transform a point x [m] from the world to the frame of a body."""
    return wp.transpose(motion.R[scene, body]) * (x - motion.com[scene, body])


@wp.func
def _way_of_a_step(motion: BodyMotion, scene: int, a: int, b: int, x: wp.vec3) -> wp.vec3:
    """Displacement, in one step, of the point of body a at x relative to body b, in the frame of b [m]."""
    velocity = motion.velocity[scene, a] + wp.cross(motion.spin[scene, a], x - motion.com[scene, a])
    velocity -= motion.velocity[scene, b] + wp.cross(motion.spin[scene, b], x - motion.com[scene, b])
    return motion.step * (wp.transpose(motion.R[scene, b]) * velocity)


@wp.func
def _ends_at_face(
    s: SurfaceArrays, motion: BodyMotion, scene: int, point: NearPoint, own: wp.vec3, depth: float, face: wp.vec3
) -> bool:
    """Whether a contact point is an edge of body a on a face of body b, rather than the reverse.

    `depth` is the depth of `point` in b [m], `own` the normal of a's face in world axes, `face` the normal of b's face
    in the frame of b. True if the face of b continues below the point, and the face of a ends at the line where the
    planes of both faces intersect.
    """
    normal = motion.R[scene, point.b] * face
    below = point.at + (depth - s.spacing[point.b]) * normal
    if depth_at(s, point.b, in_body_frame(motion, scene, point.b, below))[3] < 0.5 * s.spacing[point.b]:
        return False
    across = normal - wp.dot(normal, own) * own
    sine = wp.max(wp.length(across), 1.0e-6)
    spacing = s.spacing[point.a]
    beyond = point.at - (wp.max(-depth, 0.0) / sine + spacing) / sine * across - spacing * own
    return depth_at(s, point.a, in_body_frame(motion, scene, point.a, beyond))[3] < 0.5 * spacing


@wp.func
def _turned(s: SurfaceArrays, a: int, q: int, direction: wp.vec3) -> wp.vec4:
    """Sample q of body a in its frame, rotated about the axis of a cylinder; the fourth component is 1 if it was.

    A sample on the lateral surface is moved to the extreme point of its circle in `direction` (frame of a), since
    cylinders touch along a line that need not contain a sample.
    """
    x = s.samples[a, q]
    out = wp.vec4(x[0], x[1], x[2], 0.0)
    if s.side[a] > 0.0:
        along = wp.dot(x - s.centre[a], s.axis[a])
        on_axis = s.centre[a] + along * s.axis[a]
        across = direction - wp.dot(direction, s.axis[a]) * s.axis[a]
        length = wp.length(across)
        if length > LEANING and wp.length(x - on_axis) > ON_SIDE * s.side[a]:
            across = across / length
            if wp.dot(wp.normalize(x - on_axis), across) > TURNED:
                x = on_axis + s.side[a] * across
                out = wp.vec4(x[0], x[1], x[2], 1.0)
    return out


@wp.func
def sample_at_plane(s: SurfaceArrays, motion: BodyMotion, scene: int, a: int, side: int, q: int) -> wp.vec3:
    """World position of sample q of body a for contact with a plane of its room; see `_turned`."""
    x = _turned(s, a, q, -(wp.transpose(motion.R[scene, a]) * _inward(side)))
    return motion.com[scene, a] + motion.R[scene, a] * wp.vec3(x[0], x[1], x[2])


@wp.func
def _at_side(s: SurfaceArrays, b: int, x: wp.vec3) -> wp.vec4:
    """Outward direction and signed distance [m] of the lateral surface of a cylinder b at x in its frame.

    The distance is NO_CONTACT where an end face is closer, or b is not a cylinder.
    """
    out = wp.vec4(0.0, 0.0, 0.0, NO_CONTACT)
    if s.side[b] > 0.0:
        along = wp.dot(x - s.centre[b], s.axis[b])
        outward = x - s.centre[b] - along * s.axis[b]
        gap = wp.length(outward) - s.side[b]
        if gap > wp.abs(along) - s.half[b]:
            outward = wp.normalize(outward)
            out = wp.vec4(outward[0], outward[1], outward[2], gap)
    return out


@wp.func
def _at_surface(s: SurfaceArrays, b: int, x: wp.vec3) -> wp.vec4:
    """Outward direction and signed distance [m] of body b at x in its frame.

    The direction is the normal of a nearby face if one is nearly parallel to the gradient.
    """
    out = _at_side(s, b, x)
    if out[3] == NO_CONTACT:
        found = depth_at(s, b, x)
        outward = -wp.normalize(wp.vec3(found[0], found[1], found[2]))
        gradient = outward
        r = s.nearest[nearest_node(s, b, x)]
        most = OPPOSED
        if r >= 0:
            for j in range(FACES):
                if wp.dot(gradient, s.faces[r, j]) > most:
                    most = wp.dot(gradient, s.faces[r, j])
                    outward = s.faces[r, j]
        out = wp.vec4(outward[0], outward[1], outward[2], -found[3])
    return out


@wp.func
def _side_near(s: SurfaceArrays, motion: BodyMotion, scene: int, a: int, b: int, q: int) -> NearPoint:
    """Contact of sample q of a cylinder a, rotated about its axis, with body b.

    The gap is NO_CONTACT if the sample cannot be rotated; see `_turned`.
    """
    out = NearPoint()
    out.a = a
    out.b = b
    out.gap = NO_CONTACT
    out.facing = True
    R = motion.R[scene, b]
    at = s.samples[a, q]
    if s.side[b] > 0.0:  # of two cylinders, the sides that face each other's axis are closest: start on the axis of a
        at = s.centre[a] + wp.dot(at - s.centre[a], s.axis[a]) * s.axis[a]
    is_moved = bool(True)
    i = int(0)
    # Iterate: each lookup gives the direction for the next rotation, since faces are only known near a surface. A while
    # loop, because Warp would unroll a range.
    while i < 3:
        place = motion.com[scene, a] + motion.R[scene, a] * at
        found = _at_surface(s, b, in_body_frame(motion, scene, b, place))
        normal = R * wp.vec3(found[0], found[1], found[2])
        if i < 2:
            moved = _turned(s, a, q, -(wp.transpose(motion.R[scene, a]) * normal))
            at = wp.vec3(moved[0], moved[1], moved[2])
            is_moved = is_moved and moved[3] > 0.0
        elif is_moved:
            out.at = place
            out.normal = normal
            out.gap = s.overlap[a, b] + found[3]
        i += 1
    return out


@wp.func
def sample_near(s: SurfaceArrays, motion: BodyMotion, scene: int, a: int, b: int, q: int) -> NearPoint:
    """Contact of sample q of body a with body b."""
    if s.side[a] > 0.0:
        moved = _side_near(s, motion, scene, a, b, q)
        if moved.gap < NO_CONTACT:
            return moved
    out = NearPoint()
    out.a = a
    out.b = b
    R = motion.R[scene, b]
    out.at = motion.com[scene, a] + motion.R[scene, a] * s.samples[a, q]
    x = in_body_frame(motion, scene, b, out.at)
    is_flat = s.flatness[s.point[a, q]] > 1.0 - CURVED and s.side[a] == 0.0
    # A flat face of a on a cylinder b is in contact through the samples of the cylinder.
    if is_flat and s.side[b] > 0.0 and s.reach[a] > SMALL * s.reach[b]:
        out.gap = NO_CONTACT
        return out
    found = depth_at(s, b, x)
    now = found[3]
    way = _way_of_a_step(motion, scene, a, b, out.at)
    if wp.length(way) > STEP_OF_A_CELL * s.spacing[b]:
        share = float(1.0)
        if wp.length(way) > THINNEST * s.spacing[b]:
            share = first_inside(s, b, x, way, -s.overlap[a, b])
            way *= share
        later = depth_at(s, b, x + way)
        if share < 1.0:  # the sample hits a wall, which it may have passed through at the end of the step
            x += way
        # later[3] < 0: the sample is outside at the end of the step, so it may pass an edge whose normal would stop it
        if share < 1.0 or later[3] < 0.0:
            later[3] = later[3] - wp.dot(wp.vec3(later[0], later[1], later[2]), way)
            found = later
    out.normal = -(R * wp.vec3(found[0], found[1], found[2]))
    out.gap = s.overlap[a, b] - found[3]
    own = motion.R[scene, a] * s.normals[a, q]
    out.facing = -wp.dot(own, out.normal) > MIN_FACING
    # Near an edge of b the gradient of its depth is oblique, so the normal is taken from a face: if a face of a and one
    # of b are parallel, the face of the flatter surface; else the face of a's sample if it is on one, unless this face
    # ends at a face of b, which is then used.
    p = s.point[a, q]
    r = s.nearest[nearest_node(s, b, x)]
    most = float(-1.0)
    opposite = wp.vec3()
    ends = bool(False)
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
        if most <= OPPOSED and s.flatness[p] > 0.0 and s.flatness[r] > 0.0:
            ends = _ends_at_face(s, motion, scene, out, own, now, s.faces[r, 0])
    if most > OPPOSED and (s.flatness[p] == 0.0 or s.flatness[r] > s.flatness[p] + CURVED):
        out.normal = R * opposite
    elif ends:
        out.normal = R * s.faces[r, 0]
        out.gap = s.overlap[a, b] - now
    elif s.flatness[p] > 0.0:
        out.normal = -own
    return out


@wp.func
def ball_near(s: SurfaceArrays, motion: BodyMotion, scene: int, a: int, b: int, rank: int) -> NearPoint:
    """Contact at the point of a ball a that is closest to body b (rank 0), or to another side of it (ranks 1 and 2).

    Only non-convex bodies have other sides, such as those of a groove or a corner; without one the gap is NO_CONTACT.
    """
    out = NearPoint()
    out.a = a
    out.b = b
    out.facing = True
    centre = motion.com[scene, a] + motion.R[scene, a] * s.centre[a]
    apart = centre - (motion.com[scene, b] + motion.R[scene, b] * s.centre[b])
    out.normal = wp.normalize(apart)
    out.gap = wp.length(apart) - s.radius[a] - s.radius[b]
    if rank > 0 and (s.radius[b] > 0.0 or s.hull_faces[b] > 0):
        out.gap = NO_CONTACT
    elif s.radius[b] == 0.0:
        x = in_body_frame(motion, scene, b, centre)
        one = wp.vec3()
        two = wp.vec3()
        i = int(0)
        while i <= rank:  # Warp would unroll a range
            on = closest_point(s, b, x, one, two)
            way = on.at - x
            distance = wp.length(way)
            outside = wp.dot(way, on.normal) <= 0.0  # the centre of the ball may be inside b
            if i < rank:
                two = one
                one = -way / wp.max(distance, NO_DISTANCE * s.radius[a])
            i += 1
        side = wp.where(outside, 1.0, -1.0)
        out.gap = side * distance - s.radius[a]
        normal = wp.where(distance > NO_DISTANCE * s.radius[a], -side * wp.normalize(way), on.normal)
        out.normal = motion.R[scene, b] * normal
        if rank > 0 and (not outside or wp.min(wp.dot(way, one), wp.dot(way, two)) < -APART * distance):
            out.gap = NO_CONTACT
    out.at = centre - s.radius[a] * out.normal
    out.gap += s.overlap[a, b]
    return out


@wp.func
def ball_ahead(s: SurfaceArrays, motion: BodyMotion, scene: int, a: int, b: int) -> NearPoint:
    """Contact at the point where a ball a hits a non-convex body b during the step.

    The closest point at the start (`ball_near`) may be on another side of b. The gap is NO_CONTACT if b is convex, the
    ball does not hit it, or the ball moves by less than its radius.
    """
    out = NearPoint()
    out.a = a
    out.b = b
    out.gap = NO_CONTACT
    out.facing = True
    if s.radius[b] > 0.0 or s.hull_faces[b] > 0:
        return out
    centre = motion.com[scene, a] + motion.R[scene, a] * s.centre[a]
    x = in_body_frame(motion, scene, b, centre)
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
    """Contact of sample q of body a, or of the closest point of a ball, with a plane of its room."""
    out = NearPoint()
    out.a = a
    out.b = a
    out.normal = _inward(side)
    if s.radius[a] > 0.0:
        out.at = motion.com[scene, a] + motion.R[scene, a] * s.centre[a] - s.radius[a] * out.normal
    else:
        out.at = sample_at_plane(s, motion, scene, a, side, q)
    out.gap = plane_gap(motion, scene, a, side, out.at)
    out.facing = True
    return out
