"""Close the voxel shell of an object and fill its interior.

Shells of Gaussians have gaps, holes and often no underside. Gaps are closed by morphological closing. A cavity is
filled if it is enclosed, or open only at the floor, at an unseen underside or through narrow leaks; an open bowl stays
hollow. Sheets are thickened to three voxels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from stages.core.physics.morphology import dilated, eroded, opened, squared_distances, surrounded, within

MIN_PARTICLES = 40  # minimum number of particles of an object
MAX_VOXELS_ALONG = 300  # maximum number of voxels along an object
LEAK_RADII = (2, 3, 4, 5, 6, 8)  # half widths of the leaks in shells that are sealed [voxels]
MIN_CAVITY_RATIO = 1.5  # minimum half width of a cavity relative to that of its leaks
STRAY = 0.01  # tolerated fraction of an object's points below it, and of its filled voxels with points of other objects
UNDERSIDE = 0.02  # quantile of the points' heights at which an unseen underside is closed: walls are ragged below it
FULLER = 1.5  # closing the underside must increase the volume by this factor: then it turns a shell into a solid


class SurfaceCloud(NamedTuple):
    """Points on an object's surface, with the gaps to be closed. Lengths are in the unit of the points."""

    points: np.ndarray  # (n, 3)
    gap: float  # usual gap between points
    hole: float  # widest gap between points on a closed surface
    others: np.ndarray | None  # (k, 3) points of other objects; None if the object has no missing unseen sides


def closed_body(cloud: SurfaceCloud, h: float, floor: float | None) -> tuple[np.ndarray, np.ndarray]:
    """The closed and filled body of an object as a mask (x, y, z) of voxels of edge h, and the index (3,) of the first.

    It is filled with its underside open and, if it stands on `floor`, with its underside closed by the floor; the
    larger body is kept. Photos do not show the underside of an object at rest, and only parts of the surface just above
    it. With `others`, the body is therefore also filled with its underside closed at the height where its points become
    sparse. That body is kept if it is much larger and contains almost no points of other objects.
    """
    points, others = cloud.points, cloud.others
    cells = np.floor(points / h).astype(np.int64)
    margin = 6  # room for closing
    low = cells.min(0) - margin
    shape = np.minimum(cells.max(0) - low + 1 + margin, MAX_VOXELS_ALONG + 3 * margin)
    cells -= low
    kept = (cells < shape - margin).all(1)
    if not kept.all():
        points, cells = points[kept], cells[kept]
    at = np.ravel_multi_index(tuple(cells.T), shape)
    shell = np.zeros(shape, bool)
    shell.ravel()[at] = True
    bridge, widest = (min(max(math.ceil(gap / h / 2), 1), 4) for gap in (cloud.gap, cloud.hole))
    offset = points / h - low - cells - 0.5

    def filled(bottom: int | None, leaks: Sequence[int], bridge: int = bridge, sealed: bool = False) -> np.ndarray:
        return _trim(_largest(_fill(shell, within(shell, bridge), bridge, bottom, leaks, sealed)), offset, at)

    body = filled(None, LEAK_RADII, widest)
    lowest = margin if floor is None else max(margin, int(np.floor(floor / h)) - int(low[2]))
    if floor is not None:
        # seal only leaks just wider than the closing; otherwise folds of a cloth on the floor would count as cavities
        body = max(body, filled(lowest, (bridge + 1,)), key=np.count_nonzero)
    most = np.logical_or.accumulate(shell[:, :, : margin - 1 : -1], 2).sum()  # upper bound of the filled volume
    if others is not None and most > FULLER * body.sum():
        below = max(lowest, int(np.quantile(cells[:, 2], UNDERSIDE)))
        other = filled(below, LEAK_RADII, sealed=True)
        theirs = np.floor(others / h).astype(np.int64) - low
        theirs = np.unique(theirs[((theirs >= 0) & (theirs < shape)).all(1)], axis=0)
        added = other & ~body
        inside = np.count_nonzero(added[tuple(theirs.T)]) > STRAY * added.sum()
        if other.sum() > FULLER * body.sum() and not inside:
            body = other
    thick = opened(body)
    thin = body & ~thick
    fringe = thin & surrounded(thick)  # remains of the trimming at edges, not sheets
    body, thin = body & ~fringe, thin & ~fringe
    if thin.any():
        body |= dilated(thin)
    while body.sum() < MIN_PARTICLES:
        body = dilated(np.pad(body, 1))
        low = low - 1
    return body, low


def _fill(
    shell: np.ndarray, wide: np.ndarray, gap: int, bottom: int | None, leaks: Sequence[int], sealed: bool
) -> np.ndarray:
    """The shell with gaps closed and the enclosed volume filled; `wide` is the shell dilated by `gap` voxels.

    Layers up to `bottom` close it from below; if `sealed`, they also bound leaky cavities. `leaks` as in `_cavities`.
    """
    walls = wide.copy()
    if bottom is not None:
        walls[:, :, : bottom + 1] = True
    outside = _outside(~walls)
    enclosed = ~(outside | walls)
    grown = within(enclosed, gap) & wide if enclosed.any() else enclosed
    closed = ~within(~wide, gap)
    body = shell | closed | enclosed | (grown & ~within(outside, gap))
    body |= _cavities(body | (walls & ~wide) if sealed else body, leaks)
    if bottom is not None:
        body[:, :, : int(shell.any((0, 1)).argmax())] = False
    return body


def _cavities(walls: np.ndarray, leaks: Sequence[int]) -> np.ndarray:
    """Cavities wider than their leaks by MIN_CAVITY_RATIO: a jug is filled, a mug or a bowl is not.

    Reconstructed shells have holes; left hollow, they would crumple. `leaks` are the half widths of the leaks to seal
    [voxels], in increasing order.
    """
    if not walls.any():
        return walls
    box = ndimage.find_objects(walls.view(np.uint8))[0]  # everything outside the bounding box is free
    inner = walls[box]
    away = squared_distances(inner, math.ceil(MIN_CAVITY_RATIO * leaks[-1]))
    filled = np.zeros_like(inner)
    for leak in leaks:
        free, wide = away > leak**2, away >= (MIN_CAVITY_RATIO * leak) ** 2
        hollow = free & ~_outside(free) & ~filled
        if (hollow & wide).any():
            hollow = _components_with(hollow, wide)
            room = leak + 1  # margin beyond which every voxel is free
            outside = _outside(squared_distances(np.pad(inner, room), leak) > leak**2)
            from_outside = squared_distances(outside, room)[room:-room, room:-room, room:-room]
            filled |= _components_with(~inner & (from_outside > room**2), hollow)  # up to the walls, not into the leaks
    out = np.zeros_like(walls)
    out[box] = filled
    return out


def _components_with(free: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The connected components of `free` that contain a seed."""
    labels, count = ndimage.label(free)
    kept = np.zeros(count + 1, bool)
    kept[labels[free & seeds]] = True
    return kept[labels]


def _outside(free: np.ndarray) -> np.ndarray:
    """The free voxels connected to the faces of the grid."""
    labels, count = ndimage.label(free)
    kept = np.zeros(count + 1, bool)
    for axis in range(3):
        for end in (0, -1):
            kept[labels.take(end, axis)] = True
    kept[0] = False
    return kept[labels]


def _trim(body: np.ndarray, offset: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Remove the outermost voxels of thick parts whose centre lies outside the surface.

    Otherwise a body would grow by half a voxel all around. The surface points are at `offset` (n, 3) from the centres
    of the voxels with flat indices `at` (n,) [voxels].
    """
    skin = thick_skin(body)
    some = skin.ravel()[at]
    at, offset = at[some], offset[some]
    slope = np.gradient(ndimage.gaussian_filter(body.astype(np.float32), 1.0))  # points inward
    depth = sum(offset[:, a] * slope[a].ravel()[at] for a in range(3))
    return body & ~(skin & (np.bincount(at, depth, body.size).reshape(body.shape) > 0))


def thick_skin(body: np.ndarray) -> np.ndarray:
    """The outermost voxels of the parts that are at least five voxels thick."""
    core = eroded(body, 2)
    return body & ~eroded(body) & dilated(core, 3)


def _largest(body: np.ndarray) -> np.ndarray:
    """Remove connected components smaller than a fiftieth of the largest."""
    labels, n = ndimage.label(body, np.ones((3, 3, 3)))
    if n <= 1:
        return body
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return (sizes >= sizes.max() / 50)[labels] & body
