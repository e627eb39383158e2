"""Training history in the card of weights: a flat list of the runs that produced them, oldest first.

A run is a training (its command, data, budget and validation score) or an average of weights (`average`: ratio and
sha256 of each). Every run but the last holds the sha256 of the weights it wrote; for the last, it is that of the card.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

CURVE = ("minutes", "step", "horizon", "loss", "RMSE", "R")  # columns of a training curve that are stored in a card
DIGITS = 5  # significant digits of a curve's values


def runs_of(card: Mapping) -> list[dict]:
    """The runs of a card, each with the sha256 of the weights it wrote; if none are known, one run with only that."""
    *earlier, last = card.get("runs") or [{}]
    return [*earlier, {**last, "sha256": card["sha256"]}]


def merge(cards: Sequence[Mapping]) -> list[dict]:
    """The runs of several cards without duplicates, in order of first occurrence."""
    return list({run["sha256"]: run for card in cards for run in runs_of(card)}.values())


def total_minutes(card: Mapping) -> float | None:
    """Training time of all runs, summed over their processes [min]; None if the card has no timed run."""
    minutes = [float(run["minutes"]) * run.get("processes", 1) for run in card.get("runs", ()) if "minutes" in run]
    return sum(minutes) if minutes else None


def curve_columns(rows: Sequence[Mapping]) -> dict[str, list[float | None]]:
    """A training curve as one list of values per column, rounded; None for missing and non-finite values."""
    return {key: [_rounded(row.get(key)) for row in rows] for key in CURVE}


def _rounded(value: float | None) -> float | None:
    if value is None or not math.isfinite(value):
        return None
    return value if isinstance(value, int) else float(f"{value:.{DIGITS}g}")
