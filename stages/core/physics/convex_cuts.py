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
EQUALLY_FAR = 1e-5  # difference of heights relative to the largest, below which they count as equal


def extreme_rows(points: np.ndarray, directions: np.ndarray = EXTREMES) -> np.ndarray:
    """Sorted rows of those points (n, 3) that are the farthest in a direction, the first of those that are equally far.

    Rounding therefore does not choose among the points of a flat side.
    """
    height = directions @ (points - points.mean(0)).T
    top = height.max(1, keepdims=True)
    return np.unique((height >= top - EQUALLY_FAR * top.max()).argmax(1))


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
    parts = [body.whole()]
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

    def whole(self) -> Part:
        """The part of all voxels."""
        reach = (self.cells[self.shell] @ BOUNDS.T).max(0)
        return self.part(np.arange(len(self.cells)), np.arange(len(self.empty)), reach)

    def part(self, rows: np.ndarray, candidates: np.ndarray, reach: np.ndarray) -> Part:
        """The part of the voxels `rows`, whose extent along BOUNDS is `reach` (d,); the empty voxels in its hull are
        among `candidates`.
        """
        shell = rows[self._on_shell[rows]]
        points = self.cells[shell]
        inside = self._within(candidates, BOUNDS[:6], reach[:6])  # first, as most others are not
        inside = self._within(inside, BOUNDS[6:], reach[6:])
        try:
            faces = ConvexHull(points[extreme_rows(points, EXTREMES[::2])]).equations.astype(np.float32)
            inside = self._within(inside, faces[:, :3], -faces[:, 3])
        except (QhullError, ValueError):  # flat: it has the space within its bounds
            pass
        return Part(rows, shell, inside, float(self.weight[inside].sum()))

    def _within(self, empty: np.ndarray, normals: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Those of some empty voxels that are on the inner sides of planes."""
        return empty[(normals @ self.empty[empty].T <= reach[:, None] + 1e-3).all(0)]

    def cut(self, part: Part) -> tuple[Part, Part] | None:
        """Both sides of the plane that leaves least cost; None without any."""
        points = self.cells[part.shell]
        arm = points - points.mean(0, dtype=float)
        axes = np.concatenate([np.eye(3), np.linalg.eigh(arm.T @ arm)[1].T]).astype(np.float32)
        along = points @ axes.T
        low = along.min(0)
        width = np.maximum((along.max(0) - low) / LAYERS, 1.0)
        layer = _layers(along, low, width).T
        count = _sums(layer, np.ones_like(layer))
        first, last = bounds = _hulls_of_layers(points, layer, count)
        some = part.empty[:: -(-len(part.empty) // MAX_SAMPLES)]
        weight = np.broadcast_to(self.weight[some], (len(axes), len(some)))
        below, above = _first_inside(bounds, self.empty[some] @ BOUNDS.T)
        cost = np.cumsum(_sums(below, weight), 1)  # of the hull of layers 0..k, and of the others
        cost[:, :-1] += np.cumsum(_sums(above, weight), 1)[:, -2::-1]
        ends = LAYERS - 1 - (count[:, ::-1] > 0).argmax(1)
        count = np.cumsum(count, 1)
        cost += BALANCE * part.cost * np.abs(2 * count / len(points) - 1)
        k = np.arange(LAYERS)
        thin = (k < MIN_LAYERS - 1) | (k > ends[:, None] - MIN_LAYERS)
        cost[thin | (count < MIN_SHELL) | (count > len(points) - MIN_SHELL)] = np.inf
        a, k = np.unravel_index(cost.argmin(), cost.shape)
        if cost[a, k] == np.inf:
            return None
        under = _layers(self.cells[part.rows] @ axes.T, low, width)[:, a] <= k
        return (self.part(part.rows[under], part.empty, first[a, k]),
                self.part(part.rows[~under], part.empty, last[a, LAYERS - 2 - k]))  # fmt: skip


def _layers(along: np.ndarray, low: np.ndarray, width: np.ndarray) -> np.ndarray:
    return ((along - low) / width).astype(np.int64).clip(0, LAYERS - 1)


def _sums(layer: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Sums (axes, LAYERS) of the weights (axes, n) of points in these layers (axes, n)."""
    row = layer + LAYERS * np.arange(len(layer))[:, None]
    return np.bincount(row.ravel(), weight.ravel(), LAYERS * len(layer)).reshape(-1, LAYERS)


def _hulls_of_layers(points: np.ndarray, layer: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Bounds (2, axes, LAYERS, d) of the first k + 1 layers along each axis, and of the last k + 1; `layer` (axes, n)
    are those of the points (n, 3), and `count` (axes, LAYERS) is their number in each.
    """
    extent = points @ BOUNDS.T
    bounds = np.full((2, *count.shape, len(BOUNDS)), -np.inf, np.float32)
    for order, number, own in zip(layer.astype(np.uint8).argsort(1, kind="stable"), count, bounds[0], strict=True):
        present = number > 0
        start = np.cumsum(number, dtype=np.int64)[present] - number[present].astype(np.int64)
        own[present] = np.maximum.reduceat(extent[order], start)
    bounds[1] = bounds[0, :, ::-1]
    return np.maximum.accumulate(bounds, 2)


def _first_inside(bounds: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """The least k (*b, n) at which points of this extent (n, d) are within growing bounds (*b, LAYERS, d); they are
    within the last ones.
    """
    flat = bounds.reshape(-1, bounds.shape[-1]) + 1e-3
    at = np.arange(0, len(flat), LAYERS).reshape(*bounds.shape[:-2], 1)
    out = np.zeros((*bounds.shape[:-2], len(extent)), np.int64)
    step = LAYERS // 2
    while step:
        out += step * (flat.take(at + out + step - 1, 0) < extent).any(-1)
        step //= 2
    return out
