"""traj.h5 | scene.ply -> MP4 | PNG"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.backends import pick_device
from stages.errors import InputError
from stages.render.backdrop import Backdrop, open_backdrop
from stages.render.draw import Seen, depth_colours, depth_range, false_colour, look
from stages.render.footage import Footage, open_footage
from stages.render.options import RenderOptions
from stages.render.overlay import arrows_at, caption, columns_for, draw_arrows, tile
from stages.render.paths import camera_path, scaled
from stages.render.subject import subject_of
from stages.scene.cameras import Cameras
from stages.scene.files import provenance, replacing
from stages.scene.gaussians import Gaussians
from stages.scene.images import VideoWriter, write_depth, write_jpeg, write_png

log = logging.getLogger(__name__)
MOMENTS, ACROSS = 12, 4  # of a contact sheet

Image = Float[Tensor, "h w 3"]


def run(source: Path, out: Path | None, options: RenderOptions) -> Path:
    """Films a trajectory or a scene: an MP4, or a PNG, which of a moving scene is a sheet of 12 moments.

    Where it was written goes to stdout; what made it, into a JSON file beside it.
    """
    source = Path(source)
    device = pick_device(options.device)
    footage = open_footage(source, options.frame, device)
    out = Path(out) if out is not None else _beside(source, footage, options)
    if out.suffix.lower() not in (".mp4", ".png", ".jpg"):
        raise InputError(f"{out}: pictures are written as .mp4, .png or .jpg; give it one of these endings")
    studio = Studio(footage, options, open_backdrop(options.background), device)
    made = (film if out.suffix.lower() == ".mp4" else still)(out, studio)
    used = [Path(p) for p in (source, options.background, options.view) if p is not None and Path(p).is_file()]
    facts = {**provenance("render", used, options), **made, "scene": footage.scene.provenance}
    with replacing(out.with_name(f"{out.name}.json")) as part:
        part.write_text(json.dumps(facts, indent=1) + "\n")
    print(out)
    return out


def _beside(source: Path, footage: Footage, options: RenderOptions) -> Path:
    """traj.h5 -> traj_novel.mp4; a picture where neither the scene nor the camera moves."""
    still = not footage.moves and (options.view == "all" or options.view.startswith("input:"))
    return source.with_name(f"{source.stem}_{options.label}{'.png' if still else '.mp4'}")


@dataclass(frozen=True)
class Studio:
    """Everything needed to take pictures."""

    footage: Footage
    options: RenderOptions
    backdrop: Backdrop
    device: str

    def cameras(self, frames: int, resolution: int) -> Cameras:
        """A viewpoint a frame; for "all", every stored one."""
        stored = self.footage.scene.cameras
        if self.options.view != "all":
            return camera_path(self.options.view, stored, subject_of(self.footage), frames, resolution)
        if stored is None:
            raise InputError("--view all: the file holds no cameras; use --view novel or --view orbit")
        return scaled(stored, max(16, 2 * resolution // columns_for(len(stored))))

    def scene_at(self, time: float) -> Gaussians:
        return self._prepared(self.footage.gaussians(time)) if self.footage.moves else self._resting

    @cached_property
    def _resting(self) -> Gaussians:
        return self._prepared(self.footage.gaussians(0.0))

    def _prepared(self, gaussians: Gaussians) -> Gaussians:
        shown = self.backdrop.around(gaussians.to(self.device))
        return false_colour(shown) if self.options.ids else shown

    def seen(self, time: float, cameras: Cameras, indices: list[int]) -> list[Seen]:
        """What some of the cameras see at a time, with arrows where they are asked for."""
        gaussians = self.scene_at(time)
        views = [look(gaussians, cameras, i, self.backdrop) for i in indices]
        if self.options.show_forces:
            arrows = arrows_at(self.footage, time)
            images = [draw_arrows(v.image, cameras, i, arrows) for v, i in zip(views, indices, strict=True)]
            views = [v._replace(image=image) for v, image in zip(views, images, strict=True)]
        return views

    def picture(self, views: list[Seen], span: tuple[float, float] | None, columns: int = 1) -> Image:
        """Views side by side, in colour, or as depth between the bounds of `span`."""
        images = [v.image if span is None else depth_colours(v.depth, span) for v in views]
        return images[0] if len(images) == 1 else tile(images, columns)


def film(out: Path, studio: Studio) -> dict:
    """Frame by frame; depth keeps one range of colours throughout, taken from three of the frames."""
    times = studio.footage.times(studio.options.fps)
    cameras = studio.cameras(len(times), studio.options.resolution)
    together = studio.options.view == "all"
    columns = columns_for(len(cameras))

    def shots(i: int) -> list[Seen]:
        return studio.seen(times[i], cameras, list(range(len(cameras))) if together else [i])

    span = None
    if studio.options.depth:
        span = depth_range([v.depth for i in {0, len(times) // 2, len(times) - 1} for v in shots(i)])
    fps = float(studio.options.fps or studio.footage.fps)
    with VideoWriter(out, fps) as video:
        for i in tqdm(range(len(times)), unit="frame"):
            video.append(studio.picture(shots(i), span, columns))
    return {"frames": len(times), "fps": fps, **_depth_facts(span)}


def still(out: Path, studio: Studio) -> dict:
    """One picture; of a scene that moves, a sheet of moments (of all cameras: its first frame)."""
    options, footage = studio.options, studio.footage
    if options.view == "all":
        cameras = studio.cameras(1, options.resolution)
        views, columns = studio.seen(0.0, cameras, list(range(len(cameras)))), columns_for(len(cameras))
    elif footage.moves:
        views, columns = list(_moments(studio)), ACROSS
    else:
        views, columns = studio.seen(0.0, studio.cameras(1, options.resolution), [0]), 1
    if options.depth and len(views) == 1 and out.suffix.lower() == ".png":
        return _write_depth(out, views[0].depth)
    span = depth_range([v.depth for v in views]) if options.depth else None
    write = write_jpeg if out.suffix.lower() == ".jpg" else write_png
    write(out, studio.picture(views, span, columns))
    return {"views": len(views), **_depth_facts(span)}


def _moments(studio: Studio) -> Iterator[Seen]:
    """Evenly spaced stored frames from first to last, each with its time."""
    footage = studio.footage
    count = min(MOMENTS, len(footage.trajectory))
    frames = [round(i * (len(footage.trajectory) - 1) / (count - 1)) for i in range(count)]
    cameras = studio.cameras(count, 2 * studio.options.resolution // ACROSS)
    for i, frame in enumerate(tqdm(frames, unit="frame")):
        view = studio.seen(frame / footage.fps, cameras, [i])[0]
        yield view._replace(image=caption(view.image, f"{frame / footage.fps:.2f} s"))


def _write_depth(out: Path, depth: Float[Tensor, "h w"]) -> dict:
    """16 bits in thousandths of a scene unit, or in coarser steps where the scene is deeper than 65 units."""
    unit = 1e-3
    while float(depth.max()) > 65535 * unit:
        unit *= 10
    write_depth(out, depth, unit)
    return {"depth_unit": unit}


def _depth_facts(span: tuple[float, float] | None) -> dict:
    return {} if span is None else {"depth_near": span[0], "depth_far": span[1]}
