"""Directions spread evenly over a sphere, and the extreme points of a set in these directions."""

from __future__ import annotations

import numpy as np

EQUALLY_FAR = 1e-5  # difference of two heights below which they count as equal [largest height]


def fibonacci(count: int) -> np.ndarray:
    """Unit vectors (count, 3), spread evenly (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)


EXTREMES = np.concatenate([np.eye(3), -np.eye(3), fibonacci(200)]).astype(np.float32)


def extreme_rows(points: np.ndarray) -> np.ndarray:
    """Sorted rows of the points (n, 3) that are extreme in one of the directions EXTREMES.

    The first of equally far points is taken, so that rounding does not choose among the points of a flat side.
    """
    height = EXTREMES @ (points - points.mean(0)).T
    top = height.max(1, keepdims=True)
    return np.unique((height >= top - EQUALLY_FAR * top.max()).argmax(1))
