"""Division of a body of voxels into nearly convex parts by planes.

What is inside the convex hull of a part and not in the body is empty space. Each of its voxels costs its distance to
the body, so that the cost is the squared error of the surface, and voxels of other bodies cost OTHERS times as much.
The part of the highest cost is cut by the plane that leaves the least cost in both sides, out of all planes between
layers along the world's and the part's principal axes.

Hulls grow with the layers: an empty voxel is in the hull of the first k layers from some k on. These k follow for all
voxels and axes at once by bisection, with hulls that are bounded in the fixed directions BOUNDS.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

MAX_PARTS = 64  # of a body
ACCEPTED = 0.05  # cost per voxel of the surface that is accepted: an error of a third of a voxel everywhere
OTHERS = 10  # weight of the space in a hull that belongs to other bodies, relative to empty space
MIN_SHELL = 8  # voxels of the surface on each side of a plane
MIN_LAYERS = 2  # on each side: hulls of voxels' centres leave out half a voxel
LAYERS = 32  # most layers along an axis
BALANCE = 0.05  # weight of unequal sides, which decides where no plane alone reduces the cost, as in V-HACD
MAX_EMPTY = 12_000  # empty voxels of a body that are looked at, drawn at random; each stands for several then
MAX_SAMPLES = 600  # empty voxels of a part that are looked at in the search of a plane


def fibonacci(count: int) -> np.ndarray:
    """Unit vectors (count, 3), spread evenly (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)


BOUNDS = np.concatenate([np.eye(3), -np.eye(3), fibonacci(48)]).astype(np.float32)
EXTREMES = np.concatenate([np.eye(3), -np.eye(3), fibonacci(200)]).astype(np.float32)


@dataclass(frozen=True)
class Part:
    """Rows of a body's voxels in a part, of its surface, and of the empty space in the part's hull."""

    rows: np.ndarray
    shell: np.ndarray
    empty: np.ndarray
    cost: float

    @property
    def accepted(self) -> bool:
        """Whether it needs no division, or has too few voxels for one."""
        return self.cost <= ACCEPTED * len(self.shell) or len(self.shell) < 2 * MIN_SHELL


def divide(cells: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The part, from 0, of each of the unit voxels at cells (m, 3) of a body; `others` (n, 3) are points outside it."""
    body = _Body(cells, others)
    parts = [body.part(np.arange(len(cells)), np.arange(len(body.empty)))]
    while len(parts) < MAX_PARTS and sum(p.cost for p in parts) > ACCEPTED * len(body.shell):
        worst = max(range(len(parts)), key=lambda k: -1.0 if parts[k].accepted else parts[k].cost)
        sides = None if parts[worst].accepted else body.cut(parts[worst])
        if sides is None:
            break
        parts[worst : worst + 1] = sides
    out = np.empty(len(cells), np.int64)
    for k, p in enumerate(parts):
        out[p.rows] = k
    return out


class _Body:
    """Voxels and the empty space around them."""

    def __init__(self, cells: np.ndarray, others: np.ndarray):
        low = cells.min(0)
        index = np.round(cells - low).astype(np.int64) + 1
        full = np.zeros(index.max(0) + 2, bool)
        full[tuple(index.T)] = True
        core = ndimage.binary_erosion(full)
        self.cells = cells.astype(np.float32)
        self.shell = np.flatnonzero(~core[tuple(index.T)])
        self._on_shell = np.zeros(len(cells), bool)
        self._on_shell[self.shell] = True
        distance = ndimage.distance_transform_edt(~full)
        holes = np.argwhere(~full)
        share = max(1.0, len(holes) / MAX_EMPTY)
        holes = holes[np.random.default_rng(0).permutation(len(holes))[:MAX_EMPTY]]
        near = (np.round(others - low).astype(np.int64) + 1).clip(0, np.array(full.shape) - 1)
        of_others = OTHERS * np.maximum(distance[tuple(near.T)], 1.0)
        self.empty = np.concatenate([holes - 1 + low, others]).astype(np.float32)
        self.weight = np.concatenate([share * distance[tuple(holes.T)], of_others])

    @cached_property
    def _bounds(self) -> np.ndarray:
        """Extent (n, d) of the empty voxels along BOUNDS."""
        return self.empty @ BOUNDS.T

    def part(self, rows: np.ndarray, candidates: np.ndarray) -> Part:
        """The part of the voxels `rows`; the empty voxels in its hull are among `candidates`."""
        shell = rows[self._on_shell[rows]]
        points = self.cells[shell]
        inside = candidates[(self._bounds[candidates] <= (points @ BOUNDS.T).max(0) + 1e-3).all(1)]
        try:
            faces = ConvexHull(points[np.unique((points @ EXTREMES[::2].T).argmax(0))]).equations.astype(np.float32)
            inside = inside[(self.empty[inside] @ faces[:, :3].T <= 1e-3 - faces[:, 3]).all(1)]
        except (QhullError, ValueError):  # flat: it has the space within its bounds
            pass
        return Part(rows, shell, inside, float(self.weight[inside].sum()))

    def cut(self, part: Part) -> tuple[Part, Part] | None:
        """Both sides of the plane that leaves least cost; None without any."""
        points = self.cells[part.shell]
        axes = np.concatenate([np.eye(3), np.linalg.eigh(np.cov(points.T))[1].T]).astype(np.float32)
        along = points @ axes.T
        low = along.min(0)
        width = np.maximum((along.max(0) - low) / LAYERS, 1.0)
        layer = _layers(along, low, width)
        first, last = _hulls_of_layers(points, layer)
        some = part.empty[:: -(-len(part.empty) // MAX_SAMPLES)]
        extent, weight = self._bounds[some], self.weight[some]
        below = _first_inside(first, extent)
        above = np.maximum(LAYERS - 1 - _first_inside(last, extent), 0)  # the last layer from which all above have it
        best, where = np.inf, None
        for a in range(len(axes)):
            cost = np.cumsum(np.bincount(below[a], weight, LAYERS + 1))[:LAYERS]  # of the hull of layers 0..k
            cost = cost + np.cumsum(np.bincount(above[a], weight, LAYERS + 1)[::-1])[::-1][1:]  # and of the others
            count = np.cumsum(np.bincount(layer[:, a], minlength=LAYERS))
            cost += BALANCE * part.cost * np.abs(2 * count / len(points) - 1)
            cost[(count < MIN_SHELL) | (count > len(points) - MIN_SHELL)] = np.inf
            used = np.flatnonzero(np.diff(count, prepend=0))
            cost[: used[0] + MIN_LAYERS - 1] = cost[max(used[-1] - MIN_LAYERS + 1, 0) :] = np.inf
            k = int(cost.argmin())
            if cost[k] < best:
                best, where = cost[k], (a, k)
        if where is None:
            return None
        a, k = where
        under = _layers(self.cells[part.rows] @ axes.T, low, width)[:, a] <= k
        return self.part(part.rows[under], part.empty), self.part(part.rows[~under], part.empty)


def _layers(along: np.ndarray, low: np.ndarray, width: np.ndarray) -> np.ndarray:
    return ((along - low) / width).astype(np.int64).clip(0, LAYERS - 1)


def _hulls_of_layers(points: np.ndarray, layer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (axes, LAYERS, d) of the first k + 1 layers along each axis, and of the last k + 1."""
    extent = points @ BOUNDS.T
    bounds = np.full((layer.shape[1], LAYERS, len(BOUNDS)), -np.inf, np.float32)
    for a in range(layer.shape[1]):
        order = layer[:, a].argsort(kind="stable")
        present, start = np.unique(layer[order, a], return_index=True)
        bounds[a, present] = np.maximum.reduceat(extent[order], start)
    return np.maximum.accumulate(bounds, 1), np.maximum.accumulate(bounds[:, ::-1], 1)


def _first_inside(bounds: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """The least k (axes, n) at which points of this extent (n, d) are within growing bounds (axes, k, d); else their
    number.
    """
    axis = np.arange(len(bounds))[:, None]
    low, high = (np.full((len(bounds), len(extent)), k) for k in (0, bounds.shape[1]))
    while (low < high).any():
        middle = (low + high) // 2
        inside = (extent <= bounds[axis, np.minimum(middle, bounds.shape[1] - 1)] + 1e-3).all(-1)
        low, high = np.where(inside, low, np.minimum(middle + 1, high)), np.where(inside, middle, high)
    return low
