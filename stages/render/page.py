"""Output format page: one HTML file that plays the animation in a browser and lets the user look around."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from stages.core.errors import InputError
from stages.core.player.film import Motion, film_page, pack_film
from stages.core.player.playable import playable_parts
from stages.core.scene.files import replacing
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Binding
from stages.render.background import RenderBackground
from stages.render.renderer import Clip, Renderer
from stages.render.subject import find_subject

MAX_KEYPOINTS = 65536  # a page numbers keypoints with 16 bits
COLOUR_MODES = {"ids": 1, "depth": 2}  # option -> initial colour mode of the page


def write_page(out: Path, renderer: Renderer) -> dict:
    """Write the page; returns its size and the numbers of Gaussians and frames.

    Raises InputError for anything that a page cannot show: several files, all views at once, a photo behind the
    objects, and trajectories that store every Gaussian; with `playable` for motions of engines other than the learned
    one.
    """
    options = renderer.options
    _check(out, renderer)
    clip = renderer.clips[0]
    scene, motion = _contents(clip)
    if options.playable:
        motion = replace(motion, field=playable_parts(clip.animation.trajectory))
    camera = renderer.cameras(1, options.resolution)[0]
    modes = [mode for name, mode in COLOUR_MODES.items() if getattr(options, name)]
    settings = {
        "view": {"viewmat": camera.viewmats[0].tolist(), "K": camera.Ks[0].tolist(), "size": camera.sizes[0].tolist()},
        "target": find_subject(clip.animation).target.tolist(),
        "colours": modes[0] if modes else 0,
        "arrows": options.show_forces,
    }
    page = film_page(pack_film(scene, motion, settings, clip.shadows if motion else None), clip.name)
    with replacing(out) as part:
        part.write_text(page, encoding="utf-8")
    frames = 1 if motion is None else len(motion.positions)
    return {"frames": frames, "gaussians": len(scene.gaussians), "bytes": len(page.encode()),
            **renderer.light_facts()}  # fmt: skip


def _check(out: Path, renderer: Renderer) -> None:
    options, clip = renderer.options, renderer.clips[0]
    if len(renderer.clips) > 1:
        raise InputError(f"{out}: a page can show only one file; omit --side-by-side, or write a video (.mp4)")
    if options.view == "all":
        raise InputError(f"{out}: --view all only works with images; omit it, as a page lists the views of all photos")
    if clip.background.photo is not None:
        raise InputError(f"{out}: the --background of a page must be a colour or a scene.ply, not a photo")
    trajectory = clip.animation.trajectory
    if options.playable and not clip.animation.is_moving:
        raise InputError(f"--playable: {clip.name} has no motion to continue; give a trajectory and omit --frame")
    if clip.animation.is_moving and len(trajectory.keypoints.rest) > MAX_KEYPOINTS:
        raise InputError(f"{trajectory.path}: has {len(trajectory.keypoints.rest)} keypoints, but a page can hold "
                         f"{MAX_KEYPOINTS}; simulate with fewer --keypoints, or write a video (.mp4)")  # fmt: skip
    if clip.animation.is_moving and trajectory.dense:
        raise InputError(f"{trajectory.path}: stores every Gaussian of every frame, which a page cannot hold; write a "
                         "video (.mp4), or one frame with --frame")  # fmt: skip


def _contents(clip: Clip) -> tuple[Scene, Motion | None]:
    """The scene with the chosen background, and its motion; a frozen frame is a scene at rest without motion."""
    animation, background = clip.animation, clip.background
    if not animation.is_moving:
        return replace(animation.scene, gaussians=clip.shaded(0.0).to("cpu"), background=background.colour), None
    gaussians = animation.scene.gaussians.to("cpu")
    scene = replace(animation.scene, gaussians=gaussians, background=background.colour)
    motion = Motion.of(animation.trajectory)
    kept = _kept_rows(scene, background)
    if kept is None:
        return scene, motion
    added = 0 if background.gaussians is None else len(background.gaussians)
    own = gaussians[kept]
    scene = replace(scene, gaussians=own if not added else concatenate([background.gaussians.to("cpu"), own]))
    index, weight = motion.binding.index[kept], motion.binding.weight[kept]
    unbound = torch.full((added, index.shape[1]), -1), torch.zeros(added, index.shape[1])
    return scene, replace(motion, binding=Binding(torch.cat([unbound[0], index]), torch.cat([unbound[1], weight])))


def _kept_rows(scene: Scene, background: RenderBackground) -> torch.Tensor | None:
    """Rows of the scene's Gaussians that RenderBackground.compose keeps; None if it changes nothing."""
    ids = scene.gaussians.object_id
    if background.keep_scene:
        return None
    return (ids > 0 if (ids > 0).any() else ids == 0).nonzero()[:, 0]
