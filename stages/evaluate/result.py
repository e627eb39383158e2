"""The result of a comparison, and its representation as table and JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Curve:
    """A series with one value per frame."""

    name: str
    values: list[float]


@dataclass(frozen=True)
class Pictures:
    """Images shown side by side in the report."""

    caption: str
    images: dict[str, Float[Tensor, "h w 3"]]  # by name, from left to right


@dataclass(frozen=True)
class Result:
    """Metrics by name: overall, and of each object (or film; none for images)."""

    kind: str  # kind of the compared data: "trajectories", "pictures", "scenes", "labels" or "films"
    overall: dict[str, float | int]
    parts: dict[str, dict[str, float | int]]
    notes: list[str]  # sentences, for example on how items were matched
    curves: list[Curve] = field(default_factory=list)
    curve_title: str = ""
    fps: float | None = None  # frame rate of the curves, if frames have a time
    pictures: list[Pictures] = field(default_factory=list)
    legend: dict[str, tuple[float, float, float]] = field(default_factory=dict)  # of the pictures: name -> RGB 0..1

    def rows(self) -> list[tuple[str, dict[str, float | int]]]:
        """Rows of the table: each object, then "all"."""
        return [*self.parts.items(), ("all", self.overall)] if self.parts else [("all", self.overall)]

    def columns(self) -> list[str]:
        """Names of all metrics, in order of first use."""
        return list(dict.fromkeys(name for _, metrics in self.rows() for name in metrics))


def format_number(value: float | int | None) -> str:
    """A number with four significant digits; a dash if undefined."""
    if value is None or math.isnan(value):
        return "-"
    if isinstance(value, int):
        return str(value)
    return f"{value:.4g}" if not 1e-3 <= abs(value) < 1e4 else f"{value:.4f}"


def format_table(result: Result) -> str:
    """Aligned text with one row per object; the overall metrics are last."""
    columns = result.columns()
    cells = [["", *columns]] + [[name, *(format_number(row.get(c)) for c in columns)] for name, row in result.rows()]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns) + 1)]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]).rstrip()
        for row in cells
    )


def to_json(result: Result) -> dict:
    """Values for JSON; undefined values are null, and an infinite PSNR (identical images) is the string "inf"."""
    return {
        "kind": result.kind,
        "overall": _plain(result.overall),
        "objects": {name: _plain(row) for name, row in result.parts.items()},
        "notes": result.notes,
        "per_frame": {c.name: [_number(v) for v in c.values] for c in result.curves},
    }


def _plain(metrics: dict[str, float | int]) -> dict:
    return {name: _number(value) for name, value in metrics.items()}


def _number(value: float | int) -> float | int | str | None:
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else ("inf" if value > 0 else "-inf")
