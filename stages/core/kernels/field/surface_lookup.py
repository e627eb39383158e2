"""Queries of the surfaces of rigid bodies: depths interpolated on grids, closest points, and sweeps along a path."""

from __future__ import annotations

import warp as wp

f64 = wp.float64
NO_FACE = wp.constant(-1)
GRID_STEPS = wp.constant(6)  # number of steps from the nearest sample to the closest point of a surface on a grid
STEP = wp.constant(2.0)  # longest of these steps [grid spacings]
SWEEP_STEPS = wp.constant(64)  # maximum number of steps along a path; each is at least one grid spacing long
MIN_INWARD = wp.constant(0.3)  # smallest cosine between a path and the inward direction for the path to hit a surface
HULL_STEPS = wp.constant(32)  # maximum iterations to the closest point of a hull; each adds a face, about three suffice
APART = wp.constant(0.9)  # largest cosine between normals of different sides of a body
ON_FACE = wp.constant(wp.float64(1e-6))  # distance from a face up to which a point is on it [reach of the body]


@wp.struct
class SurfaceArrays:
    """BodySurfaces for kernels; the fields are documented there."""

    depth: wp.array[float]
    smooth: wp.array[float]
    keypoint: wp.array[int]
    first: wp.array[int]
    shape: wp.array[wp.vec3i]
    low: wp.array[wp.vec3]
    spacing: wp.array[float]
    near: wp.array2d[int]
    samples: wp.array2d[wp.vec3]
    normals: wp.array2d[wp.vec3]
    point: wp.array2d[int]
    flatness: wp.array[float]
    faces: wp.array2d[wp.vec3]
    nearest: wp.array[int]
    centre: wp.array[wp.vec3]
    radius: wp.array[float]
    axis: wp.array[wp.vec3]
    side: wp.array[float]
    half: wp.array[float]
    reach: wp.array[float]
    hull: wp.array[wp.vec4]
    hull_first: wp.array[int]
    hull_faces: wp.array[int]
    overlap: wp.array2d[float]


@wp.struct
class SurfacePoint:
    """A point on the surface of a body, in the body frame."""

    at: wp.vec3
    normal: wp.vec3  # outward


@wp.func
def _node(s: SurfaceArrays, body: int, i: int, j: int, k: int) -> int:
    n = s.shape[body]
    return s.first[body] + (i * n[1] + j) * n[2] + k


@wp.func
def depth_at(s: SurfaceArrays, body: int, x: wp.vec3) -> wp.vec4:
    """Return the direction of steepest increase of the depth, and the depth, at x in the frame of a body.

    See BodySurfaces.look_up.
    """
    n = s.shape[body]
    h = s.spacing[body]
    place = (x - s.low[body]) / h
    f = wp.vec3()
    cell = wp.vec3i()
    beyond = float(0.0)
    for axis in range(3):
        inside = wp.clamp(place[axis], 0.0, float(n[axis] - 1))
        cell[axis] = wp.min(int(inside), n[axis] - 2)
        f[axis] = inside - float(cell[axis])
        beyond += (place[axis] - inside) * (place[axis] - inside) * h * h
    depth = float(0.0)
    slope = wp.vec3()
    for corner in range(8):
        i = corner // 4
        j = (corner // 2) % 2
        k = corner % 2
        u = wp.where(i == 1, f[0], 1.0 - f[0])
        v = wp.where(j == 1, f[1], 1.0 - f[1])
        w = wp.where(k == 1, f[2], 1.0 - f[2])
        row = _node(s, body, cell[0] + i, cell[1] + j, cell[2] + k)
        depth += s.depth[row] * u * v * w
        smooth = s.smooth[row]
        slope += smooth * wp.vec3(float(2 * i - 1) * v * w, float(2 * j - 1) * u * w, float(2 * k - 1) * u * v)
    # The body lies within the box of its grid, so the angle at the nearest point of the box is at least a right angle,
    # and Pythagoras gives an upper bound of the (negative) depth.
    if beyond > 0.0:
        outside = wp.min(depth, 0.0)
        depth = -wp.sqrt(beyond + outside * outside)
    slope = slope / wp.max(wp.length(slope), 1.0e-12)
    return wp.vec4(slope[0], slope[1], slope[2], depth)


@wp.func
def first_inside(s: SurfaceArrays, body: int, x: wp.vec3, way: wp.vec3, outside: float) -> float:
    """Return the fraction of the path `way` of x at which x first comes closer than `outside` to the surface while
    moving into it; 1 if it does not. Positions are in the frame of the body.

    Advances by the distance to the surface, whose accuracy is one grid spacing. Source: conservative advancement,
    Mirtich 1996, "Impulse-based dynamic simulation of rigid body systems".
    """
    length = wp.length(way)
    share = float(0.0)
    for _ in range(SWEEP_STEPS):
        found = depth_at(s, body, x + share * way)
        inward = wp.dot(wp.vec3(found[0], found[1], found[2]), way)
        if found[3] + outside > 0.0 and inward > MIN_INWARD * length:
            return share
        share += wp.max(-found[3] - outside - s.spacing[body], s.spacing[body]) / length
        if share >= 1.0:
            return 1.0
    return 1.0


@wp.func
def beyond_grid(s: SurfaceArrays, body: int, x: wp.vec3) -> float:
    """Largest distance along one axis of x, in the frame of a body, from the box of its grid; 0 inside."""
    low = s.low[body]
    out = float(0.0)
    for axis in range(3):
        end = low[axis] + s.spacing[body] * float(s.shape[body][axis] - 1)
        out = wp.max(out, wp.max(low[axis] - x[axis], x[axis] - end))
    return out


@wp.func
def nearest_node(s: SurfaceArrays, body: int, x: wp.vec3) -> int:
    """Row of the grid node nearest to x in the frame of a body."""
    n = s.shape[body]
    place = (x - s.low[body]) / s.spacing[body]
    i = wp.clamp(int(wp.round(place[0])), 0, n[0] - 1)
    j = wp.clamp(int(wp.round(place[1])), 0, n[1] - 1)
    k = wp.clamp(int(wp.round(place[2])), 0, n[2] - 1)
    return _node(s, body, i, j, k)


@wp.func
def _normal_of_face(s: SurfaceArrays, face: int) -> wp.vec3d:
    plane = s.hull[face]
    return wp.vec3d(f64(plane[0]), f64(plane[1]), f64(plane[2]))


@wp.func
def _beyond_face(s: SurfaceArrays, face: int, x: wp.vec3d) -> f64:
    """Signed distance of x, in the frame of a body, from the plane of a face of its hull; positive outside."""
    return wp.dot(_normal_of_face(s, face), x) + f64(s.hull[face][3])


@wp.func
def _outermost_face(s: SurfaceArrays, body: int, x: wp.vec3d) -> int:
    """Face of a body's hull with the largest signed distance from x."""
    first = s.hull_first[body]
    out = first
    most = _beyond_face(s, first, x)
    for face in range(first + 1, first + s.hull_faces[body]):
        beyond = _beyond_face(s, face, x)
        if beyond > most:
            most = beyond
            out = face
    return out


@wp.func
def _projected(s: SurfaceArrays, faces: wp.vec3i, x: wp.vec3d) -> wp.vec4d:
    """Projection of x onto the intersection of the planes of up to three faces, and its smallest multiplier [m]."""
    normals = wp.mat33d()
    beyond = wp.vec3d()
    for k in range(3):
        if faces[k] != NO_FACE:
            normals[k] = _normal_of_face(s, faces[k])
            beyond[k] = _beyond_face(s, faces[k], x)
    gram = normals * wp.transpose(normals)
    for k in range(3):
        gram[k, k] = f64(1.0)  # set for unused faces as well, so that the matrix is regular
    multipliers = wp.inverse(gram) * beyond
    at = x - wp.transpose(normals) * multipliers
    return wp.vec4d(at[0], at[1], at[2], wp.min(multipliers))


@wp.func
def _closest_point_of_hull(s: SurfaceArrays, body: int, point: wp.vec3) -> SurfacePoint:
    """Closest point of a convex body, by an active-set method.

    Projects the point onto the face with the largest signed distance, then repeatedly onto the intersection of the
    planes of the most violated face and of up to two previously active faces, until no face is violated.
    Source: the basis computation of LP-type problems, Sharir and Welzl 1992, for the projection onto a polyhedron.
    """
    x = wp.vec3d(f64(point[0]), f64(point[1]), f64(point[2]))
    tolerance = ON_FACE * f64(s.reach[body])
    active = wp.vec3i(NO_FACE, NO_FACE, NO_FACE)
    face = _outermost_face(s, body, x)
    normal = _normal_of_face(s, face)
    beyond = _beyond_face(s, face, x)
    at = x
    if beyond <= f64(0.0):
        at = x - beyond * normal
    for _ in range(HULL_STEPS):
        if _beyond_face(s, face, at) <= tolerance:
            break
        before = active
        found = bool(False)
        for i in range(-1, 3):
            for j in range(i + 1, 3):  # keep the active faces i and j, or only j if i is -1; either may be NO_FACE
                trial = wp.vec3i(face, NO_FACE, before[j])
                if i >= 0:
                    trial[1] = before[i]
                projected = _projected(s, trial, x)
                candidate = wp.vec3d(projected[0], projected[1], projected[2])
                feasible = projected[3] >= -tolerance
                for k in range(3):
                    if before[k] != NO_FACE:
                        feasible = feasible and _beyond_face(s, before[k], candidate) <= tolerance
                if feasible and not found:
                    found = True
                    active = trial
                    at = candidate
        if not found:
            break
        face = _outermost_face(s, body, at)
    out = SurfacePoint()
    out.at = wp.vec3(float(at[0]), float(at[1]), float(at[2]))
    out.normal = wp.vec3(float(normal[0]), float(normal[1]), float(normal[2]))
    return out


@wp.func
def _onto_surface(s: SurfaceArrays, body: int, x: wp.vec3) -> SurfacePoint:
    """Point of the surface near x, which is at most a few grid spacings away, and the normal there."""
    out = SurfacePoint()
    out.at = x
    for _ in range(2):
        found = depth_at(s, body, out.at)
        out.normal = -wp.vec3(found[0], found[1], found[2])
        out.at = out.at + found[3] * out.normal
    return out


@wp.func
def _closest_point_of_grid(s: SurfaceArrays, body: int, x: wp.vec3, one: wp.vec3, two: wp.vec3) -> SurfacePoint:
    """Closest point of a surface on a grid, by projected descent from the nearest sample.

    Each step moves along the tangent plane towards x and back onto the surface. If that does not reduce the distance,
    because the surface bends away from the plane, the step length is halved. Samples with normals
    near `one` or `two` do not count.
    """
    nearest = int(0)
    least = float(1.0e18)
    for q in range(s.samples.shape[1]):
        if s.near[body, q] >= 0:
            distance = wp.length_sq(x - s.samples[body, q])
            normal = s.normals[body, q]
            if distance < least and wp.max(wp.dot(normal, one), wp.dot(normal, two)) <= APART:
                least = distance
                nearest = q
    out = _onto_surface(s, body, s.samples[body, nearest])
    share = float(1.0)
    for _ in range(GRID_STEPS):
        apart = x - out.at
        way = share * (apart - wp.dot(apart, out.normal) * out.normal)
        way *= wp.min(1.0, STEP * s.spacing[body] / wp.max(wp.length(way), 1.0e-12))
        trial = _onto_surface(s, body, out.at + way)
        if wp.length_sq(x - trial.at) < wp.length_sq(apart):
            out.at = trial.at
            out.normal = trial.normal
        else:
            share *= 0.5
    return out


@wp.func
def closest_point(s: SurfaceArrays, body: int, x: wp.vec3, one: wp.vec3, two: wp.vec3) -> SurfacePoint:
    """Closest point to x, in the frame of a body, on the surface of the body, which must not be a ball.

    On a non-convex body only sides count whose normals differ from `one` and `two`, unless these are zero.
    """
    if s.hull_faces[body] > 0:
        return _closest_point_of_hull(s, body, x)
    return _closest_point_of_grid(s, body, x, one, two)
