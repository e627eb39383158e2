"""Boundary refinement: relabel Gaussians near the boundaries of objects by colour, height and neighbouring labels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.perception.region_growing import cielab_colours
from stages.core.perception.support import Support
from stages.core.perception.visibility import summed_view_directions
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene

BOUNDARY_WIDTH = 0.015  # width of a boundary on either side, about 10 pixels of a photo [camera distance]
MIN_VISIBLE_WEIGHT = 0.5  # weight, summed over all photos, above which a Gaussian is visible [px of downscaled photos]
ROUNDS = 3  # in each round, a boundary may move by BOUNDARY_WIDTH
MEAN_FIELD_ITERATIONS = 8  # per round
COLOUR_SAMPLES = 24  # nearest Gaussians from which a label's local colour distribution is estimated
NEIGHBOURS = 8  # nearest neighbours that the smoothness term connects
MIN_BOUNDARY_NEIGHBOURS = 5  # Gaussians of another label that form a boundary; fewer are strays
COLOUR_SIGMA = 8.0  # standard deviation of the colour likelihood [CIELAB]
MIN_COLOUR_LIKELIHOOD = 0.02  # likelihood of a colour that no nearby Gaussian of the label has
HEIGHT_RESOLUTION = 0.0045  # smallest height that photos distinguish from the table [camera distance]
TABLE_HEIGHT_SIGMA = 3.0  # standard deviation of the height of the table next to objects [HEIGHT_RESOLUTION]
OBJECT_HEIGHT_SIGMA = 0.5  # standard deviation of an object's Gaussians below HEIGHT_RESOLUTION [HEIGHT_RESOLUTION]
TABLE_COLOUR_SAMPLES = 400  # Gaussians from which the global colour distribution of the table is estimated
SMOOTHNESS = 3.0  # weight of all neighbours of the same colour together, relative to the unary cost
MIN_SMOOTHNESS = 0.1  # added to the colour similarity of a neighbour
CORE_QUANTILE = 0.67  # quantile of the distance to the boundary above which a thin object's colours are trusted
FORBIDDEN = 1e3  # cost of an excluded label


@dataclass(frozen=True)
class BoundaryRegion:
    """The Gaussians of the objects and of the table around them."""

    points: Float[Tensor, "m 3"]
    lab: Float[Tensor, "m 3"]  # colours, CIELAB
    ids: Int[Tensor, "m"]  # current labels; 0: the table
    heights: Float[Tensor, "m"]  # above the table [HEIGHT_RESOLUTION]
    even: Bool[Tensor, "m"]  # whether the height is within the tolerance of the support
    gap: Float[Tensor, "m"]  # distance to the nearest boundary [BOUNDARY_WIDTH]
    margin: float  # BOUNDARY_WIDTH [scene units]

    @classmethod
    def of(cls, g: Gaussians, lab: Float[Tensor, "n 3"], support: Support) -> BoundaryRegion:
        """The region of the Gaussians `g`, which must all be near objects."""
        heights = support.heights(g.means)
        margin, level = BOUNDARY_WIDTH * support.view.radius, HEIGHT_RESOLUTION * support.view.radius
        even = heights.abs() < support.tolerance
        return cls(g.means, lab, g.object_id, heights / level, even, _gap(g.means, g.object_id) / margin, margin)


def refine_boundaries(scene: Scene, support: Support) -> Gaussians:
    """Relabel the Gaussians near a boundary, or low enough to be table, as object or as table.

    Next to objects, a reconstruction lifts parts of the table, which grouping then assigns to the object, or the other
    way round. Labels away from boundaries are kept, and provide the colour distributions of object and table. Gaussians
    that no photo shows keep their labels, and no Gaussian changes from one object to another. Without cameras nothing
    changes.

    The labels minimise the energy of a conditional random field over nearest neighbours by mean-field inference
    (Kraehenbuehl and Koltun 2011, "Efficient inference in fully connected CRFs", eq. 4-6). The colour distributions are
    re-estimated in each round from the labels of the previous one (Rother, Kolmogorov and Blake 2004, "GrabCut").
    """
    g = scene.gaussians
    if scene.cameras is None or not len(scene.cameras):
        return g
    lab, ids = cielab_colours(g), g.object_id.clone()
    seen = summed_view_directions(g, scene.cameras).norm(dim=1) > MIN_VISIBLE_WEIGHT
    for _ in range(ROUNDS):
        index = _around(g.means, ids, 3 * BOUNDARY_WIDTH * support.view.radius)
        if not bool((ids[index] > 0).any()) or not bool((ids[index] == 0).any()):
            break
        near = BoundaryRegion.of(replace(g[index], object_id=ids[index]), lab[index], support)
        low = (near.ids > 0) & (near.heights < 1)
        border = torch.nonzero(((near.gap < 1) | low) & seen[index])[:, 0]
        ids[index[border]] = _mean_field(near, border, low)
    return replace(g, object_id=ids)


def _around(means: Float[Tensor, "n 3"], ids: Int[Tensor, "n"], radius: float) -> Int[Tensor, "m"]:
    """Indices of the Gaussians of objects, or within `radius` of one [scene units]."""
    finite = means.isfinite().all(1)
    out = (ids > 0) & finite
    taken = means[out]
    if len(taken):
        box = ((means > taken.amin(0) - radius) & (means < taken.amax(0) + radius)).all(1)
        free = torch.nonzero(box & finite & ~out)[:, 0]
        out[free[knn(taken, means[free], 1)[0][:, 0] < radius]] = True
    return torch.nonzero(out)[:, 0]


def _gap(points: Float[Tensor, "m 3"], ids: Int[Tensor, "m"]) -> Float[Tensor, "m"]:
    """Distance from each Gaussian to the MIN_BOUNDARY_NEIGHBOURS-th nearest Gaussian with another label."""
    gap = torch.full((len(points),), torch.inf)
    for label in ids.unique().tolist():
        own = ids == label
        others = points[~own]
        if len(others):
            gap[own] = knn(others, points[own], MIN_BOUNDARY_NEIGHBOURS)[0][:, -1]
    return gap


def _mean_field(near: BoundaryRegion, border: Int[Tensor, "b"], low: Bool[Tensor, "m"]) -> Int[Tensor, "b"]:
    """The most probable label of each boundary Gaussian, by mean-field inference."""
    labels, before = near.ids.unique(), near.ids[border]
    cost = torch.stack([_cost(near, border, label) for label in labels.tolist()], 1)
    taken = (before[:, None] > 0) & (labels > 0) & (labels != before[:, None])
    cost = cost.masked_fill(taken, FORBIDDEN)
    start = torch.searchsorted(labels, near.ids)
    start[border] = torch.where(low[border], cost.argmin(1), start[border])
    belief = torch.nn.functional.one_hot(start, len(labels)).float()
    index = knn(near.points, near.points[border], NEIGHBOURS + 1)[1][:, 1:]
    weight = SMOOTHNESS * (_similarity(near.lab[border], near.lab[index]) + MIN_SMOOTHNESS) / NEIGHBOURS
    for _ in range(MEAN_FIELD_ITERATIONS):
        belief[border] = torch.softmax((weight[..., None] * belief[index]).sum(1) - cost, 1)
    return labels[belief[border].argmax(1)]


def _cost(near: BoundaryRegion, border: Int[Tensor, "b"], label: int) -> Float[Tensor, "b"]:
    """Unary cost of a label for each boundary Gaussian: the negative log likelihood of its height and colour."""
    own, h = near.ids == label, near.heights[border]
    if label == 0:
        height, certain = 0.5 * (h.clamp_min(0) / TABLE_HEIGHT_SIGMA) ** 2, own & (near.gap > 1) & near.even
    else:
        own = own & (near.heights >= 1)
        height, certain = 0.5 * ((h - 1).clamp_max(0) / OBJECT_HEIGHT_SIGMA) ** 2, own
        if own.any():  # a thin object may lie entirely within BOUNDARY_WIDTH of a boundary
            certain = own & (near.gap > min(1.0, float(near.gap[own].quantile(CORE_QUANTILE))))
    core = torch.nonzero(certain)[:, 0]
    if not len(core):
        return torch.full((len(border),), FORBIDDEN)
    distance, index = knn(near.points[core], near.points[border], COLOUR_SAMPLES)
    likelihood = _similarity(near.lab[border], near.lab[core[index]]).mean(1)
    if label == 0:  # the nearest reliable table may differ in colour from the table next to the object
        samples = near.lab[core[:: max(1, len(core) // TABLE_COLOUR_SAMPLES)]]
        likelihood = torch.maximum(likelihood, _similarity(near.lab[border], samples[None]).mean(1))
    cost = height - (likelihood + MIN_COLOUR_LIKELIHOOD).log()
    return cost if label == 0 else torch.where(distance[:, 0] < 4 * near.margin, cost, FORBIDDEN)


def _similarity(a: Float[Tensor, "b 3"], b: Float[Tensor, "c k 3"]) -> Float[Tensor, "b k"]:
    """Similarity of colours by a Gaussian kernel; 1 if equal."""
    return (-0.5 * ((a[:, None] - b).norm(dim=2) / COLOUR_SIGMA) ** 2).exp()
