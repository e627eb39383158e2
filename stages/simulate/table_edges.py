"""Table edges in the rigid engine, which limit the infinite plane of the floor to the outline of the table.

Contacts with the floor beyond an edge are excluded. If a body overhangs an edge, its convex hull is intersected with
the vertical plane through the edge, and the points of this section below the floor become contacts. A body whose centre
is beyond an edge and below the floor has left the table and no longer collides with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from stages.core.perception.table_outline import TableOutline
from stages.simulate.surface_contacts import AddedContacts, add_contacts, largest_of_groups

ON_EDGE = 1e-9  # distance beyond an edge up to which a point still counts as on the table [simulation units]


class TableEdges:
    """Replaces contacts between the floor, the first geometry of a MuJoCo model, and the bodies from 1 on."""

    def __init__(self, mujoco, model, data, outline: TableOutline, corners: Sequence[np.ndarray]):
        """`outline` in simulation units; `corners` (v, 3) of the hull of each body in its frame."""
        self._mujoco, self._model, self._outline = mujoco, model, outline
        self._hulls = [_hull_edges(points) for points in corners]
        self._radius = np.array([np.linalg.norm(points, axis=1).max(initial=0) for points in corners])
        self._geom = [np.flatnonzero(model.geom_bodyid == i + 1)[0] for i in range(len(corners))]
        self._floor = float(model.geom_pos[0, 2])
        self._left = np.zeros(model.nbody, bool)
        lowest = [self._heights(data, i).min(initial=np.inf) for i in range(len(corners))]
        self._sunk = np.maximum(self._floor - np.array(lowest), 0)  # initial depth below the floor, allowed
        signature = (model.geom_bodyid[0] << 16) + np.arange(1, len(corners) + 1)
        self._on_table = ~np.isin(signature, model.exclude_signature)

    def apply(self, data, fixed: np.ndarray) -> None:
        """Exclude contacts beyond the edges and add contacts at them, after all other contacts were found.

        `fixed` masks the bodies of the model that do not move.
        """
        count = len(self._radius)
        centre = data.xpos[1 : count + 1]
        beyond = self._outline.beyond(centre)
        self._left[1 : count + 1] |= (beyond > 0) & (centre[:, 2] < self._floor)
        contact = data.contact
        rows = np.flatnonzero((contact.geom == 0).any(1))
        body = self._model.geom_bodyid[contact.geom[rows]].max(1)
        rows = rows[self._left[body] | (self._outline.beyond(contact.pos[rows]) > 0)]
        contact.exclude[rows] = 1
        contact.efc_address[rows] = -1  # MuJoCo leaves it undefined if all contacts are excluded
        over = self._on_table & ~self._left[1 : count + 1] & ~fixed[1 : count + 1]
        over &= (np.abs(beyond) < self._radius) & (centre[:, 2] - self._floor < self._radius)
        over = np.flatnonzero(over)
        found = [self._on_edges(self._low(data, i), self._sunk[i]) for i in over]
        i, x = np.repeat(over, [len(points) for points in found]), np.concatenate([np.zeros((0, 3)), *found])
        if not len(x):
            return
        depth = self._floor - x[:, 2] - self._sunk[i]
        up = np.tile([0.0, 0.0, 1.0], (len(x), 1))
        geoms = np.stack([np.zeros(len(x), int), np.array(self._geom)[i]], 1)
        add_contacts(self._mujoco, self._model, data, AddedContacts(x, up, depth, geoms))

    def _heights(self, data, row: int) -> np.ndarray:
        """Heights (v,) of the corners of a body's hull."""
        return self._hulls[row][0] @ data.xmat[row + 1, 6:] + data.xpos[row + 1, 2]

    def _low(self, data, row: int) -> np.ndarray:
        """End points (e, 2, 3) of the edges of a body's hull that reach below the floor."""
        corners, edges = self._hulls[row]
        low = self._heights(data, row) < self._floor - self._sunk[row]
        edges = edges[low[edges].any(1)] if low.any() else edges[:0]
        return corners[edges] @ data.xmat[row + 1].reshape(3, 3).T + data.xpos[row + 1]

    def _on_edges(self, ends: np.ndarray, sunk: float) -> np.ndarray:
        """Contact points (n, 3) where edges (e, 2, 3) of a body cross edges of the table, deeper than `sunk`.

        For each edge of the table only the two outermost points and the deepest one are kept.
        """
        if not len(ends):
            return ends[:, 0]
        side = ends[..., :2] @ self._outline.normals.T - self._outline.offsets  # (e, 2, k)
        of, row = np.nonzero((side[:, 0] * side[:, 1] < 0).T)  # edges of the table and of the body
        a, b = side[row, 0, of], side[row, 1, of]
        x = ends[row, 0] + (a / (a - b))[:, None] * (ends[row, 1] - ends[row, 0])
        kept = (x[:, 2] < self._floor - sunk) & (self._outline.beyond(x) < ON_EDGE)
        x, normal = x[kept], self._outline.normals[of[kept]]
        along = x[:, 1] * normal[:, 0] - x[:, 0] * normal[:, 1]
        return x[largest_of_groups(np.array([-along, along, -x[:, 2]]), of[kept])]


def _hull_edges(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (v, 3) and edges (e, 2) of the triangulated convex hull of points; none for coplanar points."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return np.zeros((0, 3)), np.zeros((0, 2), np.int64)
    row = np.zeros(len(points), np.int64)
    row[hull.vertices] = np.arange(len(hull.vertices))
    edges = np.unique(np.sort(hull.simplices[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1), axis=0)
    return points[hull.vertices], row[edges]
