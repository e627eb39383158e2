"""Nearest neighbours."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor


def knn(
    points: Float[Tensor, "n 3"], queries: Float[Tensor, "m 3"], k: int
) -> tuple[Float[Tensor, "m k"], Int[Tensor, "m k"]]:
    """Distances and indices of the k nearest points to each query, nearest first.

    With fewer than k points the last one is repeated, so the shape holds. A kd-tree on the CPU.
    """
    if not len(points):
        raise ValueError("no points to search among")
    tree = cKDTree(points.detach().cpu().numpy())
    have = min(k, len(points))
    distance, index = tree.query(queries.detach().cpu().numpy(), k=list(range(1, have + 1)), workers=-1)
    distance = torch.from_numpy(distance).to(queries)
    index = torch.from_numpy(index).to(queries.device)
    pad = torch.tensor([min(j, have - 1) for j in range(k)], device=queries.device)
    return distance[:, pad], index[:, pad]


def spacing(points: Float[Tensor, "n 3"], k: int = 3) -> Float[Tensor, "n"]:
    """Root mean square distance of each point to its k nearest others."""
    distance, _ = knn(points, points, k + 1)
    return distance[:, 1:].square().mean(1).sqrt()
