"""Borders of objects, redrawn: who a Gaussian near one belongs to, by colour, height and what its neighbours say."""

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

BOUNDARY_WIDTH = 0.015  # width of a border to either side, about ten pixels of a photo [view radii]
MIN_VISIBLE_WEIGHT = 0.5  # weight in all photos together from which a Gaussian shows [px of small photos]
ROUNDS = 3  # a border may move by a margin in each
SWEEPS = 8  # of mean field in each round
SAMPLES = 24  # nearest Gaussians whose colours say how an object, or the table, looks here
NEIGHBOURS = 8
STRAYS = 5  # Gaussians of another label that make no border yet
SHADE = 8.0  # colours this far apart are still alike [CIELAB]
FLOOR = 0.02  # likelihood of a colour that nothing near has
HEIGHT_RESOLUTION = 0.0045  # height that photos tell from the table [view radii]
BUMP = 3.0  # height of what photos make of a bare table beside things, one deviation [levels]
SINK = 0.5  # an object's Gaussian this much lower than it can be told from the table is one deviation off [levels]
BROAD = 400  # Gaussians that show all colours of the table around the objects
BOND = 3.0  # weight of what eight neighbours of one's own colour say, against one's own colour and height
STRANGER = 0.1  # of a neighbour of another colour, as a share of that
CORE = 0.67  # quantile of the depth in an object beyond which a thin one shows how it looks
NEVER = 1e3  # cost of a label that is out of the question


@dataclass(frozen=True)
class BoundaryRegion:
    """The Gaussians of the objects and of the table around them."""

    points: Float[Tensor, "m 3"]
    lab: Float[Tensor, "m 3"]  # colours, CIELAB
    ids: Int[Tensor, "m"]  # labels so far, 0 the table
    heights: Float[Tensor, "m"]  # above the table [levels]
    even: Bool[Tensor, "m"]  # no farther from the surface of the table than its Gaussians are
    gap: Float[Tensor, "m"]  # distance to the nearest of another label, but for strays [margins]
    margin: float  # [scene units]

    @classmethod
    def of(cls, g: Gaussians, lab: Float[Tensor, "n 3"], support: Support) -> BoundaryRegion:
        """Of Gaussians that are all near objects."""
        heights = support.heights(g.means)
        margin, level = BOUNDARY_WIDTH * support.view.radius, HEIGHT_RESOLUTION * support.view.radius
        even = heights.abs() < support.tolerance
        return cls(g.means, lab, g.object_id, heights / level, even, _gap(g.means, g.object_id) / margin, margin)


def refine_boundaries(scene: Scene, support: Support) -> Gaussians:
    """The Gaussians with those at a border, and those low enough to be table, given anew to an object or the table.

    At a border a reconstruction lifts some of the table and grouping gives it to the object, or gives the table
    some of the object. Away from borders labels are believed: there objects and table show how they look. What
    no photo shows stays as it is, and nothing goes from one object to another.

    The labels of a conditional random field over nearest neighbours, by mean field, as in Kraehenbuehl and Koltun
    2011, "Efficient inference in fully connected CRFs", eq. 4-6; the rounds, in each of which colours are learned
    from the last one's labels, are those of Rother, Kolmogorov and Blake 2004, "GrabCut".
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
        ids[index[border]] = _settled(near, border, low)
    return replace(g, object_id=ids)


def _around(means: Float[Tensor, "n 3"], ids: Int[Tensor, "n"], reach: float) -> Int[Tensor, "m"]:
    """Which Gaussians are an object's, or within `reach` of one."""
    finite = means.isfinite().all(1)
    out = (ids > 0) & finite
    taken = means[out]
    if len(taken):
        box = ((means > taken.amin(0) - reach) & (means < taken.amax(0) + reach)).all(1)
        free = torch.nonzero(box & finite & ~out)[:, 0]
        out[free[knn(taken, means[free], 1)[0][:, 0] < reach]] = True
    return torch.nonzero(out)[:, 0]


def _gap(points: Float[Tensor, "m 3"], ids: Int[Tensor, "m"]) -> Float[Tensor, "m"]:
    """Distance from each Gaussian to the nearest of another label, after a few strays."""
    gap = torch.full((len(points),), torch.inf)
    for label in ids.unique().tolist():
        own = ids == label
        others = points[~own]
        if len(others):
            gap[own] = knn(others, points[own], STRAYS)[0][:, -1]
    return gap


def _settled(near: BoundaryRegion, border: Int[Tensor, "b"], low: Bool[Tensor, "m"]) -> Int[Tensor, "b"]:
    """The likeliest label of each Gaussian of the border, when neighbours of like colour tend to agree."""
    labels, before = near.ids.unique(), near.ids[border]
    cost = torch.stack([_cost(near, border, label) for label in labels.tolist()], 1)
    taken = (before[:, None] > 0) & (labels > 0) & (labels != before[:, None])
    cost = cost.masked_fill(taken, NEVER)
    start = torch.searchsorted(labels, near.ids)
    start[border] = torch.where(low[border], cost.argmin(1), start[border])
    belief = torch.nn.functional.one_hot(start, len(labels)).float()
    index = knn(near.points, near.points[border], NEIGHBOURS + 1)[1][:, 1:]
    weight = BOND * (_alike(near.lab[border], near.lab[index]) + STRANGER) / NEIGHBOURS
    for _ in range(SWEEPS):
        belief[border] = torch.softmax((weight[..., None] * belief[index]).sum(1) - cost, 1)
    return labels[belief[border].argmax(1)]


def _cost(near: BoundaryRegion, border: Int[Tensor, "b"], label: int) -> Float[Tensor, "b"]:
    """How little a label fits each Gaussian of the border: minus the logarithm of its likelihood."""
    own, h = near.ids == label, near.heights[border]
    if label == 0:
        height, sure = 0.5 * (h.clamp_min(0) / BUMP) ** 2, own & (near.gap > 1) & near.even
    else:
        own = own & (near.heights >= 1)
        height, sure = 0.5 * ((h - 1).clamp_max(0) / SINK) ** 2, own
        if own.any():  # of what is thin all is near a border
            sure = own & (near.gap > min(1.0, float(near.gap[own].quantile(CORE))))
    shown = torch.nonzero(sure)[:, 0]
    if not len(shown):
        return torch.full((len(border),), NEVER)
    distance, index = knn(near.points[shown], near.points[border], SAMPLES)
    alike = _alike(near.lab[border], near.lab[shown[index]]).mean(1)
    if label == 0:  # a patch of the table may begin at the object, and be sure elsewhere only
        broad = near.lab[shown[:: max(1, len(shown) // BROAD)]]
        alike = torch.maximum(alike, _alike(near.lab[border], broad[None]).mean(1))
    cost = height - (alike + FLOOR).log()
    return cost if label == 0 else torch.where(distance[:, 0] < 4 * near.margin, cost, NEVER)


def _alike(a: Float[Tensor, "b 3"], b: Float[Tensor, "c k 3"]) -> Float[Tensor, "b k"]:
    """Likeness of colours, 1 where equal."""
    return (-0.5 * ((a[:, None] - b).norm(dim=2) / SHADE) ** 2).exp()
