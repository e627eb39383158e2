"""A picture of scenes of the data set, a row each, from the start to the end, drawn as `ngff render` draws."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.physics.keypoints import bind_gaussians
from stages.core.physics.skinning import Skinning
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.images import write_jpeg
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.trajectory import Keypoints
from stages.lab.assets.backgrounds import BACKGROUNDS, make_background
from stages.lab.assets.objects import OBJECTS, make_object
from stages.lab.dataset.cameras import orbit_cameras
from stages.lab.dataset.gaussian_frames import FLOOR_HEIGHT
from stages.lab.dataset.keypoint_motions import KeypointMotions, read_motions
from stages.lab.dataset.layout import Layout, object_kind
from stages.lab.dataset.object_particles import at_scale_prior
from stages.lab.dataset.scene_configs import SceneConfig, read_scene_configs
from stages.render.background import RenderBackground
from stages.render.draw import render_view
from stages.render.overlay import draw_caption, tile_images

SHEET_COLUMNS, IMAGE_SIZE = 6, 200  # pictures in a row, and their size [px]
VIEW_STEP = 12  # of the orbit from one row to the next, so that scenes are seen from all sides


@dataclass(frozen=True)
class SheetOptions:
    """Which scenes: `count` of them, spread over the groups."""

    groups: tuple[str, ...]
    count: int = 10
    device: str = "auto"

    def __post_init__(self):
        if not 1 <= self.count <= 40:
            raise InputError(f"--scenes {self.count}: from 1 to 40 rows make a sheet")


def write_sheet(data: Path, out: Path, options: SheetOptions) -> None:
    """A JPEG with MOMENTS pictures of each chosen scene."""
    layout, device = Layout(Path(data)), pick_device(options.device)
    groups = [g for g in options.groups if layout.motions(g).is_file()]
    if not groups:
        raise InputError(f"{data}: has none of {', '.join(options.groups)} (motions/*.h5); make them with `ngff-lab "
                         "dataset`")  # fmt: skip
    pictures = []
    body = cache(lambda name: _body(layout, name))
    table = cache(lambda name: _table(layout, name).to(device))
    chosen = tqdm(_chosen(layout, groups, options.count), total=options.count, desc="sheet", unit="scene")
    for row, (config, motions) in enumerate(chosen):
        backdrop = RenderBackground(keep_scene=False, gaussians=table(list(BACKGROUNDS)[row % len(BACKGROUNDS)]))
        pictures += _row(config, motions, body, backdrop, VIEW_STEP * row % 100, device)
    write_jpeg(out, tile_images(pictures, SHEET_COLUMNS), 88)


def _chosen(layout: Layout, groups: Sequence[str], count: int) -> Iterator[tuple[SceneConfig, KeypointMotions]]:
    """Scenes of all groups in turn, from the first to the last of each."""
    of = {g: len(range(n, count, len(groups))) for n, g in enumerate(groups)}
    for group in groups:
        motions, configs = read_motions(layout.motions(group)), read_scene_configs(layout.config(group))
        for k in range(of[group]):
            at = k * len(motions) // of[group]
            yield configs[motions.names[at]], motions[slice(at, at + 1)]


def _row(
    config: SceneConfig, m: KeypointMotions, body, backdrop: RenderBackground, view: int, device: str
) -> list[Float[Tensor, "h w 3"]]:
    parts = []
    for n, (i, p) in enumerate(zip(config.ids, config.translation, strict=True), start=1):
        g = body(object_kind(i).name)
        parts.append(replace(g, means=g.means + torch.tensor(p), object_id=torch.full((len(g),), n)))
    objects = tuple(SceneObject(n, object_kind(i).name) for n, i in enumerate(config.ids, start=1))
    scene = Scene(concatenate(parts), objects, None, FLOOR_HEIGHT)
    points = m.points[0, :, : len(objects)].flatten(1, 2)  # (t, o n, 3)
    owner = torch.arange(1, len(objects) + 1).repeat_interleave(m.points.shape[3])
    keypoints = Keypoints(points[0], owner)
    skinning = Skinning(scene.gaussians.to(device), bind_gaussians(scene, keypoints), keypoints)
    cameras, out = orbit_cameras(IMAGE_SIZE), []
    for k in range(SHEET_COLUMNS):
        t = round(k * (len(points) - 1) / (SHEET_COLUMNS - 1))
        image = render_view(backdrop.compose(skinning(points[t])), cameras, view, backdrop).image
        out.append(draw_caption(image, f"{config.name}  {t * m.dt:.2f} s" if k == 0 else f"{t * m.dt:.2f} s"))
    return out


def _body(layout: Layout, name: str) -> Gaussians:
    """An object at its scale prior, of the data set's own file or made anew."""
    path = layout.object(name)
    return at_scale_prior(read_scene(path).gaussians if path.exists() else make_object(name), OBJECTS[name].scale)


def _table(layout: Layout, name: str) -> Gaussians:
    path = layout.background(name)
    return read_scene(path).gaussians if path.exists() else make_background(name)
