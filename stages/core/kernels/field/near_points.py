"""Points of rigid bodies near other bodies and planes: gaps and normals of contacts.

Contacts are found before bodies touch, up to the way of a step, and limit the velocity to the gap over the step.
Samples and balls that would pass through a wall meet it at the first place of their way that is inside.
Source: Stewart and Trinkle 1996, "An implicit time-stepping scheme for rigid body dynamics with inelastic collisions
and Coulomb friction".
"""

from __future__ import annotations

import warp as wp

from stages.core.geometry import surface_faces as faces
from stages.core.kernels.field.surface_lookup import SurfaceArrays, closest_point, depth_at, first_inside, nearest_node

NO_CONTACT = wp.constant(1.0e18)  # gap [m]
MARGIN = wp.constant(0.05)  # gap up to which points count, in addition to the way of a step [m]; a tenth of an object
# Least cosine of the angle at which two surfaces face each other in a contact; .58 for a cube standing on its corner.
MIN_FACING = wp.constant(0.3)
OPPOSED, CURVED, FACES = wp.constant(faces.OPPOSED), wp.constant(faces.CURVED), wp.constant(faces.FACES)
STEP_OF_A_CELL = wp.constant(0.25)  # way of a sample in a step that matters for its contact, in nodes of the grid
THINNEST = wp.constant(2.0)  # a way that may lead through a wall, in nodes of the grid: sheets have three voxels
ON_SIDE = wp.constant(0.98)  # distance from the axis of a cylinder beyond which samples are on its side [radii]
TURNED = wp.constant(0.5)  # least cosine of the angle by which a sample is moved around an axis
SMALL = wp.constant(0.25)  # size of a body below which it may be between the samples of a cylinder [its size]
LEANING = wp.constant(0.1)  # sine of the angle to an axis below which a direction is along it
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
def plane_gap(motion: BodyMotion, scene: int, a: int, side: int, x: wp.vec3) -> float:
    """Distance of x from a plane of the room of body a [m]."""
    axis = side % 3
    if side < 3:
        return x[axis] - motion.low[scene, a][axis]
    return motion.high[scene, a][axis] - x[axis]


@wp.func
def in_body_frame(motion: BodyMotion, scene: int, body: int, x: wp.vec3) -> wp.vec3:
    """The place x in the frame of a body [m]."""
    return wp.transpose(motion.R[scene, body]) * (x - motion.com[scene, body])


@wp.func
def _way_of_a_step(motion: BodyMotion, scene: int, a: int, b: int, x: wp.vec3) -> wp.vec3:
    """The way of body a at x in a step, in the frame of body b and relative to it [m]."""
    velocity = motion.velocity[scene, a] + wp.cross(motion.spin[scene, a], x - motion.com[scene, a])
    velocity -= motion.velocity[scene, b] + wp.cross(motion.spin[scene, b], x - motion.com[scene, b])
    return motion.step * (wp.transpose(motion.R[scene, b]) * velocity)


@wp.func
def _ends_at_face(
    s: SurfaceArrays, motion: BodyMotion, scene: int, point: NearPoint, own: wp.vec3, depth: float, face: wp.vec3
) -> bool:
    """Whether an edge of body a touches a face of b, and not the other way round, near a point at this depth in b.

    `own` is the normal of a's face there, and `face` that of b's in its frame: b's goes on below the point, and a's
    does not beyond the line in which both meet.
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
    """Sample q of body a in its frame, and whether it is moved: around the axis of a cylinder as far in a direction as
    its circle goes, since cylinders touch along a line and not where there is a sample.
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
    """Where sample q of body a would touch a plane of its room."""
    x = _turned(s, a, q, -(wp.transpose(motion.R[scene, a]) * _inward(side)))
    return motion.com[scene, a] + motion.R[scene, a] * wp.vec3(x[0], x[1], x[2])


@wp.func
def _at_side(s: SurfaceArrays, b: int, x: wp.vec3) -> wp.vec4:
    """Direction out of the side of a cylinder b at x in its frame, and the distance from it [m]; the distance is
    infinite where an end is nearer, or b is no cylinder.
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
    """Direction out of body b at x in its frame, that of a face if there is one, and the distance from it [m]."""
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
    """Sample q of a cylinder a, moved around its axis, at body b; the gap is infinite where it is not moved."""
    out = NearPoint()
    out.a = a
    out.b = b
    out.gap = NO_CONTACT
    out.facing = True
    R = motion.R[scene, b]
    at = s.samples[a, q]
    if s.side[b] > 0.0:  # what faces the other axis is nearest to it
        at = s.centre[a] + wp.dot(at - s.centre[a], s.axis[a]) * s.axis[a]
    is_moved = bool(True)
    i = int(0)
    while i < 3:  # faces are only known near a surface; not a range, which would be unrolled
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
    """Sample q of body a at body b."""
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
    if is_flat and s.side[b] > 0.0 and s.reach[a] > SMALL * s.reach[b]:  # samples of the cylinder touch the face
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
    # parallel the one of the flatter surface, else that of a if its sample is on one, unless that ends at a face of b.
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
        on = closest_point(s, b, in_body_frame(motion, scene, b, centre))
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
    """Sample q of body a, or the point of a ball, at a plane."""
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
