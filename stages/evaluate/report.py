"""HTML report in one file: a table, curves as inline SVG, and inline images."""

from __future__ import annotations

import base64
import math
import tempfile
from html import escape
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from stages.core.scene.files import replacing
from stages.core.scene.images import resize, write_png
from stages.evaluate.result import Curve, Pictures, Result, format_number

WIDTH, HEIGHT, LEFT, BOTTOM = 720, 280, 60, 36  # size of the plot, and its margins for labels [px]
LINE_COLOURS = ("#1f6fb4", "#d1491f", "#2e8b57", "#8e44ad", "#b8860b", "#16808a", "#c2185b", "#5d6d7e")
MAX_IMAGE_SIDE = 420  # longest side of an image in the report [px]
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 900px; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse } th, td { padding: .25em .9em; text-align: right; border-bottom: 1px solid #ddd }
th:first-child, td:first-child { text-align: left } figure { margin: 1.2em 0 }
figcaption, .notes { color: #555 } svg text { font: 12px system-ui, sans-serif; fill: #444 }
"""


def write_report(path: Path, result: Result, prediction: Path, truth: Path) -> None:
    """Write the report, which refers to no other file. A report of trajectories includes a player of the prediction."""
    title = f"{Path(prediction).name} against {Path(truth).name}"
    body = [f"<h1>{escape(title)}</h1>", _table(result)]
    body += [f'<p class="notes">{escape(note)}</p>' for note in result.notes]
    body += [_plot(result)] if result.curves and len(result.curves[0].values) > 1 else []
    body += [_legend(result)] if result.legend else []
    body += [_figure(pictures) for pictures in result.pictures]
    style = STYLE
    if result.kind == "trajectories":
        from stages.evaluate import film_section as film  # only this kind needs Warp, which takes long to import

        body[1:1] = [film.film_section(prediction)]
        body, style = [*body, f"<script>{film.SCRIPT}</script>"], STYLE + film.STYLE
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{style}</style>'
    with replacing(path) as part:
        page = f"<!doctype html>\n<html><head>{head}</head><body>\n" + "\n".join(body) + "\n</body></html>\n"
        part.write_bytes(page.encode(errors="replace"))  # file names need not be UTF-8


def _table(result: Result) -> str:
    columns = result.columns()
    head = "".join(f"<th>{escape(c)}</th>" for c in ["", *columns])
    rows = [
        f"<tr><td>{escape(name)}</td>{''.join(f'<td>{format_number(row.get(c))}</td>' for c in columns)}</tr>"
        for name, row in result.rows()
    ]
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"


def _plot(result: Result) -> str:
    """Plot the curves in the unit of the axis; SSIM has another unit and is only in the JSON."""
    curves = [c for c in result.curves if c.name != "SSIM"]
    count = len(curves[0].values)
    top = _round_up(max((v for c in curves for v in c.values if math.isfinite(v)), default=1.0))
    seconds = (count - 1) / result.fps if result.fps else None
    across = [_tick(LEFT + f * (WIDTH - LEFT - 10), _time(f, count, seconds)) for f in (0.0, 0.25, 0.5, 0.75, 1.0)]
    up = [_level(f, f * top) for f in (0.0, 0.5, 1.0)]
    lines = [_line(c, top, LINE_COLOURS[i % len(LINE_COLOURS)]) for i, c in enumerate(curves)]
    names = " ".join(
        f'<span style="color:{LINE_COLOURS[i % len(LINE_COLOURS)]}">&#9632; {escape(c.name)}</span>'
        for i, c in enumerate(curves)
    )
    cursor = (f'<line id="cursor" data-left="{LEFT}" data-right="{WIDTH - 10}" x1="{LEFT}" x2="{LEFT}" y1="16" '
              f'y2="{HEIGHT - BOTTOM}" stroke="#d65c00" stroke-dasharray="4 3"/>')  # fmt: skip
    svg = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{"".join([*up, *across, *lines, cursor])}</svg>'
    return f"<figure>{svg}<figcaption>{escape(result.curve_title)}: {names}</figcaption></figure>"


def _line(curve: Curve, top: float, colour: str) -> str:
    count = len(curve.values)
    points = [
        f"{LEFT + i / (count - 1) * (WIDTH - LEFT - 10):.1f},{_y(v / top):.1f}"
        for i, v in enumerate(curve.values) if math.isfinite(v)
    ]  # fmt: skip
    return f'<polyline points="{" ".join(points)}" fill="none" stroke="{colour}" stroke-width="2"/>'


def _y(fraction: float) -> float:
    return HEIGHT - BOTTOM - fraction * (HEIGHT - BOTTOM - 16)


def _level(fraction: float, value: float) -> str:
    y = _y(fraction)
    grid_line = f'<line x1="{LEFT}" x2="{WIDTH - 10}" y1="{y:.1f}" y2="{y:.1f}" stroke="#ddd"/>'
    return f'{grid_line}<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:.3g}</text>'


def _tick(x: float, text: str) -> str:
    return f'<text x="{x:.1f}" y="{HEIGHT - 12}" text-anchor="middle">{text}</text>'


def _time(fraction: float, count: int, seconds: float | None) -> str:
    return f"{fraction * (count - 1):.0f}" if seconds is None else f"{fraction * seconds:.2g} s"


def _round_up(value: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten."""
    if value <= 0:
        return 1.0
    step = 10.0 ** math.floor(math.log10(value))
    return next(m * step for m in (1, 2, 5, 10) if m * step >= value * (1 - 1e-9))


def _legend(result: Result) -> str:
    """Names of the colours in the pictures."""
    colours = {name: ",".join(str(round(255 * x)) for x in rgb) for name, rgb in result.legend.items()}
    names = [f'<span style="color:rgb({rgb})">&#9632;</span> {escape(name)}' for name, rgb in colours.items()]
    return f'<p class="notes">{" &nbsp; ".join(names)}</p>'


def _figure(pictures: Pictures) -> str:
    """Images side by side, in order."""
    width = 98 // len(pictures.images)
    images = "".join(
        f'<img alt="{escape(name)}" style="max-width:{width}%" src="data:image/png;base64,{_png(image)}"> '
        for name, image in pictures.images.items()
    )
    names = escape(", ".join(pictures.images))
    return f"<figure>{images}<figcaption>{names}; {escape(pictures.caption)}</figcaption></figure>"


def _png(image: Float[Tensor, "h w 3"]) -> str:
    """Base64 of an image as PNG, reduced to MAX_IMAGE_SIDE."""
    h, w = image.shape[:2]
    factor = min(1.0, MAX_IMAGE_SIDE / max(h, w))
    image = resize(image, max(1, round(w * factor)), max(1, round(h * factor)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.png"
        write_png(path, image)
        return base64.b64encode(path.read_bytes()).decode()
