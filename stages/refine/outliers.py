"""Outlier removal: finds Gaussians of an object that float around it or are too large for it."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.scene.gaussians import Gaussians

MIN_LOG_SPACING_MAD = 0.2  # lower bound of the MAD of log distances to neighbours; keeps corners of even samples

MIN_GAUSSIANS = 16  # fewest Gaussians of an object that is tested


def floaters(g: Gaussians, limit: float = 3.0) -> Bool[Tensor, "n"]:
    """Mask of the Gaussians that are far from the rest of their object, isolated, or nearly as large as the object.

    The distance score is the modified z-score (Iglewicz and Hoaglin 1993) of the distance from the median centre, the
    isolation score that of the log distance to the 8th neighbour. A Gaussian is an outlier if the distance score
    exceeds `limit` and the isolation score exceeds half of `limit` (the end of a rope is far, but not isolated), if the
    isolation score exceeds twice `limit`, or if the Gaussian is non-finite or larger than 0.35 of the object.

    An object that would lose more than half of its Gaussians keeps all of them.
    """
    out = ~(g.means.isfinite().all(1) & g.scales.isfinite().all(1) & g.opacities.isfinite()) & (g.object_id > 0)
    for number in g.object_id.unique().tolist():
        members = torch.nonzero((g.object_id == number) & ~out)[:, 0]
        if number == 0 or len(members) < MIN_GAUSSIANS:
            continue
        means = g.means[members]
        centre = means.median(0).values
        far = modified_z_score((means - centre).norm(dim=1))
        isolated = modified_z_score(knn(means, means, 9)[0][:, -1].clamp_min(1e-12).log(), MIN_LOG_SPACING_MAD)
        core = means[far <= limit]
        size = float((core.amax(0) - core.amin(0)).norm()) if len(core) else 0.0
        oversized = g.scales[members].amax(1) > max(0.35 * size, 1e-12)
        stray = ((far > limit) & (isolated > 0.5 * limit)) | (isolated > 2 * limit) | (oversized & (size > 0))
        if float(stray.float().mean()) < 0.5:  # the majority cannot be outliers
            out[members[stray]] = True
    return out


def modified_z_score(values: Float[Tensor, "n"], min_mad: float | None = None) -> Float[Tensor, "n"]:
    """Signed modified z-score 0.6745 (x - median) / MAD, where MAD is at least `min_mad` (default: 1e-3 median)."""
    off = values - values.median()
    if min_mad is None:
        min_mad = 1e-3 * max(abs(float(values.median())), 1e-12)
    return 0.6745 * off / off.abs().median().clamp_min(min_mad)
