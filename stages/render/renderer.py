"""Renderer of one or several animations with their backgrounds and cameras, side by side in every image."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import SceneObject
from stages.render.animation import Animation
from stages.render.background import RenderBackground
from stages.render.camera_paths import camera_path, scale_cameras
from stages.render.draw import RenderedView, colour_by_object, colour_depth, depth_range, render_view
from stages.render.object_labels import add_legend, draw_labels, visible_ids
from stages.render.options import RenderOptions
from stages.render.overlay import draw_arrows, draw_caption, force_arrows, grid_columns, tile_images
from stages.render.subject import Subject, find_subject, merge_subjects

if TYPE_CHECKING:
    from stages.core.physics.shadow_casting import ShadowCaster

log = logging.getLogger(__name__)
SAME_CAMERAS = 1e-3  # largest difference between equal cameras: of positions [extent], and of rotation matrix entries

Image = Float[Tensor, "h w 3"]
Views = list[list[RenderedView]]  # one row per camera, one column per clip


@dataclass(frozen=True)
class Clip:
    """One animation with its background."""

    animation: Animation
    options: RenderOptions
    background: RenderBackground
    device: str
    name: str = ""  # caption, used if there are several clips

    def gaussians(self, time: float) -> Gaussians:
        """All Gaussians to render at `time` [s]."""
        return self._prepared(time) if self.animation.is_moving else self._static

    @cached_property
    def _static(self) -> Gaussians:
        return self._prepared(0.0)

    def _prepared(self, time: float) -> Gaussians:
        shown = self.shaded(time)
        return colour_by_object(shown) if self.options.ids else shown

    def shaded(self, time: float) -> Gaussians:
        """The Gaussians at `time` [s], with the chosen background and the shadows of moved objects."""
        g = self.background.compose(self.animation.gaussians(time).to(self.device))
        if self.shadows is None:
            return g
        positions = self.animation.interpolate(time, self.animation.trajectory.positions)
        return self.shadows.shade(g, positions, self._rest_irradiance)

    @cached_property
    def shadows(self) -> ShadowCaster | None:
        """The shadow caster; None for scenes at rest, with --ids, --depth or --shadows off, or without keypoints."""
        trajectory, options = self.animation.trajectory, self.options
        if options.shadows == "off" or options.ids or options.depth or trajectory is None or trajectory.dense:
            return None
        if bool((trajectory.positions == trajectory.keypoints.rest).all()):
            return None
        from stages.core.physics.shadow_casting import find_shadows  # noqa: PLC0415 -- 0.3 s of scipy

        return find_shadows(self.animation.scene, trajectory.keypoints, not self.background.keep_scene, self.device)

    @cached_property
    def _rest_irradiance(self) -> Float[Tensor, "n"]:
        return self.shadows.rest_irradiance(self.background.compose(self.animation.scene.gaussians.to(self.device)))

    def render(self, time: float, cameras: Cameras, indices: list[int]) -> list[RenderedView]:
        """Views of the cameras at `indices` at `time` [s]; object numbers and force arrows as the options ask."""
        gaussians = self.gaussians(time)
        views = [render_view(gaussians, cameras, i, self.background) for i in indices]
        if self.options.ids:
            objects = self.animation.scene.objects
            images = [draw_labels(v.image, visible_ids(gaussians, cameras, i), objects)
                      for v, i in zip(views, indices, strict=True)]  # fmt: skip
            views = [v._replace(image=image) for v, image in zip(views, images, strict=True)]
        if self.options.show_forces:
            arrows = force_arrows(self.animation, time)
            images = [draw_arrows(v.image, cameras, i, arrows) for v, i in zip(views, indices, strict=True)]
            views = [v._replace(image=image) for v, image in zip(views, images, strict=True)]
        return views


@dataclass(frozen=True)
class Renderer:
    """Renders its clips side by side in one image; passed to the writers of output formats."""

    clips: Sequence[Clip]
    options: RenderOptions

    @cached_property
    def longest(self) -> Animation:
        """The animation that determines the duration; shorter ones hold their last frame."""
        return max((clip.animation for clip in self.clips), key=lambda animation: animation.duration)

    @property
    def is_moving(self) -> bool:
        """Whether any Gaussians change over time."""
        return self.longest.is_moving

    @property
    def fps(self) -> float:
        """Frames per second: from the options, else the highest rate of the moving clips."""
        moving = [clip.animation.fps for clip in self.clips if clip.animation.is_moving]
        return float(self.options.fps or max(moving, default=self.longest.fps))

    def light_facts(self) -> dict:
        """The light that casts the shadows, as recorded next to the output."""
        lights = [asdict(clip.shadows.light) for clip in self.clips if clip.shadows is not None]
        return {"light": lights if len(lights) > 1 else lights[0]} if lights else {}

    def cameras(self, frames: int, resolution: int) -> list[Cameras]:
        """For each clip one camera per frame or, with --view all, every stored camera.

        Clips whose stored cameras agree share a path that frames all of them. Raises InputError if --view needs stored
        cameras and there are none, or if --view all finds different numbers of them.
        """
        animations = [clip.animation for clip in self.clips]
        stored = [animation.scene.cameras for animation in animations]
        subjects = [find_subject(animation) for animation in animations]
        first = next((c for c in stored if c is not None), None)
        if all(c is None or _same_cameras(first, c) for c in stored):
            return [self._path(first, merge_subjects(subjects), frames, resolution)] * len(animations)
        log.warning("the cameras of the files differ, so that each file is rendered with its own camera path")
        paths = [self._path(c, subject, frames, resolution) for c, subject in zip(stored, subjects, strict=True)]
        if len({len(path) for path in paths}) > 1:
            raise InputError("--view all: the files contain different numbers of cameras; choose another --view")
        return paths

    def _path(self, stored: Cameras | None, subject: Subject, frames: int, resolution: int) -> Cameras:
        if self.options.view != "all":
            return camera_path(self.options.view, stored, subject, frames, resolution)
        if stored is None:
            raise InputError("--view all: the file contains no cameras; use --view novel or --view orbit")
        return scale_cameras(stored, max(16, 2 * resolution // grid_columns(len(stored))))

    def render(self, time: float, cameras: list[Cameras], indices: list[int]) -> Views:
        """Views of the cameras at `indices` at `time` [s]: for each camera, one view per clip."""
        columns = [clip.render(time, c, indices) for clip, c in zip(self.clips, cameras, strict=True)]
        return [list(row) for row in zip(*columns, strict=True)]

    def compose(
        self, views: Views, span: tuple[float, float] | None, columns: int = 1, captions: Sequence[str] = ()
    ) -> Image:
        """Compose all views to one image, a grid of `columns`: colour, or depth in the range `span`.

        The views of a camera are side by side in one cell, under its caption if there is one. With --ids a legend is
        added on the right.
        """
        images = [self._side_by_side(row, span) for row in views]
        if captions:
            images = [draw_caption(image, text) for image, text in zip(images, captions, strict=True)]
        image = images[0] if len(images) == 1 else tile_images(images, columns)
        return add_legend(image, self._objects) if self.options.ids else image

    @cached_property
    def _objects(self) -> list[SceneObject]:
        """Objects of all clips, sorted by number; objects of the same number and name appear once."""
        named = {(o.id, o.name): o for clip in self.clips for o in clip.animation.scene.objects}
        return [named[key] for key in sorted(named)]

    def _side_by_side(self, row: list[RenderedView], span: tuple[float, float] | None) -> Image:
        images = [v.image if span is None else colour_depth(v.depth, span) for v in row]
        if len(images) == 1:
            return images[0]
        images = [draw_caption(image, clip.name, below=True) for image, clip in zip(images, self.clips, strict=True)]
        return tile_images(images, len(images))


def views_depth_range(views: Views) -> tuple[float, float]:
    """Depth range of several views, for `Renderer.compose`."""
    return depth_range([view.depth for row in views for view in row])


def depth_facts(span: tuple[float, float] | None) -> dict:
    """The depth range as recorded next to the output."""
    return {} if span is None else {"depth_near": span[0], "depth_far": span[1]}


def _same_cameras(a: Cameras, b: Cameras) -> bool:
    """Whether two files have the same cameras, and therefore the same world frame."""
    if a.viewmats.shape != b.viewmats.shape:
        return False
    p, q = centres(a.viewmats), centres(b.viewmats)
    extent = (p - p.mean(0)).norm(dim=1).max().clamp_min(1e-9)
    rotated = (a.viewmats[:, :3, :3] - b.viewmats[:, :3, :3]).abs().max()
    return bool((p - q).norm(dim=1).max() <= SAME_CAMERAS * extent) and bool(rotated <= SAME_CAMERAS)
