"""Output format video: every frame of the animation."""

from __future__ import annotations

from pathlib import Path

from tqdm import tqdm

from stages.core.scene.formats import format_of
from stages.render.overlay import grid_columns
from stages.render.renderer import Renderer, Views, depth_facts, views_depth_range


def write_video(out: Path, renderer: Renderer) -> dict:
    """Render and write all frames; returns their number and rate, and the depth range.

    Colour-coded depth has one range for the whole video, from its first, middle and last frame.
    """
    fps = renderer.fps
    times = renderer.longest.frame_times(fps)
    cameras = renderer.cameras(len(times), renderer.options.resolution)
    all_views = renderer.options.view == "all"
    columns = grid_columns(len(cameras[0]))

    def views(i: int) -> Views:
        return renderer.render(times[i], cameras, list(range(len(cameras[0]))) if all_views else [i])

    span = None
    if renderer.options.depth:
        span = views_depth_range([row for i in {0, len(times) // 2, len(times) - 1} for row in views(i)])
    with format_of(out, "video", writable=True).load_writer()(out, fps) as video:
        for i in tqdm(range(len(times)), unit="frame"):
            video.append(renderer.compose(views(i), span, columns))
    return {"frames": len(times), "fps": fps, **depth_facts(span), **renderer.light_facts()}
