"""Keypoints: points on the objects that carry their motion, and which of them each Gaussian follows."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.physics.particles import inliers, usable
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Binding, Keypoints

KEYPOINTS_PER_GAUSSIAN = 8  # keypoints that a Gaussian follows
CANDIDATES = 30_000  # Gaussians among which keypoints are chosen


def farthest_points(points: Float[Tensor, "n 3"], count: int, seed: int = 0) -> Int[Tensor, "k"]:
    """Indices of min(count, n) points, each the farthest from those before it, from a random start.

    Source: Gonzalez 1985, "Clustering to minimize the maximum intercluster distance": within a factor of two of the
    smallest possible radius of cover.
    """
    count = min(count, len(points))
    chosen = torch.empty(count, dtype=torch.int64)
    if not count:
        return chosen
    xyz = points.detach().cpu().T.contiguous()
    distance = torch.full((xyz.shape[1],), torch.inf, dtype=xyz.dtype)
    at = int(torch.randint(xyz.shape[1], (1,), generator=torch.Generator().manual_seed(seed)))
    for i in range(count):
        chosen[i] = at
        torch.minimum(distance, (xyz - xyz[:, at, None]).square_().sum(0), out=distance)
        at = int(distance.argmax())
    return chosen


def choose_keypoints(scene: Scene, count: int, seed: int = 0) -> Keypoints:
    """At most `count` keypoints an object, among its usable Gaussians without outliers; an empty object has none."""
    g = scene.gaussians.to("cpu")
    fine = usable(g)
    rest, ids = [], []
    for o in scene.objects:
        mine = g.object_id == o.id
        means = g.means[mine & fine] if bool((mine & fine).any()) else g.means[mine & g.means.isfinite().all(1)]
        if not len(means):
            continue
        means = means[inliers(means)]
        if len(means) > CANDIDATES:
            order = torch.randperm(len(means), generator=torch.Generator().manual_seed(seed))
            means = means[order[:CANDIDATES]]
        picked = means[farthest_points(means, count, seed)].unique(dim=0)
        rest.append(picked)
        ids.append(torch.full((len(picked),), o.id))
    if not rest:
        return Keypoints(torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64))
    return Keypoints(torch.cat(rest), torch.cat(ids))


def bind_gaussians(scene: Scene, keypoints: Keypoints) -> Binding:
    """Each Gaussian of an object follows its 8 nearest keypoints of that object; the background follows none."""
    g = scene.gaussians.to("cpu")
    index = torch.full((len(g), KEYPOINTS_PER_GAUSSIAN), -1, dtype=torch.int64)
    weight = torch.zeros(len(g), KEYPOINTS_PER_GAUSSIAN)
    placed = g.means.isfinite().all(1)
    for id in keypoints.object_id.unique():
        mine = ((g.object_id == id) & placed).nonzero()[:, 0]
        own = (keypoints.object_id == id).nonzero()[:, 0]
        if len(mine):
            near, weight[mine] = nearest_weights(keypoints.rest[own], g.means[mine], KEYPOINTS_PER_GAUSSIAN)
            index[mine] = own[near]
    return Binding(index, weight)


def nearest_weights(
    points: Float[Tensor, "n 3"], queries: Float[Tensor, "m 3"], k: int
) -> tuple[Int[Tensor, "m k"], Float[Tensor, "m k"]]:
    """The k nearest points of each query and weights that sum to one.

    (1 - (d / r)^2)^2 with r the distance to the next neighbour, so a point fades out before another takes its place.
    """
    distance, index = knn(points, queries, k + 1)
    have = min(k, len(points))
    reach = distance[:, -1:] if len(points) > k else 1.5 * distance[:, have - 1 : have]
    weight = (1 - (distance[:, :k] / reach.clamp_min(1e-30)).square()).clamp_min(0).square()
    weight[:, have:] = 0  # repeats
    weight = torch.where(weight.sum(1, keepdim=True) > 0, weight, (torch.arange(k) < have).to(weight).expand_as(weight))
    return index[:, :k], weight / weight.sum(1, keepdim=True)
