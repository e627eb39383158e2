"""The points backend: objects at points that the user gives in photos, segmented by the network of `learned`."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.models.segmenter.clicks import Click, clicked_ids
from stages.core.models.segmenter.segment import find, load_segmenter
from stages.core.perception.object_limits import ObjectLimits
from stages.core.raster.rasterise import rasterise
from stages.core.scene.lens import Undistortion, photo_of
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.schema import quote
from stages.segment.options import SegmentOptions

FORM = re.compile(r"(?:view=(?P<view>\S+)\s+)?xy=(?P<x>[0-9.]+),(?P<y>[0-9.]+)(?:\s+name=(?P<name>.+))?")


@dataclass(frozen=True)
class PointPrompt:
    """A point on an object in a photo."""

    view: str  # name of the photo, with or without its suffix; empty: the first photo
    xy: tuple[float, float]  # [px]
    name: str  # of the object; points with the same name are on the same object
    text: str  # of the option, for error messages


def parse_points(texts: tuple[str, ...]) -> list[PointPrompt]:
    """Parse points of the command line, such as "view=a.jpg xy=310,220 name=duck".

    Each point without a name is on an object of its own, object_1 and so on. Raises InputError for other forms.
    """
    out = []
    for text in texts:
        found = FORM.fullmatch(text.strip())
        try:
            x, y = float(found["x"]), float(found["y"])
        except (TypeError, ValueError) as error:
            raise InputError(f'--points {quote(repr(text))}: write "view=IMG.jpg xy=310,220 name=duck"; the '
                             'default view is '
                             "the first photo") from error  # fmt: skip
        out.append(PointPrompt(found["view"] or "", (x, y), found["name"] or f"object_{len(out) + 1}", text))
    return out


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """Label the objects at the points; everything else is background.

    Raises InputError for a scene without cameras, unknown photos, points outside their photo, and if no object is found
    at any point.
    """
    if scene.cameras is None or not len(scene.cameras):
        raise InputError("--points: the scene has no cameras; give a scene written by `ngff reconstruct`")
    prompts = parse_points(options.points)
    names = list(dict.fromkeys(p.name for p in prompts))
    clicks = [Click(_surface(scene, p, options.undistorted), names.index(p.name) + 1, p.text) for p in prompts]
    model = load_segmenter(find(options.weights), pick_device(options.device))
    ids = clicked_ids(scene, model, clicks, ObjectLimits(options.max_objects, options.min_size))
    present = set(ids.unique().tolist())
    objects = tuple(SceneObject(i, name) for i, name in enumerate(names, start=1) if i in present)
    return replace(scene, gaussians=replace(scene.gaussians, object_id=ids), objects=objects)


def _surface(scene: Scene, prompt: PointPrompt, undistorted: bool) -> Float[Tensor, "3"]:
    """The surface point of the scene at a point of a photo, in the world frame."""
    cameras = scene.cameras
    views = {Path(name).stem: i for i, name in enumerate(cameras.names)} | {n: i for i, n in enumerate(cameras.names)}
    view = views.get(prompt.view) if prompt.view else 0
    if view is None:
        raise InputError(f"--points {quote(repr(prompt.text))}: the scene has no photo of this name; its first "
                         "photo is "
                         f"{cameras.names[0]}")  # fmt: skip
    size = photo_of(cameras, view, undistorted)[1]
    x, y = Undistortion.of(cameras, view, size, undistorted).points(torch.tensor([prompt.xy]))[0].tolist()
    width, height = cameras.sizes[view].tolist()
    if not (0 <= x < width and 0 <= y < height):
        raise InputError(f"--points {quote(repr(prompt.text))}: is outside the photo, which has {size[0]}x{size[1]} "
                         "pixels")  # fmt: skip
    K, viewmat = cameras.Ks[view], cameras.viewmats[view]
    depth = rasterise(scene.gaussians, viewmat[None], K[None], width, height).depth[0].reshape(height, width)
    ray = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones(())])
    return centres(viewmat[None])[0] + viewmat[:3, :3].mT @ (ray * depth[int(y), int(x)])
