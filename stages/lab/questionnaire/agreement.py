"""Krippendorff's alpha: agreement of several raters who each rated only some of the units.

Source: Krippendorff 2011, "Computing Krippendorff's Alpha-Reliability".
"""

from __future__ import annotations

import numpy as np


def coincidences(ratings: np.ndarray, points: int) -> np.ndarray:
    """Coincidence matrix of each unit, (units, points, points), from ratings 1 to `points` (raters, units), 0: none.

    A unit with m ratings contributes each of its m (m - 1) ordered pairs with weight 1 / (m - 1); a unit with a single
    rating contributes nothing.
    """
    counts = np.stack([(ratings == k).sum(0) for k in range(1, points + 1)], 1).astype(float)
    pairs = counts[:, :, None] * counts[:, None, :] - np.eye(points) * counts[:, :, None]
    return pairs / np.maximum(counts.sum(1) - 1, 1)[:, None, None]


def krippendorff_alpha(pairs: np.ndarray, ordinal: bool) -> np.ndarray:
    """Alpha of summed coincidence matrices (..., points, points): 1 is agreement, 0 is expected by chance.

    The difference of two ratings is that of their values, or, if `ordinal`, that of their mean ranks among all ratings.
    nan if fewer than two different ratings were given.
    """
    n = pairs.sum(-1)
    position = n.cumsum(-1) - n / 2 if ordinal else np.broadcast_to(np.arange(n.shape[-1], dtype=float), n.shape)
    squared = (position[..., :, None] - position[..., None, :]) ** 2
    observed = (pairs * squared).sum((-1, -2))
    expected = (n[..., :, None] * n[..., None, :] * squared).sum((-1, -2))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(expected > 0, 1 - (n.sum(-1) - 1) * observed / expected, np.nan)
