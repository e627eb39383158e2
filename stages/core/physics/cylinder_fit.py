"""Fit a solid cylinder to the surface of a convex object, and decide whether the object is one.

The mean absolute distance of the surface points from the cylinder is minimised, starting from several axes: the
principal directions of the points, and of the area-weighted normals of their convex hull. For a cylinder, one of these
is its axis: the principal directions of the points are undetermined only at a height of 1.7 radii, those of the normals
only at 2 radii.

As for balls (`ball_fit.py`), reconstruction noise varies from place to place while the deviation of another shape does
not. The median distance over neighbouring points must therefore be small on the curved side and on each end; each part
is tested by itself, since the ends fit whatever shape is between them. The limits are those of balls: a prism of eight
sides is not accepted as a cylinder, one of twelve sides is. A thin plate has all its points near the ends of a disc
around it; it is rejected because it does not fill the disc.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, cKDTree

from stages.core.kernels.threads import small_operations
from stages.core.physics.ball_fit import CONVERGED, MAX_POINTS, MAX_STEPS, SHARES

NEIGHBOURS = 20  # points over which the median distance is taken, as many as per direction of a ball
FILLED = 0.9  # minimum fraction of the cylinder that the hull fills; a prism of twelve sides fills .95
MIN_POINTS = 4  # minimum number of points on the curved side and on each end: three always lie on one plane
Vector = Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Cylinder:
    """A solid cylinder, in scene units."""

    centre: Vector
    axis: Vector  # unit vector
    radius: float
    height: float

    @property
    def volume(self) -> float:
        """Volume [scene units^3]."""
        return np.pi * self.radius**2 * self.height

    @property
    def inertia(self) -> Float[np.ndarray, "3 3"]:
        """Inertia tensor about the centre at density 1 [scene units^5]."""
        along, across = self.radius**2 / 2, self.radius**2 / 4 + self.height**2 / 12
        return self.volume * (across * np.eye(3) + (along - across) * np.outer(self.axis, self.axis))

    def rims(self, count: int) -> Float[np.ndarray, "n 3"]:
        """Points on the rims of both ends, `count` on each."""
        turn = 2 * np.pi * np.arange(count) / count
        ring = self.centre + self.radius * np.column_stack([np.cos(turn), np.sin(turn)]) @ _across(self.axis)
        return np.concatenate([ring + half * self.axis for half in (-self.height / 2, self.height / 2)])

    def distances(self, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Signed distances from the surface, negative inside, and the nearest part: 0 curved side, -1 and 1 ends."""
        along = (points - self.centre) @ self.axis
        beside = np.linalg.norm((points - self.centre) @ _across(self.axis).T, axis=1) - self.radius
        beyond = np.abs(along) - self.height / 2
        return np.maximum(beside, beyond), np.where(beside >= beyond, 0, np.sign(along)).astype(np.int64)


@small_operations()
def fitted_cylinder(points: Float[np.ndarray, "n 3"], hull: ConvexHull) -> Cylinder | None:
    """The cylinder on whose surface the points lie, or None. `hull` is their convex hull."""
    points = points[:: -(-len(points) // MAX_POINTS) or 1]
    fits = (_least_absolute_distances(points, axis) for axis in _principal_axes(points, hull))
    fits = (c for c in fits if c is not None and hull.volume >= FILLED * c.volume)
    best = min(fits, key=lambda c: np.abs(c.distances(points)[0]).mean(), default=None)
    if best is None:
        return None
    distance, part = best.distances(points)
    for each in (-1, 0, 1):
        here = np.flatnonzero(part == each)
        if len(here) < MIN_POINTS:
            return None
        around = cKDTree(points[here]).query(points[here], min(NEIGHBOURS, len(here)))[1]
        smooth = np.abs(np.median(distance[here][around], 1)) / best.radius
        if any((smooth <= most).mean() < share for most, share in SHARES):
            return None
    return best


def _principal_axes(points: np.ndarray, hull: ConvexHull) -> np.ndarray:
    """Unit vectors (6, 3): principal directions of the points, and of the area-weighted normals of their hull."""
    corners = hull.points[hull.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1, keepdims=True)
    moments = [np.cov(points.T), normals.T @ (normals / np.maximum(area, 1e-30))]
    return np.concatenate([np.linalg.eigh(m)[1].T for m in moments])


def _least_absolute_distances(points: np.ndarray, axis: np.ndarray) -> Cylinder | None:
    """Minimise the mean absolute distance of the points from a cylinder, from this axis; None if it shrinks to nothing.

    By iteratively reweighted Gauss-Newton steps.
    """
    frame = np.concatenate([_across(axis), axis[None]])
    ends = np.stack([(points @ frame.T).min(0), (points @ frame.T).max(0)])
    half = np.diff(ends, axis=0)[0] / 2
    c = Cylinder(ends.mean(0) @ frame, axis, half[:2].mean(), 2 * half[2])
    for _ in range(MAX_STEPS):
        across = _across(c.axis)
        x = points - c.centre
        distance, part = c.distances(points)
        outward = (x @ across.T) @ across
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12 * c.radius)
        along, side = x @ c.axis, (part == 0)[:, None]
        # derivatives of the distances with respect to the centre, the axis (along `across`), radius and half height
        A = np.column_stack([
            -np.where(side, outward, part[:, None] * c.axis),
            np.where(side, -along[:, None] * (outward @ across.T), part[:, None] * (x @ across.T)),
            -1.0 * side, side - 1.0,
        ])  # fmt: skip
        weighted = A.T / np.maximum(np.abs(distance), CONVERGED * c.radius)
        step = np.linalg.lstsq(weighted @ A, -weighted @ distance)[0]
        turned = c.axis + step[3:5] @ across
        radius, height = c.radius + step[5], c.height + 2 * step[6]
        if radius <= 0 or height <= 0:
            return None
        c = Cylinder(c.centre + step[:3], turned / np.linalg.norm(turned), float(radius), float(height))
        if np.linalg.norm(np.concatenate([step[:3], radius * step[3:5], step[5:]])) <= CONVERGED * c.radius:
            break
    return c


def _across(axis: np.ndarray) -> np.ndarray:
    """Two unit vectors (2, 3) perpendicular to `axis` and to each other."""
    return np.linalg.svd(axis[None])[2][1:]
