"""Convex bodies told by their surface: points that lie on their convex hull and cover all of it.

Random samples of a surface have holes that are wider than a thin body is thick. Closing gaps between points leaves such
a body hollow, although nothing but its convex hull has these points as its surface.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

# ON_HULL and MOST were chosen by reasoning for noise of .02 spacings, and not tuned
MAX_POINTS = 1500  # from which the hull is made; curved ones get a face for each few points
ON_HULL = 0.1  # depth below the hull of a point that lies on it [spacing]
MOST = 0.95  # share of the points that lie on it
HOLE = 2.5  # radius around places on the hull in which there is a point [spacing]: at random, one of e^20 has none
PLACES = 2000  # on the hull, where that is checked
STEEP = 1e-9  # component of a unit normal up to which it is horizontal


def covered_hull(points: np.ndarray, spacing: float) -> np.ndarray | None:
    """Outward planes (f, 4), unit normal and offset, of the convex hull of points (n, 3) if it is their surface.

    `spacing` is that of the points, 1 / sqrt(density) on the surface.
    """
    some = points[:: -(-len(points) // MAX_POINTS)]
    try:
        hull = ConvexHull(some)
    except (QhullError, ValueError):  # too few points, or in one plane
        return None
    depth = -(some @ hull.equations[:, :3].T + hull.equations[:, 3]).max(1)
    if np.mean(depth <= ON_HULL * spacing) < MOST:
        return None
    distance, _ = cKDTree(points).query(_places(hull), distance_upper_bound=HOLE * spacing)
    return hull.equations if np.isfinite(distance).all() else None


def _places(hull: ConvexHull) -> np.ndarray:
    """Places (PLACES, 3) on a hull, evenly by area."""
    corners = hull.points[hull.simplices]
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(b, c), axis=1)
    rng = np.random.default_rng(0)
    face = rng.choice(len(area), PLACES, p=area / area.sum())
    u, v = rng.random((2, PLACES, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[face] + u * b[face] + v * c[face]


def hull_voxels(planes: np.ndarray, low: np.ndarray, h: float, shape: np.ndarray) -> np.ndarray:
    """Mask (x, y, z) of the voxels of edge h, of which the first has the index `low`, with centres below all planes."""
    x, y, z = (h * (low[axis] + np.arange(shape[axis]) + 0.5) for axis in range(3))
    top, bottom = np.full((len(x), len(y)), np.inf), np.full((len(x), len(y)), -np.inf)
    for a, b, c, d in planes:
        room = -(a * x[:, None] + b * y + d)  # for c z
        if c > STEEP:
            np.minimum(top, room / c, out=top)
        elif c < -STEEP:
            np.maximum(bottom, room / c, out=bottom)
        else:
            top[room < 0] = -np.inf
    return (z <= top[..., None]) & (z >= bottom[..., None])
