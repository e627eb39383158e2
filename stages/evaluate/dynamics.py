"""How far predicted points stray from the true ones: pure functions on (frames, objects, points, 3) tensors.

The metrics of the NGFF paper (ICLR 2026), whose text leaves room; here they mean:

    MSE   mean squared error of a coordinate, over all frames (the first too), objects, points and axes
    RMSE  sqrt(MSE) of one scene; over many scenes the RMSEs are averaged, not the MSEs
    PCE   mean distance between the predicted and the true step of a point from one frame to the next
    FPE   mean distance between the predicted and the true point in the last frame
    R     Pearson correlation over time of each coordinate of each point whose truth moves, averaged

R correlates each coordinate with itself over time, which is strict. Correlating all displacements of a scene
in one pool instead (`pooled_correlation`) mostly measures that everything falls, and is close to 1 for any model.

Every function takes leading batch dimensions and an optional `mask` of the points that count (objects with fewer
points than others are padded); batch dimensions remain in the result. An average over nothing is nan.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

STILL = 1e-3  # standard deviation over time below which a coordinate is at rest: 1 mm where units are metres

Points = Float[Tensor, "*b t o p 3"]
Mask = Bool[Tensor, "*b o p"]


def mse(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b"]:
    """Mean squared error of a coordinate [units^2]."""
    squared = (predicted - truth).square().mean((-4, -1))
    return _mean(squared, mask, 2)


def rmse(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b"]:
    """Root mean squared error of a coordinate, per scene [units]."""
    return mse(predicted, truth, mask).sqrt()


def pce(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b"]:
    """Mean |predicted step - true step| [units per frame]; nan for a single frame."""
    error = (predicted - truth).diff(dim=-4).norm(dim=-1)
    return _mean(error.mean(-3), mask, 2)


def fpe(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b"]:
    """Mean distance in the last frame [units]."""
    last = (predicted - truth)[..., -1, :, :, :].norm(dim=-1)
    return _mean(last, mask, 2)


def correlation(
    predicted: Points, truth: Points, mask: Mask | None = None, still: float = STILL
) -> Float[Tensor, "*b"]:
    """Mean Pearson correlation over time of the coordinates that truly move (standard deviation above `still`).

    A coordinate that should move and is predicted at rest scores 0. Nan when nothing moves.
    """
    p, q = predicted.double(), truth.double()
    p, q = p - p.mean(-4, keepdim=True), q - q.mean(-4, keepdim=True)
    size_p, size_q = p.square().sum(-4).sqrt(), q.square().sum(-4).sqrt()
    moves = size_q > still * truth.shape[-4] ** 0.5
    if mask is not None:
        moves = moves & mask[..., None]
    r = (p * q).sum(-4) / (size_p * size_q).clamp_min(1e-12)
    return _mean(r, moves, 3).to(predicted.dtype)


def pooled_correlation(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b"]:
    """Pearson correlation of all displacements from the first frame in one pool; lenient, see the module."""
    p = (predicted - predicted[..., :1, :, :, :]).double()
    q = (truth - truth[..., :1, :, :, :]).double()
    counts = torch.ones_like(p, dtype=torch.bool) if mask is None else mask[..., None, :, :, None].expand_as(p)
    p, q = (x - _mean(x, counts, 4)[..., None, None, None, None] for x in (p, q))
    covariance, var_p, var_q = (_mean(x, counts, 4) for x in (p * q, p * p, q * q))
    return (covariance / (var_p * var_q).sqrt()).to(predicted.dtype)  # 0 / 0 where nothing moves: nan


def error_over_time(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b t o"]:
    """Mean distance of an object's points in each frame [units]."""
    distance = (predicted - truth).norm(dim=-1)
    return _mean(distance, None if mask is None else mask[..., None, :, :].expand_as(distance), 1)


def all_metrics(
    predicted: Points, truth: Points, mask: Mask | None = None, still: float = STILL
) -> dict[str, Float[Tensor, "*b"]]:
    """Every metric by its name in tables."""
    return {
        "MSE": mse(predicted, truth, mask),
        "RMSE": rmse(predicted, truth, mask),
        "PCE": pce(predicted, truth, mask),
        "FPE": fpe(predicted, truth, mask),
        "R": correlation(predicted, truth, mask, still),
        "R_pooled": pooled_correlation(predicted, truth, mask),
    }


def _mean(values: Tensor, counts: Tensor | None, dims: int) -> Tensor:
    """Mean over the last `dims` dimensions of the values that count."""
    axes = tuple(range(-dims, 0))
    if counts is None:
        return values.mean(axes)
    return torch.where(counts, values, 0.0).sum(axes) / counts.sum(axes)
