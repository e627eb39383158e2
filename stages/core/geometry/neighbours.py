"""Nearest neighbours."""

from math import inf

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor


class KDTree:
    """Points in a k-d tree, to be searched again and again on the CPU."""

    def __init__(self, points: Float[Tensor, "n d"]):
        if not len(points):
            raise ValueError("no points to search among")
        self.size, self.tree = len(points), cKDTree(points.detach().numpy())

    def query(
        self, points: Float[Tensor, "*b d"], k: int = 1, within: float = inf
    ) -> tuple[Float[Tensor, "*b k"], Int[Tensor, "*b k"]]:
        """Distances and indices of the k nearest, nearest first; where fewer lie `within`, inf and any index."""
        ranks = list(range(1, k + 1))  # a list keeps the last axis where k is 1
        distance, index = self.tree.query(points.detach().numpy(), ranks, distance_upper_bound=within, workers=-1)
        return torch.from_numpy(distance).to(points), torch.from_numpy(index).clamp_(max=self.size - 1)


class BruteForce:
    """Points compared with every query by matrix products: on a GPU a few thousand of them are faster so.

    Who is nearest is decided in float32 by |x|^2 - 2 q.x, so of two points whose squared distances differ by less than
    some 1e-6 of |x|^2 either may be taken, and points should lie around the origin; distances themselves are exact.
    """

    ENTRIES = 2**26  # of the products held at once, 256 MB

    def __init__(self, points: Float[Tensor, "n d"]):
        self.points = points
        self.table = torch.cat([-2 * points, points.square().sum(1, keepdim=True)], 1).float().mT.contiguous()

    def query(
        self, points: Float[Tensor, "*b d"], k: int = 1, within: float = inf
    ) -> tuple[Float[Tensor, "*b k"], Int[Tensor, "*b k"]]:
        """As `KDTree.query`."""
        flat, have = points.reshape(-1, points.shape[-1]), min(k, len(self.points))
        chunks = flat.split(max(1, self.ENTRIES // len(self.points)))
        index = torch.cat([self._nearest(chunk, have) for chunk in chunks])
        distance, order = (flat[:, None] - self.points[index]).norm(dim=2).sort(1)
        distance = torch.nn.functional.pad(distance.where(distance < within, inf), (0, k - have), value=inf)
        index = torch.nn.functional.pad(index.gather(1, order), (0, k - have))
        return distance.view(*points.shape[:-1], k), index.view(*points.shape[:-1], k)

    def _nearest(self, queries: Float[Tensor, "m d"], k: int) -> Int[Tensor, "m k"]:
        products = torch.nn.functional.pad(queries.float(), (0, 1), value=1.0) @ self.table
        return products.argmin(1, keepdim=True) if k == 1 else products.topk(k, largest=False).indices


def neighbour_index(points: Float[Tensor, "n d"]) -> KDTree | BruteForce:
    """A few thousand points, ready for many queries on the device where they are."""
    return BruteForce(points) if points.is_cuda else KDTree(points)


def knn(
    points: Float[Tensor, "n 3"], queries: Float[Tensor, "m 3"], k: int
) -> tuple[Float[Tensor, "m k"], Int[Tensor, "m k"]]:
    """Distances and indices of the k nearest points to each query, nearest first.

    With fewer than k points the last one is repeated, so the shape holds. A kd-tree on the CPU.
    """
    have = min(k, len(points))
    distance, index = (found.to(queries.device) for found in KDTree(points.cpu()).query(queries.cpu(), have))
    pad = torch.tensor([min(j, have - 1) for j in range(k)], device=queries.device)
    return distance[:, pad], index[:, pad]


def spacing(points: Float[Tensor, "n 3"], k: int = 3) -> Float[Tensor, "n"]:
    """Root mean square distance of each point to its k nearest others."""
    distance, _ = knn(points, points, k + 1)
    return distance[:, 1:].square().mean(1).sqrt()
