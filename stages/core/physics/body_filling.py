"""Closing the shell of an object in voxels, and filling what it encloses.

Shells of Gaussians have gaps, holes and often no underside. Gaps are closed, and what is enclosed but for the floor,
narrow leaks or an unseen underside is filled; an open bowl stays hollow. Sheets are thickened to three voxels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from stages.core.physics.morphology import dilated, eroded, opened, squared_distances, surrounded, within

MIN_PARTICLES = 40  # per object
MAX_VOXELS_ALONG = 300  # maximum number of voxels along an object
LEAK_RADII = (2, 3, 4, 5, 6, 8)  # half widths of the holes in shells that are closed [voxels]
MIN_CAVITY_RATIO = 1.5  # minimum half width of a cavity relative to that of its leaks
STRAY = 0.01  # fraction of an object's points that may be below it, and of voxels in which others may be
UNDERSIDE = 0.02  # quantile of the heights of points at which an unseen underside begins: walls are ragged below
FULLER = 1.5  # ratio of volumes above which it closes an object: then it makes a body of a shell


class SurfaceCloud(NamedTuple):
    """Points of an object's surface, and where it may be closed."""

    points: np.ndarray  # (n, 3)
    gap: float  # between points
    hole: float  # the widest gap of a closed surface
    others: np.ndarray | None  # (k, 3) points of other objects, where its unseen sides are missing


def closed_body(cloud: SurfaceCloud, h: float, floor: float | None) -> tuple[np.ndarray, np.ndarray]:
    """The closed and filled body of an object as voxels of edge h, and the index of its first voxel.

    It is filled as one that hangs, or closed from below by the `floor` on which it stands: what fills more. Photos show
    no undersides of what is at rest, and only parts of the surface around them. So those with `others` are also closed
    where that becomes sparse, whatever they lie on, if it makes a body of a shell and the others are not inside.
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
        # gaps that closing just misses leak too, but folds of a cloth on the floor look like cavities with wide holes
        body = max(body, filled(lowest, (bridge + 1,)), key=np.count_nonzero)
    most = np.logical_or.accumulate(shell[:, :, : margin - 1 : -1], 2).sum()  # voxels that any way fills
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
    fringe = thin & surrounded(thick)  # what trimming left at edges, not a sheet
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
    """The shell with gaps closed and the enclosed volume filled; `wide` is within `gap` of it.

    `bottom` is the layer that closes it from below, against wide leaks too if it is `sealed`; `leaks` as for _cavities.
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
    """Cavities with leaks narrower than the cavity by MIN_CAVITY_RATIO: a jug is filled, a mug or a bowl is not.

    Reconstructed shells have holes; left hollow, they would crumple like paper bags. `leaks` are the half widths of the
    holes to close [voxels], increasing.
    """
    if not walls.any():
        return walls
    box = ndimage.find_objects(walls.view(np.uint8))[0]  # what is free on its faces is so further out too
    inner = walls[box]
    away = squared_distances(inner, math.ceil(MIN_CAVITY_RATIO * leaks[-1]))
    filled = np.zeros_like(inner)
    for leak in leaks:
        free, wide = away > leak**2, away >= (MIN_CAVITY_RATIO * leak) ** 2
        hollow = free & ~_outside(free) & ~filled
        if (hollow & wide).any():
            hollow = _components_with(hollow, wide)
            room = leak + 1  # margin, beyond which all is free
            outside = _outside(squared_distances(np.pad(inner, room), leak) > leak**2)
            from_outside = squared_distances(outside, room)[room:-room, room:-room, room:-room]
            filled |= _components_with(~inner & (from_outside > room**2), hollow)  # to the walls, not through the leaks
    out = np.zeros_like(walls)
    out[box] = filled
    return out


def _components_with(free: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The connected components of the free voxels that contain a seed."""
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
    """Remove outermost voxels of thick parts whose centre lies outside the surface.

    Otherwise a body would grow by half a voxel all around. Points on the surface are at `offset` (n, 3) from the
    centres of the voxels `at` (n,) of the flat grid [voxels].
    """
    skin = thick_skin(body)
    some = skin.ravel()[at]
    at, offset = at[some], offset[some]
    slope = np.gradient(ndimage.gaussian_filter(body.astype(np.float32), 1.0))  # points inward
    depth = sum(offset[:, a] * slope[a].ravel()[at] for a in range(3))
    return body & ~(skin & (np.bincount(at, depth, body.size).reshape(body.shape) > 0))


def thick_skin(body: np.ndarray) -> np.ndarray:
    """The outermost voxels where the body is at least five voxels thick."""
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
