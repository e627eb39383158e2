"""Output format image: one view, all views, or a contact sheet of an animation."""

from __future__ import annotations

from pathlib import Path

from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.scene.formats import format_of
from stages.core.scene.images import write_depth
from stages.render.animation import Animation
from stages.render.overlay import grid_columns
from stages.render.renderer import Renderer, depth_facts, views_depth_range

SHEET_FRAMES, SHEET_COLUMNS = 12, 4  # frames and columns of a contact sheet


def write_image(out: Path, renderer: Renderer) -> dict:
    """Render and write one image; returns the number of views, and the depth range or unit.

    With --view all it shows all cameras at the first frame; otherwise an animation gives a contact sheet of 12 frames.
    The depth of a single view is written as 16-bit PNG.
    """
    options, captions = renderer.options, []
    if options.view == "all":
        cameras = renderer.cameras(1, options.resolution)
        views, columns = renderer.render(0.0, cameras, list(range(len(cameras[0])))), grid_columns(len(cameras[0]))
    elif renderer.is_moving:
        times = _sheet_times(renderer.longest)
        columns = max(1, SHEET_COLUMNS // len(renderer.clips))
        cameras = renderer.cameras(len(times), 2 * options.resolution // SHEET_COLUMNS)
        views = [renderer.render(t, cameras, [i])[0] for i, t in enumerate(tqdm(times, unit="frame"))]
        captions = [f"{t:.2f} s" for t in times]
    else:
        views, columns = renderer.render(0.0, renderer.cameras(1, options.resolution), [0]), 1
    if options.depth and len(views) == len(renderer.clips) == 1 and out.suffix.lower() == ".png":
        return _write_depth(out, views[0][0].depth)
    span = views_depth_range(views) if options.depth else None
    format_of(out, "image", writable=True).load_writer()(out, renderer.compose(views, span, columns, captions))
    return {"views": sum(len(row) for row in views), **depth_facts(span), **renderer.light_facts()}


def _sheet_times(animation: Animation) -> list[float]:
    """Times of evenly spaced stored frames, from first to last [s]."""
    count, last = min(SHEET_FRAMES, len(animation.trajectory)), len(animation.trajectory) - 1
    return [round(i * last / (count - 1)) / animation.fps for i in range(count)]


def _write_depth(out: Path, depth: Float[Tensor, "h w"]) -> dict:
    """Write depth with 16 bits in units of 0.001 scene units, or coarser by factors of ten until all depths fit."""
    unit = 1e-3
    while float(depth.max()) > 65535 * unit:
        unit *= 10
    write_depth(out, depth, unit)
    return {"depth_unit": unit}
