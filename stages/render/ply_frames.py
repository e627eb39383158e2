"""Output format PLY: the Gaussians of one frame, or of all frames in numbered files, which SuperSplat plays."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from stages.core.scene.scene_ply import write_scene
from stages.render.renderer import Renderer
from stages.render.splat_files import LARGE, only_clip

log = logging.getLogger(__name__)


def write_ply_frames(out: Path, renderer: Renderer) -> dict:
    """Write NAME.ply, or for a motion NAME_0000.ply, NAME_0001.ply, ... at the rate of the options, with shadows.

    Returns the number of frames, their rate, and the size of all files. Raises InputError for several clips.
    """
    clip = only_clip(out, renderer)
    scene = clip.animation.scene
    if not renderer.is_moving:
        write_scene(out, replace(scene, gaussians=clip.gaussians(0.0)))
        return {"frames": 1, "bytes": out.stat().st_size, **renderer.light_facts()}
    times, total = clip.animation.frame_times(renderer.fps), 0
    digits = max(4, len(str(len(times) - 1)))
    for i, time in enumerate(tqdm(times, unit="frame")):
        path = out.with_name(f"{out.stem}_{i:0{digits}}{out.suffix}")
        write_scene(path, replace(scene, gaussians=clip.gaussians(time)))
        size = path.stat().st_size
        if not i and size * len(times) > LARGE:
            log.warning("%s: %d files of %.0f MB are written; lower --fps to write fewer", out, len(times), size / 1e6)
        total += size
    return {"frames": len(times), "fps": renderer.fps, "bytes": total, **renderer.light_facts()}
