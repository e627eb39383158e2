"""Whether the surface of an object is that of a ball, and which one.

The median distance from the centre in each of 200 directions is compared with the radius. Unlike points, medians of
directions count every part of the surface alike, whatever the density of its samples, and ignore what is loose before
or behind it. The fit minimises the sum of their absolute differences, so that a dent or a lump does not move it. The
noise of a reconstruction differs from one direction to the next, the shape of another object does not: so the median
difference of neighbouring directions, within 20 degrees, has to be small.

Photos of a ball on a table do not show the surface around the point where it rests: reconstructions have a skirt or a
flat face there. In scenes with cameras the surface is therefore compared on the upper three quarters, which include a
belt below the equator, and needs to be only roughly there on the rest. A dome or a ball on a foot looks the same from
above; but the ball would then reach into what the dome stands on, or end above the foot.
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
NEIGHBOURS = 7  # a direction and those around it
# Lengths are in radii, and were chosen on reconstructions and exact shapes that stages/lab/results/physics.md lists.
SHARES = ((0.01, 0.75), (0.06, 0.95))  # a difference, and the least share of directions in which it is not larger:
# an icosahedron has up to .65 within .01, an egg of 1:1.1 up to .49; a pear .86 within .06
DENT = 0.25  # most by which a distance may be smaller: a flat face where photos do not show the surface
SUNK = 0.1  # most by which a ball may reach into the floor or another object, or end above the surface's lowest point
SKIRT = 2**0.5 - 1  # most by which a distance may be larger: the edge of the upright cylinder between ball and table
CONVERGED = 1e-4  # length of the last step of the fit
MAX_STEPS = 20  # of the fit; those to balls take about five
MAX_POINTS = 4000  # that are looked at: 20 in each direction


@dataclass(frozen=True)
class Ball:
    """A ball, in scene units."""

    centre: Float[np.ndarray, "3"]
    radius: float

    def clear_of(self, others: Float[np.ndarray, "m 3"]) -> bool:
        """Whether points inside other objects are outside, but for SUNK."""
        nearest = np.linalg.norm(others - self.centre, axis=1).min(initial=np.inf)
        return bool(nearest >= (1 - SUNK) * self.radius)


@small_operations()
def fitted_ball(points: Float[np.ndarray, "n 3"], floor: float, all_seen: bool) -> Ball | None:
    """The ball on whose surface those points lie that are above a floor; None where there is none.

    With `all_seen` every side of the surface is compared.
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
    """The ball from whose radius the median distances in the directions `seen` (d,) differ least; None where too many
    directions have no point. By iteratively reweighted least squares.
    """
    centre, radius = (points.min(0) + points.max(0)) / 2, float(np.ptp(points, axis=0).max()) / 2
    for _ in range(MAX_STEPS):
        distance = _median_distances(points - centre)
        known = seen & np.isfinite(distance)
        if known.sum() < SHARES[0][1] * seen.sum():
            return None
        # to first order the distance in a direction u is radius + u . (error of the centre)
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
    """Median length (d,) of the vectors (n, 3) nearest to each of DIRECTIONS; infinite where there is none."""
    length = np.linalg.norm(x, axis=1)
    row = NEAREST.query(x / np.maximum(length, 1e-12)[:, None])[1]
    order = np.lexsort((length, row))
    row, length = row[order], length[order]
    first = np.flatnonzero(np.diff(row, prepend=-1))
    count = np.diff(np.append(first, len(row)))
    out = np.full(len(DIRECTIONS), np.inf)
    out[row[first]] = (length[first + (count - 1) // 2] + length[first + count // 2]) / 2
    return out
