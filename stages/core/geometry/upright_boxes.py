"""Size of an object from its upright bounding box, independent of the object's heading."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor


def longest_side(points: Float[Tensor, "n 3"]) -> float:
    """The longest side of the upright bounding box with minimum horizontal perimeter. Independent of the axes x and y.

    A side of this box contains a side of the convex hull of the points seen from above (Toussaint 1983, "Solving
    geometric problems with the rotating calipers").
    """
    x = points.detach().cpu().double().numpy()
    height = float(np.ptp(x[:, 2]))
    try:
        corners = x[ConvexHull(x[:, :2]).vertices, :2]
    except (QhullError, ValueError):  # collinear or too few points
        return max(height, float(np.linalg.norm(np.ptp(x[:, :2], axis=0))))
    along = np.roll(corners, -1, 0) - corners
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    sides = np.stack([np.ptp(corners @ u.T, axis=0) for u in (along, along[:, ::-1] * [-1, 1])])
    return max(height, float(sides[:, sides.sum(0).argmin()].max()))
