"""Contact sheet of the data set: one row of rendered frames for each of several scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
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
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.images import write_jpeg
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.trajectory import Keypoints
from stages.lab.assets.backgrounds import BACKGROUNDS, make_background
from stages.lab.assets.objects import OBJECTS, make_object
from stages.lab.dataset.cameras import orbit_cameras
from stages.lab.dataset.gaussian_frames import compose_scene
from stages.lab.dataset.keypoint_motions import KeypointMotions, read_motions
from stages.lab.dataset.layout import Layout, object_kind
from stages.lab.dataset.object_particles import at_scale_prior
from stages.lab.dataset.scene_configs import SceneConfig, read_scene_configs
from stages.render.background import RenderBackground
from stages.render.draw import render_view
from stages.render.overlay import draw_caption, tile_images

SHEET_COLUMNS, IMAGE_SIZE = 6, 200  # images per row and their width and height [px]
VIEW_STEP = 12  # orbit views from one row to the next, so that the rows show different sides
JPEG_QUALITY = 88


@dataclass(frozen=True)
class SheetOptions:
    """Which scenes to show: `count` of them, distributed evenly over the groups."""

    groups: tuple[str, ...]
    count: int = 10
    device: str = "auto"

    def __post_init__(self):
        if not 1 <= self.count <= 40:
            raise InputError(f"--scenes {self.count}: give 1 to 40 rows")


def write_sheet(data: Path, out: Path, options: SheetOptions) -> None:
    """Write a JPEG with one row of SHEET_COLUMNS frames, from first to last, for each chosen scene.

    Raises InputError if the data set has none of the groups.
    """
    layout, device = Layout(Path(data)), pick_device(options.device)
    groups = [g for g in options.groups if layout.motions(g).is_file()]
    if not groups:
        raise InputError(f"{data}: contains none of {', '.join(options.groups)} (motions/*.h5); generate them "
                         "with `ngff-lab "
                         "dataset`")  # fmt: skip
    images = []
    object_gaussians = cache(lambda name: _object_gaussians(layout, name))
    background_gaussians = cache(lambda name: _background_gaussians(layout, name).to(device))
    chosen = tqdm(_choose_scenes(layout, groups, options.count), total=options.count, desc="sheet", unit="scene")
    for row, (config, motion) in enumerate(chosen):
        gaussians = background_gaussians(list(BACKGROUNDS)[row % len(BACKGROUNDS)])
        background = RenderBackground(keep_scene=False, gaussians=gaussians)
        images += _render_row(config, motion, object_gaussians, background, VIEW_STEP * row % 100, device)
    write_jpeg(out, tile_images(images, SHEET_COLUMNS), JPEG_QUALITY)


def _choose_scenes(layout: Layout, groups: Sequence[str], count: int) -> Iterator[tuple[SceneConfig, KeypointMotions]]:
    """`count` scenes, group by group, evenly spaced within each group."""
    per_group = {g: len(range(n, count, len(groups))) for n, g in enumerate(groups)}
    for group in groups:
        motions, configs = read_motions(layout.motions(group)), read_scene_configs(layout.config(group))
        for k in range(per_group[group]):
            row = k * len(motions) // per_group[group]
            yield configs[motions.names[row]], motions[slice(row, row + 1)]


def _render_row(
    config: SceneConfig, motion: KeypointMotions, object_gaussians: Callable[[str], Gaussians],
    background: RenderBackground, view: int, device: str,
) -> list[Float[Tensor, "h w 3"]]:  # fmt: skip
    scene = compose_scene(config, [object_gaussians(object_kind(i).name) for i in config.ids])
    count = len(config.ids)
    points = motion.points[0, :, :count].flatten(1, 2)  # (t, o n, 3)
    owner = torch.arange(1, count + 1).repeat_interleave(motion.points.shape[3])
    keypoints = Keypoints(points[0], owner)
    skinning = Skinning(scene.gaussians.to(device), bind_gaussians(scene, keypoints), keypoints)
    cameras, out = orbit_cameras(IMAGE_SIZE), []
    for k in range(SHEET_COLUMNS):
        t = round(k * (len(points) - 1) / (SHEET_COLUMNS - 1))
        image = render_view(background.compose(skinning(points[t])), cameras, view, background).image
        time = f"{t * motion.dt:.2f} s"
        out.append(draw_caption(image, f"{config.name}  {time}" if k == 0 else time))
    return out


def _object_gaussians(layout: Layout, name: str) -> Gaussians:
    """An object at its scale prior, from the file of the data set, or generated if the file is missing."""
    path = layout.object(name)
    return at_scale_prior(read_scene(path).gaussians if path.exists() else make_object(name), OBJECTS[name].scale)


def _background_gaussians(layout: Layout, name: str) -> Gaussians:
    path = layout.background(name)
    return read_scene(path).gaussians if path.exists() else make_background(name)
