"""Merge objects that are parts of one body: their convex hulls interlock, or one is suspended from the other."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError, cKDTree
from torch import Tensor

from stages.core.perception.support import Support
from stages.core.scene.gaussians import Gaussians

CELL_SIZE = 0.01  # side of the grid cells to which positions are thinned [camera distance]
MAX_CONTACT_DISTANCE = 2.0  # largest distance between touching points of two parts [cells]
MIN_MUTUAL_OVERLAP = 0.05  # minimum fraction of each of two interlocking parts inside the convex hull of the other
MIN_CONTACT_FRACTION = 0.05  # minimum number of touching points of interlocking parts [fraction of the smaller part]
MAX_STANDING_HEIGHT = 4.0  # height of its lowest points up to which a part stands on the table [support tolerances]
MIN_BELOW_FRACTION = 0.25  # minimum fraction of a suspended part below its contact with another part


@dataclass(frozen=True)
class ObjectPart:
    """A labelled object, thinned to one point per cell."""

    points: np.ndarray  # (p, 3) one per cell
    heights: np.ndarray  # (p,) above the table [support tolerances]
    planes: np.ndarray | None  # (f, 4) outward planes of its convex hull; None without volume

    @classmethod
    def of(cls, means: Float[Tensor, "n 3"], support: Support) -> ObjectPart:
        """The part with Gaussians at these means, which must be finite."""
        side = CELL_SIZE * support.view.radius
        _, first = np.unique((means / side).floor().numpy(), axis=0, return_index=True)
        thin = means[first]
        points = thin.double().numpy()
        try:
            planes = ConvexHull(points).equations
        except (QhullError, ValueError):
            planes = None
        return cls(points, (support.heights(thin) / support.tolerance).numpy(), planes)

    def inside(self, other: ObjectPart, margin: float) -> float:
        """Fraction of this part deeper than `margin` [scene units] inside the convex hull of another."""
        if other.planes is None:
            return 0.0
        depth = -(self.points @ other.planes[:, :3].T + other.planes[:, 3]).max(1)
        return float((depth > margin).mean())


def merge_bodies(g: Gaussians, support: Support) -> Gaussians:
    """The Gaussians, with objects that are parts of one body relabelled as the largest of them.

    Criterion 1: each of two parts has points inside the convex hull of the other, like limbs and the trunk they
    embrace. Separate bodies do not: a spoon enters the hull of its cup, but the cup does not enter the hull of the
    spoon. Criterion 2: a part that neither extends to the table nor lies on top of another belongs to the part it
    touches.
    """
    ids = g.object_id.clone()
    finite = g.means.isfinite().all(1)
    parts = {
        n: ObjectPart.of(g.means[(ids == n) & finite], support) for n in ids[finite].unique().tolist() if n > 0
    }  # fmt: skip
    while (pair := _next_pair(parts, CELL_SIZE * support.view.radius)) is not None:
        kept, removed = sorted(pair, key=lambda n: (-len(parts[n].points), n))
        ids[ids == removed] = kept
        parts[kept] = ObjectPart.of(g.means[(ids == kept) & finite], support)
        del parts[removed]
    return replace(g, object_id=ids)


def _next_pair(parts: dict[int, ObjectPart], side: float) -> tuple[int, int] | None:
    """The next two parts to merge: interlocking parts first, then the suspended part with the largest contact."""
    trees = {n: cKDTree(part.points) for n, part in parts.items()}
    suspended: list[tuple[float, int, int]] = []
    for a, part in parts.items():
        for b, other in parts.items():
            if a == b:
                continue
            touching = trees[b].query(part.points, distance_upper_bound=MAX_CONTACT_DISTANCE * side)[0] < np.inf
            if not touching.any():
                continue
            contact = touching.sum() / min(len(part.points), len(other.points))
            both = min(part.inside(other, 0.25 * side), other.inside(part, 0.25 * side))
            if contact > MIN_CONTACT_FRACTION and both > MIN_MUTUAL_OVERLAP:
                return a, b
            low = np.median(part.heights[touching])
            if (
                np.percentile(part.heights, 2) > MAX_STANDING_HEIGHT
                and (part.heights < low).mean() > MIN_BELOW_FRACTION
            ):
                suspended.append((float(contact), a, b))
    return max(suspended)[1:] if suspended else None
