"""Fit a ball to the surface of an object, and decide whether the object is one.

The median distance of the surface points from the centre in each of 200 directions is compared with the radius. The
medians weight every part of the surface equally, whatever its sample density, and ignore stray points in front of or
behind it. The fit minimises the sum of absolute differences, so a dent or a lump does not shift it. Reconstruction
noise varies from one direction to the next, while the deviation of another shape does not. The median difference over
neighbouring directions, within 20 degrees, must therefore be small.

Photos of a ball on a table do not show the surface around the contact point; reconstructions have a skirt or a flat
face there. In scenes with cameras the surface is therefore compared on the upper three quarters, which include a belt
below the equator, and only roughly on the rest. A dome, or a ball on a foot, looks the same from above, but there the
fitted ball would reach into the surface on which the dome stands, or end above the foot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from stages.core.geometry.extremes import fibonacci
from stages.core.kernels.threads import small_operations

DIRECTIONS = fibonacci(200)
NEAREST = cKDTree(DIRECTIONS)
HIDDEN = -0.5  # vertical component of the directions below which photos do not show the surface
NEIGHBOURS = 7  # directions over which a median is taken: one and those around it
# Lengths are in radii. The limits were chosen on the reconstructions and exact shapes listed in
# stages/lab/results/physics.md.
# (largest difference from the radius, minimum fraction of directions within it): an icosahedron has up to .65 within
# .01, an egg of 1:1.1 up to .49; a pear .86 within .06
SHARES = ((0.01, 0.75), (0.06, 0.95))
DENT = 0.25  # largest distance of the surface inside the ball: a flat face where photos do not show the surface
SUNK = 0.1  # largest depth of the ball in the floor or another object, and height of its bottom above the lowest point
SKIRT = 2**0.5 - 1  # largest distance of the surface outside the ball: the edge of an upright cylinder below it
CONVERGED = 1e-4  # length of a step below which the fit has converged
MAX_STEPS = 20  # maximum number of steps of the fit; fits to balls take about five
MAX_POINTS = 4000  # maximum number of points used: 20 per direction


@dataclass(frozen=True)
class Ball:
    """A ball, in scene units."""

    centre: Float[np.ndarray, "3"]
    radius: float

    def clear_of(self, others: Float[np.ndarray, "m 3"]) -> bool:
        """Whether points inside other objects are outside the ball, or inside by at most SUNK."""
        nearest = np.linalg.norm(others - self.centre, axis=1).min(initial=np.inf)
        return bool(nearest >= (1 - SUNK) * self.radius)


@small_operations()
def fitted_ball(points: Float[np.ndarray, "n 3"], floor: float, all_seen: bool) -> Ball | None:
    """The ball on whose surface the points above height `floor` lie, or None.

    With `all_seen` every side of the surface is compared, not only the part that photos show.
    """
    points = points[points[:, 2] > floor]
    points = points[:: -(-len(points) // MAX_POINTS) or 1]
    seen = all_seen | (DIRECTIONS[:, 2] >= HIDDEN)
    ball = _least_absolute_differences(points, seen) if len(points) else None
    if ball is None:
        return None
    difference = _median_distances(points - ball.centre) / ball.radius - 1
    rough = difference[np.isfinite(difference)]
    around = cKDTree(DIRECTIONS[seen]).query(DIRECTIONS[seen], NEIGHBOURS)[1]
    smooth = np.median(difference[seen][around], 1)
    if any((np.abs(smooth) <= most).mean() < share for most, share in SHARES):
        return None
    if rough.min() < -DENT or rough.max() > SKIRT:
        return None
    slack, bottom = SUNK * ball.radius, ball.centre[2] - ball.radius
    return ball if bottom >= floor - slack and bottom <= points[:, 2].min() + slack else None


def _least_absolute_differences(points: np.ndarray, seen: np.ndarray) -> Ball | None:
    """The ball whose radius differs least from the median distances in the directions `seen` (d,), in absolute terms.

    Minimised by iteratively reweighted least squares. None if too many directions have no point.
    """
    centre, radius = (points.min(0) + points.max(0)) / 2, float(np.ptp(points, axis=0).max()) / 2
    for _ in range(MAX_STEPS):
        distance = _median_distances(points - centre)
        known = seen & np.isfinite(distance)
        if known.sum() < SHARES[0][1] * seen.sum():
            return None
        # to first order, the distance in direction u is radius + u . (error of the centre)
        A = np.column_stack([DIRECTIONS[known], np.ones(known.sum())])
        weighted = A.T / np.maximum(np.abs(distance[known] - radius), CONVERGED * radius)
        *step, radius = np.linalg.solve(weighted @ A, weighted @ distance[known])
        centre = centre + step
        if radius <= 0:
            return None
        if np.linalg.norm(step) <= CONVERGED * radius:
            break
    return Ball(centre, float(radius))


def _median_distances(x: np.ndarray) -> np.ndarray:
    """Median length (d,) of the vectors (n, 3) nearest to each of DIRECTIONS; infinite for directions without any."""
    length = np.linalg.norm(x, axis=1)
    row = NEAREST.query(x / np.maximum(length, 1e-12)[:, None])[1]
    order = np.lexsort((length, row))
    row, length = row[order], length[order]
    first = np.flatnonzero(np.diff(row, prepend=-1))
    count = np.diff(np.append(first, len(row)))
    out = np.full(len(DIRECTIONS), np.inf)
    out[row[first]] = (length[first + (count - 1) // 2] + length[first + count // 2]) / 2
    return out
