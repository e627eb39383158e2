"""Narrow phase of contact detection: nearest points of other objects, and points near walls."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.kernels.compilers import TRITON
from stages.core.kernels.threads import large_operation, parallel_map

if TRITON:
    from stages.core.kernels.field.nearest import nearest_between_objects as nearest_triton

BLOCK_POINTS = 64  # rows of the distance matrix per block, so that it stays in the cache; 32 to 128 take the same time
# Number of distances from which several threads are used: a smaller search takes at most 0.4 ms, and waking a thread
# 0.1 ms (Intel Xeon).
PARALLEL_MIN_DISTANCES = 1 << 20
CULLING_MIN_POINTS = 500  # keypoints of a scene from which culling by bounding boxes is faster on a CPU; measured

Nearest = tuple[Float[Tensor, "b o o n"], Int[Tensor, "b o o n"]]


@torch.no_grad()
def nearest(points: Float[Tensor, "b o n 3"], valid: Bool[Tensor, "b o n"], radius: float) -> Nearest:
    """Return for each point n of object i the distance [m] to the nearest point of each object j, and its index.

    The distance is infinite, and the index undefined, where it is not below `radius` [m], for j = i, and to or from
    padding.
    """
    if TRITON and points.is_cuda and points.dtype == torch.float32:
        return nearest_triton(points, valid, radius)
    is_small = points.shape[1] * points.shape[2] < CULLING_MIN_POINTS
    search = _all_pairs if is_small or points.is_cuda else _culled
    distance, index = search(points, valid, radius)
    return distance.masked_fill(distance >= radius, torch.inf), index


def _all_pairs(points: Float[Tensor, "b o n 3"], valid: Bool[Tensor, "b o n"], radius: float) -> Nearest:
    """`nearest` by brute force.

    One matrix product of centred coordinates in single precision finds the nearest points; their distances are computed
    from coordinate differences.
    """
    o = points.shape[1]
    count = valid.sum((1, 2)).clamp_min(1)
    centre = torch.where(valid[..., None], points, 0.0).sum((1, 2)) / count[:, None]
    x = torch.where(valid[..., None], points - centre[:, None, None], 0.0)
    with torch.autocast(x.device.type, enabled=False):
        half = torch.where(valid, x.float().square().sum(-1) / 2, torch.inf)
        gap = half[:, None, :, None] - torch.einsum("bind,bjmd->bijnm", x.float(), x.float())
    index = _argmin(gap)
    scene = torch.arange(len(x), device=x.device)[:, None, None, None]
    other = torch.arange(o, device=x.device)[None, None, :, None]
    distance = (x[:, :, None] - x[scene, other, index]).norm(dim=-1)
    is_self = torch.eye(o, dtype=torch.bool, device=x.device)[:, :, None]
    excluded = is_self | ~valid[:, :, None] | ~valid.any(-1)[:, None, :, None]
    return distance.masked_fill(excluded, torch.inf), index


def _culled(points: Float[Tensor, "b o n 3"], valid: Bool[Tensor, "b o n"], radius: float) -> Nearest:
    """`nearest` restricted to points within `radius` of the other object's bounding box."""
    b, o, n, _ = points.shape
    distance = points.new_full((b, o, o, n), torch.inf)
    index = valid.new_zeros(b, o, o, n, dtype=torch.int64)
    low = points.masked_fill(~valid[..., None], torch.inf).amin(2) - radius
    high = points.masked_fill(~valid[..., None], -torch.inf).amax(2) + radius
    inside = ((points[:, :, None] > low[:, None, :, None]) & (points[:, :, None] < high[:, None, :, None])).all(-1)
    inside &= valid[:, :, None]
    near = inside.any(-1)
    pairs = (near & near.mT & ~torch.eye(o, dtype=torch.bool)).nonzero().tolist()
    queries = [(s, i, j, inside[s, i, j].nonzero()[:, 0], inside[s, j, i].nonzero()[:, 0]) for s, i, j in pairs]

    def search(query: tuple) -> Tensor:
        s, i, j, own, other = query
        return _nearest_index(points[s, i, own], points[s, j, other])

    if sum(len(own) * len(other) for *_, own, other in queries) < PARALLEL_MIN_DISTANCES:
        found = [search(query) for query in queries]
    else:
        with large_operation():
            found = parallel_map(search, queries)
    for (s, i, j, own, other), which in zip(queries, found, strict=True):
        distance[s, i, j, own] = (points[s, i, own] - points[s, j, other[which]]).norm(dim=-1)
        index[s, i, j, own] = other[which]
    return distance, index


def _nearest_index(x: Float[Tensor, "p 3"], y: Float[Tensor, "q 3"]) -> Int[Tensor, "p"]:
    """Index of the nearest y to each x, by |y|^2 / 2 - x.y = (|x - y|^2 - |x|^2) / 2 from matrix products."""
    centre = y.mean(0)
    x, y = x - centre, y - centre
    half = y.square().sum(-1) / 2
    return torch.cat([_argmin(torch.addmm(half, block, y.T, alpha=-1)) for block in x.split(BLOCK_POINTS)])


def _argmin(x: Float[Tensor, "*b n"]) -> Int[Tensor, "*b"]:
    """Index of the smallest entry of each row; the first of equal entries.

    On a CPU by NumPy, whose search uses vector instructions: 0.6 ms for 2048 x 2048, PyTorch 5.5 ms (Intel Xeon).
    """
    return x.argmin(-1) if x.is_cuda else torch.from_numpy(x.numpy().argmin(-1))


def near_walls(
    points: Float[Tensor, "b o n 3"], valid: Bool[Tensor, "b o n"], box: Float[Tensor, "b o 2 3"], radius: float
) -> Bool[Tensor, "b o n"]:
    """Points within `radius` [m] of the floor or of one of the four walls, on either side; the ceiling is open."""
    low, high = box[..., None, 0, :], box[..., None, 1, :]
    near = ((points - low).abs() < radius).any(-1) | ((points[..., :2] - high[..., :2]).abs() < radius).any(-1)
    return near & valid
