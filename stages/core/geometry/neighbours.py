"""Nearest-neighbour search."""

from math import inf

import torch
from jaxtyping import Float, Int
from torch import Tensor

QUERIES_PER_THREAD = 500  # fewer queries take less time than starting a thread


class KDTree:
    """k-d tree on the CPU, for repeated queries. Cells are split in the middle: balancing doubles the build time."""

    def __init__(self, points: Float[Tensor, "n d"]):
        from scipy.spatial import cKDTree  # takes 0.2 s to import, and many runs do not need it

        if not len(points):
            raise ValueError("the tree needs at least one point")
        self.size = len(points)
        self.tree = cKDTree(points.detach().numpy(), balanced_tree=False, compact_nodes=False)

    def query(
        self, points: Float[Tensor, "*b d"], k: int = 1, within: float = inf
    ) -> tuple[Float[Tensor, "*b k"], Int[Tensor, "*b k"]]:
        """Distances and indices of the k nearest points, nearest first; beyond `within` the distance is inf."""
        ranks = list(range(1, k + 1))  # a list keeps the last axis if k is 1
        workers = max(1, min(torch.get_num_threads(), points.numel() // points.shape[-1] // QUERIES_PER_THREAD))
        distance, index = self.tree.query(points.detach().numpy(), ranks, distance_upper_bound=within, workers=workers)
        return torch.from_numpy(distance).to(points), torch.from_numpy(index).clamp_(max=self.size - 1)


class BruteForce:
    """Brute-force search by matrix products, on a GPU faster than a tree for a few thousand points.

    Candidates are ranked in float32 by |x|^2 - 2 q.x. The order of points whose squared distances differ by less than
    about 1e-6 |x|^2 is arbitrary, so points should be centred on the origin. The k nearest of k + SPARE candidates are
    then chosen by their exact distances; for k = 1 the best candidate is taken without this step.
    """

    MAX_ENTRIES = 2**26  # maximum number of entries of the distance matrix held at once, 256 MB
    SPARE = 4  # candidates beyond k

    def __init__(self, points: Float[Tensor, "n d"]):
        self.points = points
        self.table = torch.cat([-2 * points, points.square().sum(1, keepdim=True)], 1).float().mT.contiguous()

    def query(
        self, points: Float[Tensor, "*b d"], k: int = 1, within: float = inf
    ) -> tuple[Float[Tensor, "*b k"], Int[Tensor, "*b k"]]:
        """As `KDTree.query`."""
        flat, have = points.reshape(-1, points.shape[-1]), min(k, len(self.points))
        chunks = flat.split(max(1, self.MAX_ENTRIES // len(self.points)))
        candidates = 1 if have == 1 else min(have + self.SPARE, len(self.points))
        index = torch.cat([self._nearest(chunk, candidates) for chunk in chunks])
        distance, order = (flat[:, None] - self.points[index]).norm(dim=2).sort(dim=1)
        distance, order = distance[:, :have], order[:, :have]
        distance = torch.nn.functional.pad(distance.where(distance < within, inf), (0, k - have), value=inf)
        index = torch.nn.functional.pad(index.gather(1, order), (0, k - have))
        return distance.view(*points.shape[:-1], k), index.view(*points.shape[:-1], k)

    def _nearest(self, queries: Float[Tensor, "m d"], k: int) -> Int[Tensor, "m k"]:
        products = torch.nn.functional.pad(queries.float(), (0, 1), value=1.0) @ self.table
        return products.argmin(1, keepdim=True) if k == 1 else products.topk(k, largest=False).indices


def neighbour_index(points: Float[Tensor, "n d"]) -> KDTree | BruteForce:
    """A search structure for a few thousand points and many queries, on the device of the points."""
    return BruteForce(points) if points.is_cuda else KDTree(points)


def knn(
    points: Float[Tensor, "n 3"], queries: Float[Tensor, "m 3"], k: int
) -> tuple[Float[Tensor, "m k"], Int[Tensor, "m k"]]:
    """Distances and indices of the k nearest points to each query, nearest first.

    With fewer than k points, the farthest one is repeated. Uses a k-d tree on the CPU.
    """
    have = min(k, len(points))
    distance, index = (found.to(queries.device) for found in KDTree(points.cpu()).query(queries.cpu(), have))
    pad = torch.tensor([min(j, have - 1) for j in range(k)], device=queries.device)
    return distance[:, pad], index[:, pad]


def spacing(points: Float[Tensor, "n 3"], k: int = 3) -> Float[Tensor, "n"]:
    """Root-mean-square distance of each point to its k nearest neighbours."""
    distance, _ = knn(points, points, k + 1)
    return distance[:, 1:].square().mean(1).sqrt()
