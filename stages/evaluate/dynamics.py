"""Metrics of predicted motion: pure functions on (frames, objects, points, 3) tensors.

The metrics of the NGFF paper (ICLR 2026), whose text does not define them completely. Definitions used here:

    MSE   mean squared error of a coordinate, over all frames (including the first), objects, points and axes
    RMSE  sqrt(MSE) of one scene; over many scenes the RMSEs are averaged, not the MSEs
    PCE   mean distance between the predicted and the true step of a point from one frame to the next
    FPE   mean distance between the predicted and the true point in the last frame
    R     Pearson correlation over time of each coordinate whose true value moves, averaged over points and axes

Pooling all displacements of a scene into one correlation instead (`pooled_correlation`) mostly measures that all
objects fall, and is close to 1 for any model.

Every function accepts leading batch dimensions, which remain in the result, and an optional `mask` of valid points
(false for padding, if objects have different numbers of points). With `seen`, frames in which the truth has lost an
object do not count for this object. A mean over nothing is nan.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MIN_MOTION = 1e-3  # standard deviation over time below which a coordinate is at rest [m]

Points = Float[Tensor, "*b t o p 3"]
Mask = Bool[Tensor, "*b o p"]
Seen = Bool[Tensor, "*b t o"]


def mse(predicted: Points, truth: Points, mask: Mask | None = None, seen: Seen | None = None) -> Float[Tensor, "*b"]:
    """Mean squared error per coordinate [units^2]."""
    return _mean((predicted - truth).square().mean(-1), _valid(truth, mask, seen), 3)


def rmse(predicted: Points, truth: Points, mask: Mask | None = None, seen: Seen | None = None) -> Float[Tensor, "*b"]:
    """Root mean squared error per coordinate of each scene [units]."""
    return mse(predicted, truth, mask, seen).sqrt()


def pce(predicted: Points, truth: Points, mask: Mask | None = None, seen: Seen | None = None) -> Float[Tensor, "*b"]:
    """Mean norm of the difference between predicted and true step per frame [units/frame]; nan for one frame."""
    error, valid = (predicted - truth).diff(dim=-4).norm(dim=-1), _valid(truth, mask, seen)
    return _mean(error, None if valid is None else valid[..., 1:, :, :] & valid[..., :-1, :, :], 3)


def fpe(predicted: Points, truth: Points, mask: Mask | None = None, seen: Seen | None = None) -> Float[Tensor, "*b"]:
    """Mean distance between predicted and true points in the last frame in which each object is seen [units]."""
    distance = (predicted - truth).norm(dim=-1)
    if seen is None:
        return _mean(distance[..., -1, :, :], mask, 2)
    frames = torch.arange(seen.shape[-2], device=seen.device)[:, None]
    last = torch.where(seen, frames, 0).amax(-2)[..., None, :, None]
    return _mean(distance.take_along_dim(last, -3)[..., 0, :, :], mask, 2)


def correlation(
    predicted: Points, truth: Points, mask: Mask | None = None, min_motion: float = MIN_MOTION,
    seen: Seen | None = None,
) -> Float[Tensor, "*b"]:  # fmt: skip
    """Mean Pearson correlation over time of the coordinates whose true standard deviation exceeds `min_motion`.

    A moving coordinate that is predicted at rest counts as 0. Nan if nothing moves.
    """
    weight = 1.0 if seen is None else seen[..., None, None].double()
    count = truth.shape[-4] if seen is None else weight.sum(-4).clamp_min(1)

    def centred(x: Points) -> Points:
        mean = (weight * x.double()).sum(-4, keepdim=True) / (count if seen is None else count.unsqueeze(-4))
        return weight * (x.double() - mean)

    p, q = centred(predicted), centred(truth)
    norm_p, norm_q = p.square().sum(-4).sqrt(), q.square().sum(-4).sqrt()
    moves = norm_q > min_motion * count**0.5
    if mask is not None:
        moves = moves & mask[..., None]
    r = (p * q).sum(-4) / (norm_p * norm_q).clamp_min(1e-12)
    return _mean(r, moves, 3).to(predicted.dtype)


def pooled_correlation(
    predicted: Points, truth: Points, mask: Mask | None = None, seen: Seen | None = None
) -> Float[Tensor, "*b"]:
    """Pearson correlation of all displacements from the first frame, pooled; see the module docstring."""
    p = (predicted - predicted[..., :1, :, :, :]).double()
    q = (truth - truth[..., :1, :, :, :]).double()
    valid = _valid(truth, mask, seen)
    valid = torch.ones_like(p, dtype=torch.bool) if valid is None else valid[..., None].expand_as(p)
    p, q = (x - _mean(x, valid, 4)[..., None, None, None, None] for x in (p, q))
    covariance, var_p, var_q = (_mean(x, valid, 4) for x in (p * q, p * p, q * q))
    return (covariance / (var_p * var_q).sqrt()).to(predicted.dtype)  # nan (0 / 0) if nothing moves


def error_over_time(predicted: Points, truth: Points, mask: Mask | None = None) -> Float[Tensor, "*b t o"]:
    """Mean distance between predicted and true points of each object in each frame [units]."""
    distance = (predicted - truth).norm(dim=-1)
    return _mean(distance, None if mask is None else mask[..., None, :, :].expand_as(distance), 1)


def all_metrics(
    predicted: Points, truth: Points, mask: Mask | None = None, min_motion: float = MIN_MOTION,
    seen: Seen | None = None,
) -> dict[str, Float[Tensor, "*b"]]:  # fmt: skip
    """All metrics by their names in tables; the output of `evaluate` has one column for each."""
    return {
        "MSE": mse(predicted, truth, mask, seen),
        "RMSE": rmse(predicted, truth, mask, seen),
        "PCE": pce(predicted, truth, mask, seen),
        "FPE": fpe(predicted, truth, mask, seen),
        "R": correlation(predicted, truth, mask, min_motion, seen),
        "R_pooled": pooled_correlation(predicted, truth, mask, seen),
    }


def _valid(truth: Points, mask: Mask | None, seen: Seen | None) -> Bool[Tensor, "*b t o p"] | None:
    """Mask of the points that count in each frame; None: all."""
    if mask is None and seen is None:
        return None
    valid = torch.ones_like(truth[..., 0], dtype=torch.bool)
    valid = valid if mask is None else valid & mask[..., None, :, :]
    return valid if seen is None else valid & seen[..., None]


def _mean(values: Tensor, valid: Tensor | None, dims: int) -> Tensor:
    """Mean of the valid values over the last `dims` dimensions."""
    axes = tuple(range(-dims, 0))
    if valid is None:
        return values.mean(axes)
    return torch.where(valid, values, 0.0).sum(axes) / valid.sum(axes)
