"""Contacts between the surfaces of rigid bodies, of which convex parts are only an approximation.

The faces of convex parts lie at the mean level of the surface under them. What a rough surface has above it would enter
other bodies, by up to a voxel of the rougher one: much of the height of a small body on a large one. So samples of each
body's surface are looked up in the signed distance of the others, and those inside are contacts along its gradient,
besides the contacts of the parts; so are those beyond the floor and walls. Bodies that fill their convex hull need none
with each other and with planes.

These contacts are inelastic: critically damped, and pushed apart at no more than the speed at which contacts do not
rebound, since a sample that meets an edge or a thin wall may be deep inside at once. The overlap of two bodies at the
start is no contact, nor the least one since (`initial_overlaps.py`).

Samples that can soon touch are kept in a list for each pair, until both bodies may have moved by its margin.
Sources: point contacts in signed distances: Xu, Zhao and Barbic 2014, "Implicit multibody penalty-based distributed
contact"; lists: Verlet 1967, "Computer experiments on classical fluids".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from stages.core.physics.solid_surface import SolidSurface
from stages.simulate.initial_overlaps import WINDOW

MARGIN = 0.05  # distance up to which samples are in a list [units of the simulation]
FACING = 0.5  # cosine of the angle between a surface and the one it faces up to which all of a depth counts
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)  # of a cell


@dataclass(frozen=True)
class SurfaceShape:
    """Samples of a body's surface, and depths below it at the nodes of a grid, in the body's frame."""

    points: np.ndarray  # (s, 3)
    normals: np.ndarray  # (s, 3), outwards
    depth: np.ndarray  # (x, y, z)
    low: np.ndarray  # (3,), the first node
    h: float  # between nodes
    convex: bool  # fills its convex hull


def surface_shape(body: SolidSurface, bottom: float, com: np.ndarray, scale: float, convex: bool) -> SurfaceShape:
    """The shape of a body that ends at the height `bottom`, in a frame at `com` with `scale` units per scene unit."""
    points, normals = body.samples()
    above = points[:, 2] > bottom
    depth, low = body.depth_grid()
    height = low[2] + body.h * np.arange(depth.shape[2])
    return SurfaceShape(scale * (points[above] - com), normals[above], scale * np.minimum(depth, height - bottom),
                        scale * (low - com), scale * body.h, convex)  # fmt: skip


class SurfaceContacts:
    """Finds the contacts of the bodies 1.. of a MuJoCo model, of these shapes, and adds them to its data."""

    def __init__(self, mujoco, model, data, shapes: Sequence[SurfaceShape]):
        self._mujoco, self._model = mujoco, model
        count = len(shapes)
        self._points, self._normals = (np.concatenate([getattr(s, n) for s in shapes]) for n in ("points", "normals"))
        self._first = np.cumsum([0, *(len(s.points) for s in shapes)])
        self._radius = np.array([np.linalg.norm(s.points, axis=1).max(initial=0) for s in shapes])
        self._depth = np.concatenate([s.depth.ravel() for s in shapes])
        self._smooth = np.concatenate([ndimage.gaussian_filter(s.depth, 1.0).ravel() for s in shapes])
        self._grid = np.cumsum([0, *(s.depth.size for s in shapes)])[:-1]
        self._shape, self._low = np.array([s.depth.shape for s in shapes]), np.array([s.low for s in shapes])
        self._h = np.array([s.h for s in shapes])
        rough = ~np.array([s.convex for s in shapes])
        self._possible = (rough[:, None] | rough) & ~np.eye(count, dtype=bool)
        self._planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
        of = model.geom_bodyid[self._planes]
        pairs = np.arange(1, count + 1)[:, None]
        apart = np.isin((np.minimum(of, pairs) << 16) + np.maximum(of, pairs), model.exclude_signature)
        lowest = [self._first[i] + _hull_corners(s.points) if rough[i] else [] for i, s in enumerate(shapes)]
        self._corners = np.concatenate(lowest).astype(np.int64)  # the samples that can touch planes
        self._corner_of = np.repeat(np.arange(count), [len(rows) for rows in lowest])
        self._beyond = np.where(apart, -np.inf, 0.0)[self._corner_of]  # added to how far each corner is beyond a plane
        # the first part of each, whose friction and damping are those of the body
        self._geom = np.array([np.flatnonzero(model.geom_bodyid == i + 1)[0] for i in range(count)])
        self._dof = model.body_dofadr[1 : count + 1]
        self._path = np.zeros(count)  # the way that any point of a body has gone at most
        self._due = np.full((count, count), -np.inf)  # sum of both paths at which the list of a pair must be made again
        self._lists: dict[tuple[int, int], np.ndarray] = {}
        self._sample = self._of = self._into = np.zeros(0, np.int64)  # all lists; sample of a body into another one
        self._allowed, self._deepest, self._substeps = np.full((count, count), np.inf), np.zeros((count, count)), 0
        fixed = np.zeros(count, bool)
        self._update_lists(data, fixed)
        self._note(self._contacts(data)[2:], fixed)
        self._allowed, self._deepest[:] = np.maximum(self._deepest, self._deepest.T), 0.0
        self._below = np.zeros((count, len(self._planes)))  # how far a body is beyond each plane at the start
        _, depth = self._beyond_planes(data)
        np.maximum.at(self._below, self._corner_of, depth)

    def add(self, data, fixed: np.ndarray) -> None:
        """Add the contacts to those found by mj_fwdPosition, and make the constraints again; `fixed` masks the bodies
        that do not move.
        """
        fixed = fixed[1 : len(self._path) + 1]
        free = np.flatnonzero(~fixed & (self._dof >= 0))
        velocity = data.qvel[self._dof[free, None] + np.arange(6)]
        speed = np.linalg.norm(velocity[:, :3], axis=1) + np.linalg.norm(velocity[:, 3:], axis=1) * self._radius[free]
        self._path[free] += speed * self._model.opt.timestep
        self._update_lists(data, fixed)
        x, normal, depth, a, b = self._contacts(data)
        self._note((depth, a, b), fixed)
        excess = depth - self._allowed[a, b]
        k = np.flatnonzero(excess > 0)
        one, two = self._geom[b[k]], self._geom[a[k]]
        x, normal, excess = x[k] + depth[k, None] / 2 * normal[k], normal[k], excess[k]
        at, depth = self._beyond_planes(data)
        depth -= self._below[self._corner_of]
        row, plane = np.nonzero((depth > 0) & ~fixed[self._corner_of, None])
        if len(k) + len(row):
            one, two = np.append(self._planes[plane], one), np.append(self._geom[self._corner_of[row]], two)
            normal = np.concatenate([data.geom_xmat[self._planes[plane]][:, 2::3], normal])
            self._append(data, np.concatenate([at[row], x]), normal, np.append(depth[row, plane], excess), one, two)

    def _note(self, contacts: tuple, fixed: np.ndarray) -> None:
        """Take the deepest samples of each pair; those of some substeps bound the overlap allowed from then on."""
        depth, a, b = contacts
        np.maximum.at(self._deepest, (a, b), depth)
        self._substeps += 1
        if self._substeps % WINDOW == 0:
            free = ~(fixed[:, None] & fixed)
            self._allowed[free] = np.minimum(self._allowed, np.maximum(self._deepest, self._deepest.T))[free]
            self._deepest[:] = 0.0

    def _update_lists(self, data, fixed: np.ndarray) -> None:
        path = self._path[:, None] + self._path
        due = np.argwhere(self._possible & ~(fixed[:, None] & fixed) & (path >= self._due))
        changed = False
        for a, b in due.tolist():
            gap = np.linalg.norm(data.xpos[a + 1] - data.xpos[b + 1]) - self._radius[a] - self._radius[b]
            self._due[a, b] = path[a, b] + max(MARGIN, gap)
            near = self._near(data, a, b) if gap < MARGIN else ()
            changed |= bool(len(near)) or (a, b) in self._lists
            self._lists.pop((a, b), None)
            if len(near):
                self._lists[a, b] = near
        if changed:
            count = [len(rows) for rows in self._lists.values()]
            pair = np.array(list(self._lists), np.int64).reshape(-1, 2)
            self._of, self._into = np.repeat(pair, count, axis=0).T
            self._sample = np.concatenate([np.zeros(0, np.int64), *self._lists.values()])

    def _near(self, data, a: int, b: int) -> np.ndarray:
        """The samples of body a that are less than MARGIN outside body b."""
        R, S = (data.xmat[i + 1].reshape(3, 3) for i in (a, b))
        mine = slice(*self._first[a : a + 2])
        x = self._points[mine] @ (S.T @ R).T + (data.xpos[a + 1] - data.xpos[b + 1]) @ S
        low, high = self._low[b], self._low[b] + self._h[b] * (self._shape[b] - 1)
        rows = np.flatnonzero(((x > low - MARGIN) & (x < high + MARGIN)).all(1))
        inside = x[rows].clip(low, high)
        beyond = np.linalg.norm(x[rows] - inside, axis=1)
        node, f = self._cells(np.full(len(rows), b), inside)
        return self._first[a] + rows[beyond - _trilinear(self._depth[node], f) < MARGIN]

    def _cells(self, b: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (k, 8) of the nodes around points (k, 3) in the frames of bodies b (k,), and the places (k, 3) between
        them, beyond 0..1 for points outside of the grid.
        """
        u = (x - self._low[b]) / self._h[b, None]
        shape = self._shape[b]
        cell = u.astype(np.int64).clip(0, shape - 2)
        stride = np.stack([shape[:, 1] * shape[:, 2], shape[:, 2], np.ones_like(b)], 1)
        return ((self._grid[b] + (cell * stride).sum(1))[:, None] + stride @ CORNERS.T), u - cell

    def _contacts(self, data) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of the listed samples inside another body: positions (k, 3), outward normals (k, 3) of that body, depths (k,)
        in it, less where the surfaces do not face each other, and the rows (k,) of both bodies.
        """
        a, b, sample = self._of, self._into, self._sample
        at, turn = data.xpos[1:], data.xmat[1:].reshape(-1, 3, 3)
        x = (turn[a] @ self._points[sample, :, None])[..., 0] + at[a]
        node, f = self._cells(b, ((x - at[b])[:, None] @ turn[b])[:, 0])
        depth = np.where(((f >= 0) & (f <= 1)).all(1), _trilinear(self._depth[node], f), 0.0)
        k = np.flatnonzero(depth > 0)
        a, b, x, depth = a[k], b[k], x[k], depth[k]
        normal = -(turn[b] @ _slope(self._smooth[node[k]], f[k])[..., None])[..., 0]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-12)
        own = (turn[a] @ self._normals[sample[k], :, None])[..., 0]
        return x, normal, depth * (-(own * normal).sum(1) / FACING).clip(0, 1), a, b

    def _beyond_planes(self, data) -> tuple[np.ndarray, np.ndarray]:
        """Positions (k, 3) of the corners and how far (k, planes) they are beyond each plane."""
        at, turn = data.xpos[1:], data.xmat[1:].reshape(-1, 3, 3)
        x = (turn[self._corner_of] @ self._points[self._corners, :, None])[..., 0] + at[self._corner_of]
        normal = data.geom_xmat[self._planes][:, 2::3]
        return x, (data.geom_xpos[self._planes] * normal).sum(1) - x @ normal.T + self._beyond

    def _append(self, data, x, normal, excess, one, two) -> None:
        """Add contacts at x (k, 3) of geometries (k,), with normals from the first to the second one, and make the
        constraints again.
        """
        mujoco, model = self._mujoco, self._model
        contact, before = mujoco.MjContact(), data.ncon
        contact.dim = 3
        for name in ("flex", "elem", "vert"):
            getattr(contact, name)[:] = -1
        for _ in range(len(x)):
            mujoco.mj_addContact(model, data, contact)
        added, new, kept = data.contact, slice(before, None), slice(data.ncon - before)  # fewer where memory is short
        x, normal, excess, one, two = x[kept], normal[kept], excess[kept], one[kept], two[kept]
        added.geom1[new], added.geom2[new], added.geom[new] = one, two, np.stack([one, two], 1)
        added.dist[new], added.pos[new] = -excess, x
        side = np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)])
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        added.frame[new] = np.concatenate([normal, side, np.cross(normal, side)], 1)
        # as MuJoCo combines those of two geometries
        added.friction[new] = np.maximum(model.geom_friction[one], model.geom_friction[two])[:, [0, 0, 1, 2, 2]]
        added.solref[new] = np.minimum(model.geom_solref[one], model.geom_solref[two])
        added.solimp[new] = model.geom_solimp[one]
        mujoco.mj_makeConstraint(model, data)
        mujoco.mj_island(model, data)
        mujoco.mj_projectConstraint(model, data)


def _hull_corners(points: np.ndarray) -> np.ndarray:
    """Rows of the points at the corners of their convex hull; all of points in a plane."""
    try:
        return ConvexHull(points).vertices
    except (QhullError, ValueError):
        return np.arange(len(points))


def _trilinear(value: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Values (k,) between the corners (k, 8) of cells."""
    v = value[:, :4] + (value[:, 4:] - value[:, :4]) * f[:, :1]
    v = v[:, :2] + (v[:, 2:] - v[:, :2]) * f[:, 1:2]
    return v[:, 0] + (v[:, 1] - v[:, 0]) * f[:, 2]


def _slope(value: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Gradients (k, 3) of `_trilinear` [per edge of a cell]."""
    v = value.reshape(-1, 2, 2, 2)
    w = np.stack([1 - f, f], -1)  # (k, axis, side)
    d = (np.diff(v, axis=axis).reshape(-1, 2, 2) for axis in (1, 2, 3))
    return np.stack([((each @ w[:, k, :, None])[..., 0] * w[:, j]).sum(1)
                     for each, (j, k) in zip(d, ((1, 2), (0, 2), (0, 1)), strict=True)], 1)  # fmt: skip
