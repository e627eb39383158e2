"""traj.h5 | scene.ply -> MP4 | PNG"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.scene.files import provenance, replacing
from stages.core.scene.images import VideoWriter, write_depth, write_jpeg, write_png
from stages.render.animation import Animation, open_animation
from stages.render.background import open_background
from stages.render.draw import RenderedView, depth_range
from stages.render.options import RenderOptions
from stages.render.overlay import grid_columns
from stages.render.renderer import Clip, Renderer

MOMENTS, ACROSS = 12, 4  # of a contact sheet
MOST = 8  # files side by side


def run(source: Path | Sequence[Path], out: Path | None, options: RenderOptions) -> Path:
    """Films a trajectory or a scene: an MP4, or a PNG, which of a moving scene is a sheet of 12 moments.

    Several files are filmed side by side. Where it was written goes to stdout; what made it, into a JSON beside it.
    """
    sources = [Path(source)] if isinstance(source, (str, Path)) else [Path(s) for s in source]
    _check_count(sources, options)
    device = pick_device(options.device)
    films = [open_animation(s, options.frame, device) for s in sources]
    takes = [Clip(footage, options, open_background(options.background, footage.scene), device, name)
             for footage, name in zip(films, _names(sources), strict=True)]  # fmt: skip
    studio = Renderer(takes, options)
    out = Path(out) if out is not None else _beside(sources, studio)
    if out.suffix.lower() not in (".mp4", ".png", ".jpg"):
        raise InputError(f"{out}: pictures are written as .mp4, .png or .jpg; give it one of these endings")
    made = (film if out.suffix.lower() == ".mp4" else still)(out, studio)
    used = [Path(p) for p in (*sources, options.background, options.view) if p is not None and Path(p).is_file()]
    scenes = [take.footage.scene.provenance for take in takes]
    facts = {**provenance("render", used, options), **made, "scene": scenes[0] if len(scenes) == 1 else scenes}
    with replacing(out.with_name(f"{out.name}.json")) as part:
        part.write_text(json.dumps(facts, indent=1) + "\n")
    print(out)
    return out


def _check_count(sources: list[Path], options: RenderOptions) -> None:
    """One file, or several with --side-by-side."""
    if len(sources) > 1 and not options.side_by_side:
        raise InputError(f"{len(sources)} files: give --side-by-side to film them together, or one at a time")
    if len(sources) == 1 and options.side_by_side:
        raise InputError(f"--side-by-side: {sources[0]} is alone; give two files or more")
    if len(sources) > MOST:
        raise InputError(f"--side-by-side: at most {MOST} files find room, not {len(sources)}")


def _names(sources: list[Path]) -> list[str]:
    """What the files are called, with as much of their folders as tells them apart."""
    for depth in range(1, max(len(s.parts) for s in sources) + 1):
        names = ["/".join(s.with_suffix("").parts[-depth:]) for s in sources]
        if len(set(names)) == len(names):
            return names
    return [f"{s.stem} {i}" for i, s in enumerate(sources, start=1)]  # the same file, more than once


def _beside(sources: list[Path], studio: Renderer) -> Path:
    """traj.h5 -> traj_novel.mp4, a.h5 b.h5 -> a_b_novel.mp4; a picture where neither scene nor camera moves."""
    options = studio.options
    still = not studio.moves and (options.view == "all" or options.view.startswith("input:"))
    stem = "_".join(s.stem for s in sources)
    return sources[0].with_name(f"{stem}_{options.label}{'.png' if still else '.mp4'}")


def film(out: Path, studio: Renderer) -> dict:
    """Frame by frame; depth keeps one range of colours throughout, taken from three of the frames."""
    fps = studio.fps
    times = studio.longest.times(fps)
    cameras = studio.cameras(len(times), studio.options.resolution)
    together = studio.options.view == "all"
    columns = grid_columns(len(cameras[0]))

    def shots(i: int) -> list[list[RenderedView]]:
        return studio.seen(times[i], cameras, list(range(len(cameras[0]))) if together else [i])

    span = None
    if studio.options.depth:
        span = _depth_range([row for i in {0, len(times) // 2, len(times) - 1} for row in shots(i)])
    with VideoWriter(out, fps) as video:
        for i in tqdm(range(len(times)), unit="frame"):
            video.append(studio.picture(shots(i), span, columns))
    return {"frames": len(times), "fps": fps, **_depth_facts(span)}


def still(out: Path, studio: Renderer) -> dict:
    """One picture; of a scene that moves, a sheet of moments (of all cameras: its first frame)."""
    options, captions = studio.options, []
    if options.view == "all":
        cameras = studio.cameras(1, options.resolution)
        views, columns = studio.seen(0.0, cameras, list(range(len(cameras[0])))), grid_columns(len(cameras[0]))
    elif studio.moves:
        times = _moments(studio.longest)
        across = max(1, ACROSS // len(studio.takes))
        cameras = studio.cameras(len(times), 2 * options.resolution // ACROSS)
        views = [studio.seen(t, cameras, [i])[0] for i, t in enumerate(tqdm(times, unit="frame"))]
        captions, columns = [f"{t:.2f} s" for t in times], across
    else:
        views, columns = studio.seen(0.0, studio.cameras(1, options.resolution), [0]), 1
    if options.depth and len(views) == len(studio.takes) == 1 and out.suffix.lower() == ".png":
        return _write_depth(out, views[0][0].depth)
    span = _depth_range(views) if options.depth else None
    write = write_jpeg if out.suffix.lower() == ".jpg" else write_png
    write(out, studio.picture(views, span, columns, captions))
    return {"views": sum(len(row) for row in views), **_depth_facts(span)}


def _moments(footage: Animation) -> list[float]:
    """Times of evenly spaced stored frames from first to last [s]."""
    count, last = min(MOMENTS, len(footage.trajectory)), len(footage.trajectory) - 1
    return [round(i * last / (count - 1)) / footage.fps for i in range(count)]


def _depth_range(rows: list[list[RenderedView]]) -> tuple[float, float]:
    return depth_range([view.depth for row in rows for view in row])


def _write_depth(out: Path, depth: Float[Tensor, "h w"]) -> dict:
    """16 bits in thousandths of a scene unit, or in coarser steps where the scene is deeper than 65 units."""
    unit = 1e-3
    while float(depth.max()) > 65535 * unit:
        unit *= 10
    write_depth(out, depth, unit)
    return {"depth_unit": unit}


def _depth_facts(span: tuple[float, float] | None) -> dict:
    return {} if span is None else {"depth_near": span[0], "depth_far": span[1]}
