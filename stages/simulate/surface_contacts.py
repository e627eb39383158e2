"""Contacts between the surfaces of rigid bodies that do not fill their convex hull.

If one of two bodies is non-convex, samples of each surface are looked up in the signed distance grid of the other
body (`depth_lookup.py`). Samples inside it are contact points; contact reduction keeps those that span the contact
region of the pair. The outermost samples of non-convex bodies collide with the floor and walls. MuJoCo's contacts
between the hulls of such pairs are excluded; those between convex bodies and those with the background stay.

Penetration depths are reduced by the allowed overlap of the pair (`initial_overlaps.py`).

Broad phase: each pair has a Verlet list of the samples that are closer than MARGIN to the other body. It stays valid
until the paths of the two bodies may add up to MARGIN or, if that is larger, to the distance of the nearest sample. A
listed sample is looked up only once it may have reached the other body. Samples are grouped by position, so that
distant groups are skipped as a whole.
Sources: point contacts in signed distances: Xu, Zhao and Barbic 2014, "Implicit multibody penalty-based distributed
contact"; lists: Verlet 1967, "Computer experiments on classical fluids".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from stages.core.geometry.extremes import fibonacci
from stages.core.geometry.surface_faces import nearest_points, surface_faces
from stages.core.kernels.depth_lookup import Samples, depth_lookup, turned
from stages.core.physics.solid_surface import solid_surface
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.scene import Scene
from stages.simulate.initial_overlaps import AllowedOverlaps
from stages.simulate.standing_surface import StandingSurface

FACING = 0.5  # cosine between opposed normals at or above which the full depth counts; below, proportionally less
MARGIN = 0.05  # distance from the other body within which samples are listed [simulation units]
BALL_SAMPLES = 2000  # samples on the surface of a ball: .08 radii apart
BALL_NODES = 20  # grid nodes along the radius of a ball: interpolated depths are accurate to .001 radii
GROUPS_ALONG = 6  # groups of samples along the longest side of a body
STEEPEST = 2  # largest slope of depths on a grid: where fine depths meet coarse ones, they differ by up to a voxel
NONE = np.zeros(0, np.int64), np.zeros(0)


@dataclass(frozen=True)
class SurfaceShape:
    """Samples of a body's surface, and a grid of depths below the surface, in the body's frame [simulation units]."""

    points: np.ndarray  # (s, 3), samples
    normals: np.ndarray  # (s, 3), outward normals of the samples
    flatness: np.ndarray  # (s,), of the surface at the samples: 1 in a plane and 0 at an edge
    faces: np.ndarray  # (s, 3, 3), normals of up to three faces that meet at a sample, padded with 0
    nearest: np.ndarray  # (x, y, z), row of the sample nearest to each node near the surface; -1 for the other nodes
    depth: np.ndarray  # (x, y, z), depth at each node, negative outside
    low: np.ndarray  # (3,), position of the first node
    h: float  # node spacing
    convex: bool  # the body fills its convex hull
    radius: float = 0.0  # of a ball; 0 for other shapes
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))  # of a ball


class BodyFrame(NamedTuple):
    """The frame of a body, relative to the scene."""

    com: tuple[float, ...]  # centre of mass, which is the origin of the frame [scene units]
    scale: float  # simulation units per scene unit


@cached_in_scene
def object_shape(
    scene: Scene, object_id: int, seed: int, bottom: float, frame: BodyFrame, hull: tuple[tuple[float, ...], ...]
) -> SurfaceShape:
    """The `surface_shape` of an object, cut off below the height `bottom`.

    `hull`: vertices of the convex hull if the object fills it, else empty. Raises InputError for an object without
    usable Gaussians.
    """
    filled = ConvexHull(np.array(hull)) if hull else None
    return surface_shape(StandingSurface(solid_surface(scene, object_id, seed).fitted, filled, bottom), frame)


def surface_shape(body: StandingSurface, frame: BodyFrame) -> SurfaceShape:
    """Convert the surface of a body from scene units to its frame."""
    com, scale = np.array(frame.com), frame.scale
    points, normals, at_edge = body.points()
    depth, low = body.depth_grid()
    points, depth, low, h = scale * (points - com), scale * depth, scale * (low - com), scale * body.surface.h
    return SurfaceShape(points, normals, *surface_faces(points, normals, at_edge),
                        nearest_points(points, depth, low, h), depth, low, h, body.hull is not None)  # fmt: skip


def ball_shape(centre: np.ndarray, radius: float) -> SurfaceShape:
    """The shape of a ball, with `centre` (3,) and `radius` in the frame of its body."""
    normals, h = fibonacci(BALL_SAMPLES), radius / BALL_NODES
    low = np.full(3, -(BALL_NODES + 2) * h)
    node = low + h * np.indices((2 * BALL_NODES + 5,) * 3).transpose(1, 2, 3, 0)
    depth = radius - np.linalg.norm(node, axis=-1)
    nearest = nearest_points(radius * normals, depth, low, h)
    return SurfaceShape(centre + radius * normals, normals, *surface_faces(normals, normals), nearest, depth,
                        centre + low, h, True, radius, centre)  # fmt: skip


class SurfaceContacts:
    """Finds the surface contacts of the first bodies of a MuJoCo model and adds them to MuJoCo's data.

    Bodies are numbered by their row in `shapes`; body i is the body i + 1 of the model.
    """

    def __init__(self, mujoco, model, data, shapes: Sequence[SurfaceShape]):
        """The overlaps at the poses in `data` are allowed from then on."""
        self._mujoco, self._model = mujoco, model
        count = len(shapes)
        groups = [_groups(s.points) for s in shapes]
        shapes = [_ordered(s, order) for s, (order, *_) in zip(shapes, groups, strict=True)]
        per_sample = [np.concatenate([getattr(s, n) for s in shapes]) for n in Samples._fields[:-1]]
        self._points = per_sample[0]
        self._first = np.cumsum([0, *(len(s.points) for s in shapes)])
        self._first_group = np.cumsum([0, *(len(g[1]) for g in groups)])
        self._begin = np.concatenate([first + g[1] for first, g in zip(self._first, groups, strict=False)])
        self._ends = np.append(self._begin[1:], len(self._points))
        self._middle, self._reach = (np.concatenate([g[k] for g in groups]) for k in (2, 3))
        self._radius = np.array([np.linalg.norm(s.points, axis=1).max(initial=0) for s in shapes])
        nearest = [np.where(s.nearest < 0, -1, f + s.nearest).ravel()
                   for f, s in zip(self._first, shapes, strict=False)]  # fmt: skip
        samples = Samples(*per_sample, np.concatenate(nearest))
        self._lookup = depth_lookup([s.depth for s in shapes], np.array([s.low for s in shapes]),
                                    np.array([s.h for s in shapes]), samples)  # fmt: skip
        self._ball, self._centre = np.array([s.radius for s in shapes]), np.array([s.centre for s in shapes])
        rough = ~np.array([s.convex for s in shapes])
        self._possible = (rough[:, None] | rough) & ~np.eye(count, dtype=bool)
        self._is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self._planes = np.flatnonzero(self._is_plane)
        of = model.geom_bodyid[self._planes]
        pairs = np.arange(1, count + 1)[:, None]
        apart = np.isin((np.minimum(of, pairs) << 16) + np.maximum(of, pairs), model.exclude_signature)
        lowest = [self._first[i] + _hull_corners(s.points) if rough[i] else [] for i, s in enumerate(shapes)]
        self._first_corner = np.cumsum([0, *(len(rows) for rows in lowest)])
        self._corner_of = np.repeat(np.arange(count), [len(rows) for rows in lowest])
        self._corners = self._points[np.concatenate(lowest).astype(np.int64)]  # samples that can touch planes
        self._apart = np.where(apart, -np.inf, 0.0)  # added to depths beyond planes: excludes pairs that do not collide
        # first geometry of each body, which has its friction and damping
        self._geom = np.array([np.flatnonzero(model.geom_bodyid == i + 1)[0] for i in range(count)])
        self._body = np.where(model.geom_bodyid > count, 0, model.geom_bodyid) - 1  # body of each geometry; -1: fixed
        self._rough = np.append(rough, False)
        self._dof = model.body_dofadr[1 : count + 1]
        self._path = np.zeros(count)  # upper bound of the path length of any point of a body so far
        self._due = np.full((count, count), -np.inf)  # value of _way at which the list of a pair must be rebuilt
        self._way = np.zeros((count, count))  # sum of the path lengths of both bodies of a pair
        self._lists: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        # all lists, concatenated: pairs that have one; per entry its row in _pairs, sample, and the value of _way from
        # which on the sample may be inside the other body
        self._pairs, self._pair = np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
        self._sample, self._from = NONE
        fixed = np.zeros(count, bool)
        self._update_lists(data, fixed)
        overlap, below = np.zeros((count, count)), np.zeros((count, len(self._planes)))
        _, _, depth, a, b = self._contacts(data)
        np.maximum.at(overlap, (np.minimum(a, b), np.maximum(a, b)), depth)
        self._overlaps = AllowedOverlaps(overlap)  # (a, b) with a < b
        row, plane, depth = self._beyond_planes(data, fixed)
        np.maximum.at(below, (self._corner_of[row], plane), depth)
        self._below = AllowedOverlaps(below)

    def add(self, data, fixed: np.ndarray) -> None:
        """Add surface contacts to those found by mj_collision; `fixed` masks the bodies of the model that do not move.

        Call once per substep: it also integrates the path lengths on which the lists depend.
        """
        fixed = fixed[1 : len(self._path) + 1]
        free = np.flatnonzero(~fixed & (self._dof >= 0))
        velocity = data.qvel[self._dof[free, None] + np.arange(6)]
        speed = np.linalg.norm(velocity[:, :3], axis=1) + np.linalg.norm(velocity[:, 3:], axis=1) * self._radius[free]
        self._path[free] += speed * self._model.opt.timestep
        self._add_to_planes(data, fixed)
        self._update_lists(data, fixed)
        x, normal, depth, a, b = self._contacts(data)
        pair = np.minimum(a, b), np.maximum(a, b)
        self._overlaps.note(pair, depth, ~(fixed[:, None] & fixed))
        excess = depth - self._overlaps.depth[pair]
        k = np.flatnonzero(excess > 0)
        k = k[extremes(x[k], normal[k], excess[k], a[k] * len(self._path) + b[k])]
        at = x[k] + depth[k, None] / 2 * normal[k]
        geoms = np.stack([self._geom[b[k]], self._geom[a[k]]], 1)
        add_contacts(self._mujoco, self._model, data, AddedContacts(at, normal[k], excess[k], geoms))

    def _add_to_planes(self, data, fixed: np.ndarray) -> None:
        """Add the contacts of the outermost samples with planes."""
        row, plane, depth = self._beyond_planes(data, fixed)
        of = self._corner_of[row]
        self._below.note((of, plane), depth, ~fixed[:, None])
        excess = depth - self._below.depth[of, plane]
        k = np.flatnonzero(excess > 0)
        if not len(k):
            return
        of, plane, excess = of[k], plane[k], excess[k]
        x = turned(data.xmat[1 + of].reshape(-1, 3, 3), self._corners[row[k]]) + data.xpos[1 + of]
        normal = data.geom_xmat[self._planes[plane]][:, 2::3]
        k = extremes(x, normal, excess, of * len(self._planes) + plane)
        geoms = np.stack([self._planes[plane[k]], self._geom[of[k]]], 1)
        add_contacts(self._mujoco, self._model, data, AddedContacts(x[k], normal[k], excess[k], geoms))

    def exclude(self, data) -> None:
        """Exclude MuJoCo's contacts between hulls that surface contacts replace."""
        replaced = self.replaced(data.contact.geom)
        data.contact.exclude[replaced] = 1
        data.contact.efc_address[replaced] = -1  # MuJoCo leaves it undefined if all contacts are excluded

    def replaced(self, geom: np.ndarray) -> np.ndarray:
        """Mask (k,) of the pairs of geometries `geom` (k, 2) whose contacts are replaced by surface contacts."""
        body = self._body[geom]
        return self._rough[body].any(1) & ((body >= 0) | self._is_plane[geom]).all(1)

    def touching(self, data) -> tuple[np.ndarray, np.ndarray]:
        """Pairs (k, 2) of bodies of the model that touch, and normals (k, 3) from the first to the second body.

        There is one row for each sample that faces the other body and is inside it or less than MARGIN outside.
        """
        pairs = np.argwhere(self._possible)
        lists, _ = self._near(data, pairs, np.zeros(len(pairs)))
        a, b = np.repeat(pairs, [len(rows) for rows, _ in lists], axis=0).T
        sample = np.concatenate([NONE[0], *(rows for rows, _ in lists)])
        found = self._lookup.near(sample, a, b, *self._poses(data), MARGIN)
        k = found.facing > 0
        return np.stack([b[found.row[k]], a[found.row[k]]], 1) + 1, found.normal[k]

    def _update_lists(self, data, fixed: np.ndarray) -> None:
        """Rebuild the lists of the pairs that may have moved too far since their lists were made."""
        self._way = path = self._path[:, None] + self._path
        due = np.argwhere(self._possible & ~(fixed[:, None] & fixed) & (path >= self._due))
        if not len(due):
            return
        a, b = due.T
        apart = np.linalg.norm(data.xpos[a + 1] - data.xpos[b + 1], axis=1) - self._radius[a] - self._radius[b]
        gap = np.maximum(apart, MARGIN)
        close = np.flatnonzero(apart < MARGIN)
        near, gap[close] = self._near(data, due[close], path[a, b][close])
        self._due[a, b] = path[a, b] + gap
        found = dict(zip(map(tuple, due[close].tolist()), near, strict=True))
        changed = False
        for pair in map(tuple, due.tolist()):
            rows, _ = new = found.get(pair, NONE)
            changed |= self._lists.pop(pair, None) is not None or bool(len(rows))
            if len(rows):
                self._lists[pair] = new
        if changed:
            self._pairs = np.array(list(self._lists), np.int64).reshape(-1, 2)
            self._pair = np.repeat(np.arange(len(self._pairs)), [len(rows) for rows, _ in self._lists.values()])
            self._sample, self._from = (np.concatenate(each) for each in zip(NONE, *self._lists.values(), strict=True))

    def _near(self, data, pairs: np.ndarray, way: np.ndarray) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
        """Lists of the samples of the first body of each pair (k, 2) that are closer than MARGIN to the second body.

        `way` (k,) has the present path lengths of the pairs. Each list has samples, and the path lengths from which on
        they may be inside. Also returns the path length (k,) that each pair can still move before its list is outdated.
        """
        a, b = pairs.T
        poses = self._poses(data)
        group, of = _ranges(self._first_group[a], self._first_group[a + 1])
        distance = self._lookup.distances(self._middle[group], a[of], b[of], *poses) - self._reach[group]
        close, gap = distance < MARGIN, np.full(len(pairs), np.inf)
        np.minimum.at(gap, of[~close], distance[~close])
        group, of = group[close], of[close]
        sample, row = _ranges(self._begin[group], self._ends[group])
        of = of[row]
        distance = self._lookup.distances(self._points[sample], a[of], b[of], *poses)
        np.minimum.at(gap, of, distance)
        k = np.flatnonzero(distance < MARGIN)
        begin = np.searchsorted(of[k], np.arange(1, len(pairs)))
        lists = (np.split(each, begin) for each in (sample[k], way[of[k]] + distance[k] / STEEPEST))
        return list(zip(*lists, strict=True))[: len(pairs)], np.maximum(gap, MARGIN)

    def _contacts(self, data) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Contacts of listed samples that are inside another body.

        Positions (k, 3), outward normals (k, 3) of the other body, depths (k,) in it, reduced where the surfaces do not
        face each other, and the rows (k,) of the sampled and of the other body.
        """
        k = np.flatnonzero(self._way[tuple(self._pairs.T)][self._pair] >= self._from)
        a, b = self._pairs[self._pair[k]].T.copy()
        turn, at = self._poses(data)
        row, x, normal, depth, facing = self._lookup.inside(self._sample[k], a, b, turn, at)
        a, b = a[row], b[row]
        for body, side in ((a, 1), (b, -1)):  # move contact points of balls to where the line of action meets the ball
            row = np.flatnonzero(self._ball[body] > 0)
            of = body[row]
            x[row] = turned(turn[of], self._centre[of]) + at[of] - side * self._ball[of, None] * normal[row]
            if side < 0:
                x[row] -= depth[row, None] * normal[row]
        return x, normal, depth * (facing / FACING).clip(0, 1), a, b

    def _poses(self, data) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (o, 3, 3) and positions (o, 3) of the bodies; the model has ground bodies after them."""
        end = len(self._path) + 1
        return data.xmat[1:end].reshape(-1, 3, 3), data.xpos[1:end]

    def _beyond_planes(self, data, fixed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows (k,) of corners that are beyond a plane, rows (k,) of these planes, and depths (k,) beyond them."""
        normal = data.geom_xmat[self._planes][:, 2::3]
        count = len(self._radius)
        at, turn = data.xpos[1 : count + 1], data.xmat[1 : count + 1].reshape(-1, 3, 3)
        middle = (data.geom_xpos[self._planes] * normal).sum(1) - at @ normal.T + self._apart
        low = np.argwhere((middle + self._radius[:, None] > 0) & ~fixed[:, None])
        out = [(NONE[0], NONE[0], NONE[1])]
        for i, p in low:
            begin, end = self._first_corner[i : i + 2]
            depth = middle[i, p] - self._corners[begin:end] @ (normal[p] @ turn[i])
            k = np.flatnonzero(depth > 0)
            if len(k):
                out.append((begin + k, np.full(len(k), p), depth[k]))
        return tuple(np.concatenate(each) for each in zip(*out, strict=True))


class AddedContacts(NamedTuple):
    """Contacts between pairs of geometries of a MuJoCo model."""

    x: np.ndarray  # (k, 3), contact points
    normal: np.ndarray  # (k, 3), from the first to the second geometry
    excess: np.ndarray  # (k,), penetration depth beyond the allowed overlap
    geoms: np.ndarray  # (k, 2), ids of the geometries


def add_contacts(mujoco, model, data, contacts: AddedContacts) -> None:
    """Add contacts to those found by mj_collision."""
    contact, before = mujoco.MjContact(), data.ncon
    for name in ("flex", "elem", "vert"):
        getattr(contact, name)[:] = -1
    for _ in range(len(contacts.x)):
        mujoco.mj_addContact(model, data, contact)
    added, new, kept = data.contact, slice(before, None), slice(data.ncon - before)  # fewer if MuJoCo's arena is full
    x, normal, excess, geoms = (values[kept] for values in contacts)
    one, two = geoms.T
    added.geom1[new], added.geom2[new], added.geom[new] = one, two, geoms
    added.dist[new], added.pos[new] = -excess, x
    added.frame[new] = _frames(normal)
    # combined as by MuJoCo; its elliptic cones need a friction above 0, without which they have no normal force either
    friction = np.maximum(model.geom_friction[one], model.geom_friction[two]).clip(mujoco.mjMINMU)
    added.friction[new] = friction[:, [0, 0, 1, 2, 2]]
    added.dim[new] = np.maximum(model.geom_condim[one], model.geom_condim[two])
    added.solref[new], added.solimp[new] = model.geom_solref[one], model.geom_solimp[one]


def _ordered(shape: SurfaceShape, order: np.ndarray) -> SurfaceShape:
    """A shape with its samples reordered by `order`."""
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    per_sample = {n: getattr(shape, n)[order] for n in ("points", "normals", "flatness", "faces")}
    return replace(shape, **per_sample, nearest=np.append(rank, -1)[shape.nearest])


def _groups(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Group points (s, 3) by the cells of a coarse grid.

    Returns the order (s,) of the points by group, and for each group its first row in this order, the middle of its
    bounds and the largest distance of its points from the middle.
    """
    edge = max(float(np.ptp(points, axis=0).max(initial=0)) / GROUPS_ALONG, 1e-12) if len(points) else 1.0
    _, of = np.unique(np.floor(points / edge), axis=0, return_inverse=True)
    order = np.argsort(of.ravel(), kind="stable")
    first = np.flatnonzero(np.diff(of.ravel()[order], prepend=-1))
    parts = np.split(points[order], first[1:]) if len(points) else []
    middle = np.array([(g.min(0) + g.max(0)) / 2 for g in parts]).reshape(-1, 3)
    reach = np.array([np.linalg.norm(g - m, axis=1).max() for g, m in zip(parts, middle, strict=True)])
    return order, first, middle, reach


def extremes(x: np.ndarray, normal: np.ndarray, depth: np.ndarray, pair: np.ndarray) -> np.ndarray:
    """Contact reduction: rows of the contacts that are extreme in eight tangential directions, and of the deepest ones.

    Chosen separately for each pair and for each of six axis directions nearest to the normal. Source: Moravanszky and
    Terdiman 2004, "Fast contact reduction for dynamics simulation".
    """
    axis = np.abs(normal).argmax(1)
    row = np.arange(len(x))
    key = 6 * pair + 2 * axis + (normal[row, axis] > 0)
    u, v = x[row, (axis + 1) % 3], x[row, (axis + 2) % 3]
    return largest_of_groups(np.array([u, -u, v, -v, u + v, u - v, -u + v, -u - v, depth]), key)


def largest_of_groups(values: np.ndarray, key: np.ndarray) -> np.ndarray:
    """Columns, sorted, with the largest of values (s, n) of each row in each group of equal keys (n,).

    Of equal values in a group, the last one is taken.
    """
    if not len(key):
        return NONE[0]
    order, begins, chosen = key.argsort(kind="stable"), np.ones(len(key), bool), np.zeros(len(key), bool)
    key, values = key[order], values[:, order]
    begins[1:] = key[1:] != key[:-1]
    first = np.flatnonzero(begins)
    largest = np.maximum.reduceat(values, first, axis=1)[:, begins.cumsum() - 1]
    chosen[order[np.maximum.reduceat(np.where(values == largest, np.arange(len(key)), -1), first, axis=1)]] = True
    return np.flatnonzero(chosen)


def _frames(normal: np.ndarray) -> np.ndarray:
    """Contact frames (k, 9): unit normals (k, 3), each followed by two orthonormal tangents.

    Source: Duff et al. 2017, "Building an orthonormal basis, revisited".
    """
    x, y, z = normal.T
    sign = np.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return np.array([x, y, z, 1 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y]).T


def _ranges(begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The concatenated integers (n,) of half-open ranges, and for each the row (n,) of its range."""
    length = end - begin
    row = np.repeat(np.arange(len(length)), length)
    return np.arange(len(row)) + (begin - np.cumsum(length) + length)[row], row


def _hull_corners(points: np.ndarray) -> np.ndarray:
    """Rows of the points that are vertices of their convex hull; all rows if the points are coplanar."""
    try:
        return ConvexHull(points).vertices
    except (QhullError, ValueError):
        return np.arange(len(points))
