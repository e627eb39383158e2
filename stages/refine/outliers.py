"""Gaussians that float around an object without being part of it."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.scene.gaussians import Gaussians

MIN_LOG_SPACING_MAD = 0.2  # least deviation of the logarithm of distances: an even surface's corners are not lonely


def floaters(g: Gaussians, limit: float = 3.0) -> Bool[Tensor, "n"]:
    """Gaussians of objects that are far from the rest of their object, lonely, or larger than it.

    Far is a modified z-score of the distance to the median centre above `limit` (Iglewicz and Hoaglin 1993)
    together with fewer neighbours than usual: the end of a rope is far, but not alone. Lonely is the same
    score, on the logarithm of the distance to the eighth neighbour, twice as high.
    """
    out = ~(g.means.isfinite().all(1) & g.scales.isfinite().all(1) & g.opacities.isfinite()) & (g.object_id > 0)
    for number in g.object_id.unique().tolist():
        members = torch.nonzero((g.object_id == number) & ~out)[:, 0]
        if number == 0 or len(members) < 16:
            continue
        means = g.means[members]
        centre = means.median(0).values
        far = modified_z_score((means - centre).norm(dim=1))
        alone = modified_z_score(knn(means, means, 9)[0][:, -1].clamp_min(1e-12).log(), MIN_LOG_SPACING_MAD)
        core = means[far <= limit]
        size = float((core.amax(0) - core.amin(0)).norm()) if len(core) else 0.0
        blur = g.scales[members].amax(1) > max(0.35 * size, 1e-12)
        stray = ((far > limit) & (alone > 0.5 * limit)) | (alone > 2 * limit) | (blur & (size > 0))
        if float(stray.float().mean()) < 0.5:  # what most of it is, is the object
            out[members[stray]] = True
    return out


def modified_z_score(values: Float[Tensor, "n"], least: float | None = None) -> Float[Tensor, "n"]:
    """Modified z-score above the median: 0.6745 (x - median) / MAD, with a MAD of `least` at least."""
    off = values - values.median()
    if least is None:
        least = 1e-3 * max(abs(float(values.median())), 1e-12)
    return 0.6745 * off / off.abs().median().clamp_min(least)
