"""Small plots for the documentation, drawn with OpenCV: measured points, a theoretical line, or several curves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from stages.core.scene.files import replacing

PANEL_WIDTH, PANEL_HEIGHT, MARGIN = 460, 300, 52  # size of a panel, and width of its border for labels [px]
INK, BLUE, RED, GRID = (40, 40, 40), (176, 92, 20), (40, 40, 200), (225, 225, 225)  # BGR
COLOURS = (
    (40, 40, 200),
    (176, 92, 20),
    (44, 160, 44),
    (14, 127, 255),
    (189, 103, 148),
    (75, 86, 140),
    (194, 119, 227),
    (110, 110, 110),
    (34, 189, 188),
    (207, 190, 23),
)  # line colours of curves, BGR
LEGEND_HEIGHT = 20  # height of one line of the legend [px]
Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Panel:
    """One plot; blank if it has no points. With `log`, both axes are logarithmic and coordinates must be positive."""

    title: str
    measured: Points = ()
    expected: Points = ()
    log: bool = False
    theory: str = "theory"  # label of the line through `expected`
    curves: Mapping[str, Points] = field(default_factory=dict)  # a name has the same colour in all panels


def draw_panels(out: Path, panels: Sequence[Panel], columns: int = 3) -> None:
    """Write the panels as a PNG, in rows of `columns`, with a legend below. Raises InputError if it is not writable."""
    names = list(dict.fromkeys(name for panel in panels for name in panel.curves))
    colours = {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}
    rows = [list(panels[i : i + columns]) for i in range(0, len(panels), columns)]
    blank = np.full((PANEL_HEIGHT, PANEL_WIDTH, 3), 255, np.uint8)
    cells = [[*(_panel(p, colours) for p in row), *[blank] * (columns - len(row))] for row in rows]
    image = np.vstack([*map(np.hstack, cells), _legend(colours, columns * PANEL_WIDTH)])
    ok, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert ok
    with replacing(out) as part:
        part.write_bytes(png.tobytes())


def _legend(colours: Mapping[str, tuple[int, int, int]], width: int) -> np.ndarray:
    """Legend of the curves, wrapped into as many lines as needed."""
    lines, x = [np.full((LEGEND_HEIGHT, width, 3), 255, np.uint8)], MARGIN
    for name, colour in colours.items():
        if x > MARGIN and x + 40 + 8 * len(name) > width:
            lines, x = [*lines, np.full((LEGEND_HEIGHT, width, 3), 255, np.uint8)], MARGIN
        cv2.line(lines[-1], (x, LEGEND_HEIGHT // 2), (x + 24, LEGEND_HEIGHT // 2), colour, 2, cv2.LINE_AA)
        _text(lines[-1], name, (x + 30, LEGEND_HEIGHT // 2 + 4))
        x += 40 + 8 * len(name)
    return np.vstack(lines)[: LEGEND_HEIGHT * len(lines) if colours else 0]


def _panel(panel: Panel, colours: Mapping[str, tuple[int, int, int]]) -> np.ndarray:
    image = np.full((PANEL_HEIGHT, PANEL_WIDTH, 3), 255, np.uint8)
    scale = np.log10 if panel.log else np.asarray
    every = [*panel.measured, *panel.expected, *(point for curve in panel.curves.values() for point in curve)]
    if not every:
        return image
    both = scale(np.array(every, float))
    low, high = both.min(0), both.max(0)
    if not panel.log:
        low, high = np.minimum(low, 0), np.maximum(high, 0)
    room = 0.06 * np.maximum(high - low, 1e-12)
    low, high = np.where(panel.log | (low < 0), low - room, low), high + room
    area = np.array([PANEL_WIDTH - MARGIN - 16, PANEL_HEIGHT - MARGIN - 34])

    def to_pixels(points: Points) -> np.ndarray:
        at = (scale(np.array(points, float)) - low) / (high - low) * area
        return np.stack([MARGIN + at[:, 0], PANEL_HEIGHT - MARGIN - at[:, 1]], 1).round().astype(int)

    for axis in (0, 1):
        for tick in _ticks(low[axis], high[axis], panel.log):
            at = round(float((tick - low[axis]) / (high[axis] - low[axis]) * area[axis]))
            text = f"{10**tick if panel.log else tick:.4g}"
            if axis == 0:
                cv2.line(image, (MARGIN + at, 34), (MARGIN + at, PANEL_HEIGHT - MARGIN), GRID, 1)
                _text(image, text, (MARGIN + at - 4 * len(text), PANEL_HEIGHT - MARGIN + 18))
            else:
                cv2.line(
                    image, (MARGIN, PANEL_HEIGHT - MARGIN - at), (PANEL_WIDTH - 16, PANEL_HEIGHT - MARGIN - at), GRID, 1
                )
                _text(image, text, (MARGIN - 6 - 7 * len(text), PANEL_HEIGHT - MARGIN - at + 4))
    if len(panel.expected):
        cv2.polylines(image, [to_pixels(panel.expected)], False, RED, 1, cv2.LINE_AA)
    for name, points in panel.curves.items():
        if len(points):
            cv2.polylines(image, [to_pixels(points)], False, colours[name], 2, cv2.LINE_AA)
    for x, y in to_pixels(panel.measured) if len(panel.measured) else ():
        cv2.circle(image, (int(x), int(y)), 4, BLUE, -1, cv2.LINE_AA)
    cv2.rectangle(image, (MARGIN, 34), (PANEL_WIDTH - 16, PANEL_HEIGHT - MARGIN), INK, 1)
    _text(image, panel.title, (MARGIN, 22), 0.44)
    if len(panel.measured):
        _text(
            image, "o measured" + (f"   - {panel.theory}" if len(panel.expected) else ""), (MARGIN, PANEL_HEIGHT - 12)
        )
    return image


def _ticks(low: float, high: float, log: bool) -> list[float]:
    """A few round numbers between the ends; on a log axis powers of ten, with multiples 2 and 5 if those are few."""
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
