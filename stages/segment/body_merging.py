"""Parts that are one body although their colours differ: they hold each other, or one hangs from the other."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError, cKDTree
from torch import Tensor

from stages.core.perception.support import Support
from stages.core.scene.gaussians import Gaussians

CELL = 0.01  # that positions are thinned to [view radii]
TOUCH = 2.0  # cells between parts that touch
HELD = 0.05  # share of each part within the convex hull of the other from which neither came there alone
FIRM = 0.05  # share of the smaller part that touches the larger, at least
RESTS = 4.0  # what begins higher than this does not stand on the table [tolerances]
BENEATH = 0.25  # share of a part that lies lower than where it would lie on another


@dataclass(frozen=True)
class ObjectPart:
    """One object found so far, thinned."""

    points: np.ndarray  # (p, 3) one a cell
    heights: np.ndarray  # (p,) above the table [tolerances]
    planes: np.ndarray | None  # (f, 4) outward planes of its convex hull; None for what is flat

    @classmethod
    def of(cls, means: Float[Tensor, "n 3"], support: Support) -> ObjectPart:
        side = CELL * support.view.radius
        _, first = np.unique((means / side).floor().numpy(), axis=0, return_index=True)
        thin = means[first]
        points = thin.double().numpy()
        try:
            planes = ConvexHull(points).equations
        except (QhullError, ValueError):
            planes = None
        return cls(points, (support.heights(thin) / support.tolerance).numpy(), planes)

    def inside(self, other: ObjectPart, margin: float) -> float:
        """Share of this part that lies deeper than `margin` in the convex hull of another."""
        if other.planes is None:
            return 0.0
        depth = -(self.points @ other.planes[:, :3].T + other.planes[:, 3]).max(1)
        return float((depth > margin).mean())


def merge_bodies(g: Gaussians, support: Support) -> Gaussians:
    """The same Gaussians, with the objects that are parts of one body under the number of the largest.

    Two bodies pushed together do not enter each other's convex hull both at once (a spoon enters that of its cup,
    but the cup not that of the spoon), limbs and the trunk they embrace do. And a part that reaches no table and
    does not lie on top of another is fixed to what it touches.
    """
    ids = g.object_id.clone()
    finite = g.means.isfinite().all(1)
    parts = {
        n: ObjectPart.of(g.means[(ids == n) & finite], support) for n in ids[finite].unique().tolist() if n > 0
    }  # fmt: skip
    while (pair := _one_body(parts, CELL * support.view.radius)) is not None:
        kept, gone = sorted(pair, key=lambda n: (-len(parts[n].points), n))
        ids[ids == gone] = kept
        parts[kept] = ObjectPart.of(g.means[(ids == kept) & finite], support)
        del parts[gone]
    return replace(g, object_id=ids)


def _one_body(parts: dict[int, ObjectPart], side: float) -> tuple[int, int] | None:
    """Two parts that belong to one body: first those that hold each other, then the firmest that hangs."""
    trees = {n: cKDTree(part.points) for n, part in parts.items()}
    hanging: list[tuple[float, int, int]] = []
    for a, part in parts.items():
        for b, other in parts.items():
            if a == b:
                continue
            touching = trees[b].query(part.points, distance_upper_bound=TOUCH * side)[0] < np.inf
            if not touching.any():
                continue
            firm = touching.sum() / min(len(part.points), len(other.points))
            both = min(part.inside(other, 0.25 * side), other.inside(part, 0.25 * side))
            if firm > FIRM and both > HELD:
                return a, b
            low = np.median(part.heights[touching])
            if np.percentile(part.heights, 2) > RESTS and (part.heights < low).mean() > BENEATH:
                hanging.append((float(firm), a, b))
    return max(hanging)[1:] if hanging else None
