"""Metrics of predicted motion: pure functions on (frames, objects, points, 3) tensors.

The metrics of the NGFF paper (ICLR 2026), whose text does not define them completely. Definitions used here:

    MSE   mean squared error of a coordinate, over all frames (including the first), objects, points and axes
    RMSE  sqrt(MSE) of one scene; over many scenes the RMSEs are averaged, not the MSEs
    PCE   mean distance between the predicted and the true step of a point from one frame to the next
    FPE   mean distance between the predicted and the true point in the last frame
    R     Pearson correlation over time of each coordinate whose true value moves, averaged over points and axes

Pooling all displacements of a scene into one correlation instead (`pooled_correlation`) mostly measures that all
objects fall, and is close to 1 for any model.

Every function takes leading batch dimensions, which remain in the result, and an optional `mask` of valid points (false
for padding, where objects differ in their number of points). A mean over nothing is nan.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MIN_MOTION = 1e-3  # standard deviation over time below which a coordinate is at rest [m]

Points = Float[Tensor, "*b t o p 3"]
Mask = Bool[Tensor, "*b o p"]


def mse(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b"]:
    """Mean squared error per coordinate [units^2]."""
    squared = (predicted - truth).square().mean((-4, -1))
    return _mean(squared, mask, 2)


def rmse(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b"]:
    """Root mean squared error per coordinate, of each scene [units]."""
    return mse(predicted, truth, mask).sqrt()


def pce(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b"]:
    """Mean norm of the difference of predicted and true displacement per frame [units/frame]; nan for one frame."""
    error = (predicted - truth).diff(dim=-4).norm(dim=-1)
    return _mean(error.mean(-3), mask, 2)


def fpe(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b"]:
    """Mean distance of predicted and true points in the last frame [units]."""
    last = (predicted - truth)[..., -1, :, :, :].norm(dim=-1)
    return _mean(last, mask, 2)


def correlation(
    predicted: Points, truth: Points, mask: Mask | None = None, min_motion: float = MIN_MOTION
) -> Float[Tensor, "*b"]:
    """Mean Pearson correlation over time of the coordinates whose true standard deviation exceeds `min_motion`.

    A moving coordinate that is predicted at rest counts as 0. Nan if nothing moves.
    """
    p, q = predicted.double(), truth.double()
    p, q = p - p.mean(-4, keepdim=True), q - q.mean(-4, keepdim=True)
    norm_p, norm_q = p.square().sum(-4).sqrt(), q.square().sum(-4).sqrt()
    moves = norm_q > min_motion * truth.shape[-4] ** 0.5
    if mask is not None:
        moves = moves & mask[..., None]
    r = (p * q).sum(-4) / (norm_p * norm_q).clamp_min(1e-12)
    return _mean(r, moves, 3).to(predicted.dtype)


def pooled_correlation(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b"]:
    """Pearson correlation of all displacements from the first frame, pooled; see the module docstring."""
    p = (predicted - predicted[..., :1, :, :, :]).double()
    q = (truth - truth[..., :1, :, :, :]).double()
    valid = torch.ones_like(p, dtype=torch.bool) if mask is None else mask[..., None, :, :, None].expand_as(p)
    p, q = (x - _mean(x, valid, 4)[..., None, None, None, None] for x in (p, q))
    covariance, var_p, var_q = (_mean(x, valid, 4) for x in (p * q, p * p, q * q))
    return (covariance / (var_p * var_q).sqrt()).to(predicted.dtype)  # nan (0 / 0) if nothing moves


def error_over_time(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b t o"]:
    """Mean distance of predicted and true points of each object in each frame [units]."""
    distance = (predicted - truth).norm(dim=-1)
    return _mean(distance, None if mask is None else mask[..., None, :, :].expand_as(distance), 1)


def all_metrics(
    predicted: Points, truth: Points, mask: Mask | None = None, min_motion: float = MIN_MOTION
) -> dict[str, Float[Tensor, "*b"]]:
    """Every metric, by its name in tables; the output of `evaluate` has one column for each."""
    return {
        "MSE": mse(predicted, truth, mask),
        "RMSE": rmse(predicted, truth, mask),
        "PCE": pce(predicted, truth, mask),
        "FPE": fpe(predicted, truth, mask),
        "R": correlation(predicted, truth, mask, min_motion),
        "R_pooled": pooled_correlation(predicted, truth, mask),
    }


def _mean(values: Tensor, valid: Tensor | None, dims: int) -> Tensor:
    """Mean of the valid values over the last `dims` dimensions."""
    axes = tuple(range(-dims, 0))
    if valid is None:
        return values.mean(axes)
    return torch.where(valid, values, 0.0).sum(axes) / valid.sum(axes)
