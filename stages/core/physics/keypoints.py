"""Choose the keypoints that carry the motion of the objects, and bind Gaussians to them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.kernels.threads import parallel_map
from stages.core.physics.particles import connected, usable
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Binding, Keypoints

KEYPOINTS_PER_GAUSSIAN = 8  # keypoints that each Gaussian follows
MAX_CANDIDATES = 30_000  # Gaussians of an object among which keypoints are chosen
EQUALLY_FAR = 0.9999  # ratio of two squared distances above which they count as equal
PULL_MARGIN = 0.15  # distance from the walls within which a user cannot pull objects [extent of all objects]


def farthest_points(points: Float[Tensor, "n 3"], count: int, seed: int = 0) -> Int[Tensor, "k"]:
    """Farthest-point sampling: indices of min(count, n) points, starting from a random one.

    Of equally far points the first is taken, so that rounding does not decide. The covering radius is within a factor
    of two of the smallest possible. Source: Gonzalez 1985, "Clustering to minimize the maximum intercluster distance".
    """
    count, xyz = min(count, len(points)), np.ascontiguousarray(points.detach().cpu().numpy().T)
    chosen = np.empty(count, np.int64)
    if not count:
        return torch.from_numpy(chosen)
    distance = np.full(xyz.shape[1], np.inf, xyz.dtype)
    offset, square, far = np.empty_like(xyz), np.empty_like(distance), np.empty(xyz.shape[1], bool)
    at = int(torch.randint(xyz.shape[1], (1,), generator=torch.Generator().manual_seed(seed)))
    for i in range(count):  # in place, because call overhead dominates for most objects
        chosen[i] = at
        np.subtract(xyz, xyz[:, at, None], out=offset)
        np.square(offset, out=offset)
        np.add(offset[0], offset[1], out=square)
        np.add(square, offset[2], out=square)
        farthest = np.minimum(distance, square, out=distance).max()
        at = int(np.greater_equal(distance, EQUALLY_FAR * farthest, out=far).argmax())
    return torch.from_numpy(chosen)


def choose_keypoints(scene: Scene, count: int, seed: int = 0) -> Keypoints:
    """At most `count` keypoints per object, by farthest-point sampling of its usable Gaussians without outliers.

    Outliers and unusable Gaussians are kept if otherwise only a single point would be left. Objects without Gaussians
    get no keypoints.
    """
    g = scene.gaussians.to("cpu")
    good = usable(g)

    def pick(id: int) -> Float[Tensor, "k 3"]:
        mine = g.object_id == id
        means = g.means[mine & good]
        if _is_point(means):
            means = g.means[mine & g.means.isfinite().all(1)]
        if not len(means):
            return means
        body = means[connected(means)]
        means = means if _is_point(body) else body
        if len(means) > MAX_CANDIDATES:
            order = torch.randperm(len(means), generator=torch.Generator().manual_seed(seed))
            means = means[order[:MAX_CANDIDATES]]
        return means[farthest_points(means, count, seed)].unique(dim=0)

    picked = parallel_map(pick, [o.id for o in scene.objects])
    ids = [torch.full((len(rest),), o.id) for o, rest in zip(scene.objects, picked, strict=True)]
    return Keypoints(torch.cat([torch.zeros(0, 3), *picked]), torch.cat([torch.zeros(0, dtype=torch.int64), *ids]))


def _is_point(means: Float[Tensor, "k 3"]) -> bool:
    """Whether the points have no extent (all equal, or none), so that they determine neither size nor rotation."""
    return not bool((means != means[:1]).any())


def bind_gaussians(scene: Scene, keypoints: Keypoints) -> Binding:
    """Bind each Gaussian of an object to the 8 nearest keypoints of that object; the background is not bound."""
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
    """Indices of the k nearest points of each query, and weights that sum to one.

    The weights are (1 - (d / r)^2)^2 with r the distance to the (k+1)-th neighbour, so they are continuous where the
    set of neighbours changes. With fewer than k points, the surplus columns have weight 0.
    """
    distance, index = knn(points, queries, k + 1)
    have = min(k, len(points))
    radius = distance[:, -1:] if len(points) > k else 1.5 * distance[:, have - 1 : have]
    weight = (1 - (distance[:, :k] / radius.clamp_min(1e-30)).square()).clamp_min(0).square()
    weight[:, have:] = 0  # surplus columns repeat the last point
    weight = torch.where(weight.sum(1, keepdim=True) > 0, weight, (torch.arange(k) < have).to(weight).expand_as(weight))
    return index[:, :k], weight / weight.sum(1, keepdim=True)


def pull_range(keypoints: Keypoints, low: Sequence[float], high: Sequence[float]) -> tuple[tuple, tuple]:
    """Lower and upper corner of the region within which a user can pull objects, inside the walls `low` and `high`.

    All in scene units.
    """
    rest = keypoints.rest
    margin = PULL_MARGIN * float((rest.amax(0) - rest.amin(0)).max())
    return tuple(a + margin for a in low), tuple(b - margin for b in high)
