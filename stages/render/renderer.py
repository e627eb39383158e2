"""Everything needed to take pictures: what moves, what stands behind it, and cameras, for one film or several."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.render.animation import Animation
from stages.render.background import RenderBackground
from stages.render.camera_paths import camera_path, scale_cameras
from stages.render.draw import RenderedView, colour_by_object, colour_depth, render_view
from stages.render.options import RenderOptions
from stages.render.overlay import draw_arrows, draw_caption, force_arrows, grid_columns, tile_images
from stages.render.subject import Subject, find_subject, merge_subjects

log = logging.getLogger(__name__)
SAME = 1e-3  # cameras of one world agree to this share of their distance from each other

Image = Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class Clip:
    """One film as it is shown: its footage with what stands behind it."""

    footage: Animation
    options: RenderOptions
    backdrop: RenderBackground
    device: str
    name: str = ""  # written below it when there are several

    def scene_at(self, time: float) -> Gaussians:
        return self._prepared(self.footage.gaussians(time)) if self.footage.moves else self._resting

    @cached_property
    def _resting(self) -> Gaussians:
        return self._prepared(self.footage.gaussians(0.0))

    def _prepared(self, gaussians: Gaussians) -> Gaussians:
        shown = self.backdrop.compose(gaussians.to(self.device))
        return colour_by_object(shown) if self.options.ids else shown

    def seen(self, time: float, cameras: Cameras, indices: list[int]) -> list[RenderedView]:
        """What some of the cameras see at a time, with arrows where they are asked for."""
        gaussians = self.scene_at(time)
        views = [render_view(gaussians, cameras, i, self.backdrop) for i in indices]
        if self.options.show_forces:
            arrows = force_arrows(self.footage, time)
            images = [draw_arrows(v.image, cameras, i, arrows) for v, i in zip(views, indices, strict=True)]
            views = [v._replace(image=image) for v, image in zip(views, images, strict=True)]
        return views


@dataclass(frozen=True)
class Renderer:
    """One or several takes, which stand side by side in every picture."""

    takes: Sequence[Clip]
    options: RenderOptions

    @cached_property
    def longest(self) -> Animation:
        """The footage that decides how long to film; a shorter one stands still when it has ended."""
        return max((take.footage for take in self.takes), key=lambda footage: footage.duration)

    @property
    def moves(self) -> bool:
        return self.longest.moves

    @property
    def fps(self) -> float:
        """Frames a second: the highest rate of what moves, unless another was asked for."""
        moving = [take.footage.fps for take in self.takes if take.footage.moves]
        return float(self.options.fps or max(moving, default=self.longest.fps))

    def cameras(self, frames: int, resolution: int) -> list[Cameras]:
        """For each take a viewpoint a frame; for "all", every stored one. Takes of one world share their viewpoints."""
        footages = [take.footage for take in self.takes]
        stored = [footage.scene.cameras for footage in footages]
        subjects = [find_subject(footage) for footage in footages]
        first = next((c for c in stored if c is not None), None)
        if all(c is None or _agree(first, c) for c in stored):
            return [self._path(first, merge_subjects(subjects), frames, resolution)] * len(footages)
        log.warning("the files hold different worlds (their cameras differ): each is filmed by a camera of its own")
        paths = [self._path(c, subject, frames, resolution) for c, subject in zip(stored, subjects, strict=True)]
        if len({len(path) for path in paths}) > 1:
            raise InputError("--view all: the files hold different numbers of cameras; choose another --view")
        return paths

    def _path(self, stored: Cameras | None, subject: Subject, frames: int, resolution: int) -> Cameras:
        if self.options.view != "all":
            return camera_path(self.options.view, stored, subject, frames, resolution)
        if stored is None:
            raise InputError("--view all: the file holds no cameras; use --view novel or --view orbit")
        return scale_cameras(stored, max(16, 2 * resolution // grid_columns(len(stored))))

    def seen(self, time: float, cameras: list[Cameras], indices: list[int]) -> list[list[RenderedView]]:
        """What some of the cameras see at a time: for each of them, the views of the takes."""
        rows = [take.seen(time, c, indices) for take, c in zip(self.takes, cameras, strict=True)]
        return [list(views) for views in zip(*rows, strict=True)]

    def picture(
        self, views: list[list[RenderedView]], span: tuple[float, float] | None, columns: int = 1,
        captions: Sequence[str] = (),
    ) -> Image:  # fmt: skip
        """Views in rows, in colour, or as depth between the bounds of `span`; each may have a caption."""
        images = [self._side_by_side(row, span) for row in views]
        if captions:
            images = [draw_caption(image, text) for image, text in zip(images, captions, strict=True)]
        return images[0] if len(images) == 1 else tile_images(images, columns)

    def _side_by_side(self, row: list[RenderedView], span: tuple[float, float] | None) -> Image:
        images = [v.image if span is None else colour_depth(v.depth, span) for v in row]
        if len(images) == 1:
            return images[0]
        images = [draw_caption(image, take.name, below=True) for image, take in zip(images, self.takes, strict=True)]
        return tile_images(images, len(images))


def _agree(a: Cameras, b: Cameras) -> bool:
    """Whether two files have the same cameras, and so show the same world."""
    if a.viewmats.shape != b.viewmats.shape:
        return False
    p, q = centres(a.viewmats), centres(b.viewmats)
    reach = (p - p.mean(0)).norm(dim=1).max().clamp_min(1e-9)
    turned = (a.viewmats[:, :3, :3] - b.viewmats[:, :3, :3]).abs().max()
    return bool((p - q).norm(dim=1).max() <= SAME * reach) and bool(turned <= SAME)
