"""Small diagrams for the docs, drawn with OpenCV: marks for what was measured, a line for theory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stages.scene.files import replacing

WIDTH, HEIGHT, MARGIN = 460, 300, 52  # of a panel [px]
INK, BLUE, RED, GRID = (40, 40, 40), (176, 92, 20), (40, 40, 200), (225, 225, 225)  # BGR
Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Panel:
    """One diagram. With `log` both axes are logarithmic, and points must be positive."""

    title: str
    measured: Points
    expected: Points = ()
    log: bool = False
    theory: str = "theory"  # what the line is called


def draw(out: Path, panels: Sequence[Panel], columns: int = 3) -> None:
    """Panels in rows, as a PNG."""
    rows = [list(panels[i : i + columns]) for i in range(0, len(panels), columns)]
    blank = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    image = np.vstack([np.hstack([*map(_panel, row), *[blank] * (columns - len(row))]) for row in rows])
    ok, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert ok
    with replacing(out) as part:
        part.write_bytes(png.tobytes())


def _panel(panel: Panel) -> np.ndarray:
    image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    scale = np.log10 if panel.log else np.asarray
    both = scale(np.array([*panel.measured, *panel.expected], float))
    low, high = both.min(0), both.max(0)
    if not panel.log:
        low, high = np.minimum(low, 0), np.maximum(high, 0)
    room = 0.06 * np.maximum(high - low, 1e-12)
    low, high = np.where(panel.log | (low < 0), low - room, low), high + room
    area = np.array([WIDTH - MARGIN - 16, HEIGHT - MARGIN - 34])

    def place(points: Points) -> np.ndarray:
        at = (scale(np.array(points, float)) - low) / (high - low) * area
        return np.stack([MARGIN + at[:, 0], HEIGHT - MARGIN - at[:, 1]], 1).round().astype(int)

    for axis in (0, 1):
        for tick in _ticks(low[axis], high[axis], panel.log):
            at = round(float((tick - low[axis]) / (high[axis] - low[axis]) * area[axis]))
            text = f"{10**tick if panel.log else tick:.4g}"
            if axis == 0:
                cv2.line(image, (MARGIN + at, 34), (MARGIN + at, HEIGHT - MARGIN), GRID, 1)
                _text(image, text, (MARGIN + at - 4 * len(text), HEIGHT - MARGIN + 18))
            else:
                cv2.line(image, (MARGIN, HEIGHT - MARGIN - at), (WIDTH - 16, HEIGHT - MARGIN - at), GRID, 1)
                _text(image, text, (MARGIN - 6 - 7 * len(text), HEIGHT - MARGIN - at + 4))
    if len(panel.expected):
        cv2.polylines(image, [place(panel.expected)], False, RED, 1, cv2.LINE_AA)
    for x, y in place(panel.measured):
        cv2.circle(image, (int(x), int(y)), 4, BLUE, -1, cv2.LINE_AA)
    cv2.rectangle(image, (MARGIN, 34), (WIDTH - 16, HEIGHT - MARGIN), INK, 1)
    _text(image, panel.title, (MARGIN, 22), 0.44)
    _text(image, "o measured" + (f"   - {panel.theory}" if len(panel.expected) else ""), (MARGIN, HEIGHT - 12))
    return image


def _ticks(low: float, high: float, log: bool) -> list[float]:
    """A few round numbers between the ends; powers of ten and their doubles and fives on a logarithmic axis."""
    if log:
        decades = range(math.floor(low), math.ceil(high) + 1)
        marks = [d + math.log10(m) for d in decades for m in ((1, 2, 5) if high - low < 2 else (1,))]
        return [t for t in marks if low <= t <= high]
    rough = (high - low) / 4
    step = 10 ** math.floor(math.log10(rough))
    step *= next(m for m in (1, 2, 5, 10) if m * step >= rough)
    return [n * step for n in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _text(image: np.ndarray, text: str, at: tuple[int, int], size: float = 0.4) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, INK, 1, cv2.LINE_AA)
