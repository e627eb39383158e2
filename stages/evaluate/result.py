"""What every comparison ends in, and how it is written down."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Curve:
    """One number a frame."""

    name: str
    values: list[float]


@dataclass(frozen=True)
class ImagePair:
    """A predicted picture beside the true one."""

    caption: str
    predicted: Float[Tensor, "h w 3"]
    truth: Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class Result:
    """Metrics by name: of everything and of each part (objects of a scene; none for pictures)."""

    kind: str  # what was compared: "trajectories", "pictures" or "scenes"
    overall: dict[str, float | int]
    parts: dict[str, dict[str, float | int]]
    notes: list[str]  # how things were matched, in sentences
    curves: list[Curve] = field(default_factory=list)
    curve_title: str = ""
    fps: float | None = None  # of the curves, where frames have a time
    pairs: list[ImagePair] = field(default_factory=list)

    def rows(self) -> list[tuple[str, dict[str, float | int]]]:
        return [*self.parts.items(), ("all", self.overall)] if self.parts else [("all", self.overall)]

    def columns(self) -> list[str]:
        return list(dict.fromkeys(name for _, metrics in self.rows() for name in metrics))


def format_number(value: float | int | None) -> str:
    """A number as in tables: four digits that count; a dash where it is not defined."""
    if value is None or math.isnan(value):
        return "-"
    if isinstance(value, int):
        return str(value)
    return f"{value:.4g}" if not 1e-3 <= abs(value) < 1e4 else f"{value:.4f}"


def format_table(result: Result) -> str:
    """Aligned text, one row an object, everything last."""
    columns = result.columns()
    cells = [["", *columns]] + [[name, *(format_number(row.get(c)) for c in columns)] for name, row in result.rows()]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns) + 1)]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]).rstrip()
        for row in cells
    )


def to_json(result: Result) -> dict:
    """Plain values; undefined is null, and an infinite PSNR (identical pictures) the string "inf"."""
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
