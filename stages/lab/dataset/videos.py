"""Videos of the data set, rendered as by `ngff render`: 100 views of the first frame, and views over time.

    initial/<group>/<scene>/<background>/   <scene>.mp4    the first frame from every camera of the orbit
                                            cameras.json   the cameras of these frames
                                            prompts.json   center_point, bbox [px of view 0] and text of each object
                                            depth.h5       depth (v,h,w) uint16 from 0 to depth_max, for the cameras
                                                           `view`; 0: no surface
    dynamic/.../view_<i>/<scene>.mp4        the scene over time from camera i of the orbit

Source: public code of NGFF. The published videos are MPEG-4 part 2, these are H.264.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import h5py
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import project
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.images import VideoWriter
from stages.lab.assets.splat_files import camera_rows
from stages.lab.dataset.cameras import orbit_cameras
from stages.lab.dataset.gaussian_frames import SkinnedScene
from stages.lab.dataset.layout import object_kind
from stages.lab.dataset.options import FRAME_INTERVAL
from stages.lab.dataset.scene_configs import SceneConfig
from stages.lab.dataset.selection import ORBIT_VIEWS
from stages.render.background import RenderBackground
from stages.render.draw import render_view

FPS = 1 / FRAME_INTERVAL


def write_initial(
    folder: Path, config: SceneConfig, rest: Gaussians, background: Gaussians, resolution: int, views: Sequence[int]
) -> None:
    """Write the `initial` files of a scene over one background.

    `rest` holds its Gaussians in the first frame and `background` those behind it, on the same device. Depth is stored
    for the orbit cameras `views`.
    """
    cameras, backdrop = orbit_cameras(resolution), RenderBackground(keep_scene=False, gaussians=background)
    gaussians, depths = backdrop.compose(rest), []
    with VideoWriter(folder / f"{config.name}.mp4", FPS) as video:
        for i in range(ORBIT_VIEWS):
            rendered = render_view(gaussians, cameras, i, backdrop)
            video.append(rendered.image)
            if i in views:
                depths.append(rendered.depth.cpu())
    (folder / "cameras.json").write_text(json.dumps(camera_rows(cameras.viewmats, resolution)))
    (folder / "prompts.json").write_text(json.dumps(prompts(config, rest, cameras)))
    (folder / "depth.h5").write_bytes(_depth_file(torch.stack(depths), views))


def prompts(config: SceneConfig, rest: Gaussians, cameras: Cameras) -> dict[str, list]:
    """Projected centre and bounding box [px] of each object in view 0, and its text prompt."""
    width, height = cameras.sizes[0].tolist()
    size = torch.tensor([width, height], dtype=torch.float32)
    centres, boxes = [], []
    for n in range(1, len(config.ids) + 1):
        pixels = project(rest.means[rest.object_id == n].cpu(), cameras.viewmats[0], cameras.Ks[0])
        centres.append(pixels.mean(0).tolist())
        low, high = (v.clamp_min(0).minimum(size).tolist() for v in (pixels.amin(0), pixels.amax(0)))
        boxes.append([*low, *high])
    return {"center_point": centres, "bbox": boxes, "text": [object_kind(i).prompt for i in config.ids]}


def _depth_file(depth: Float[Tensor, "v h w"], views: Sequence[int]) -> memoryview:
    max_depth = max(float(depth.max()), 1e-6)
    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        quantised = (depth / max_depth * 65535).round().numpy().astype(np.uint16)
        file.create_dataset("depth", data=quantised, chunks=(1, *quantised.shape[1:]), compression="gzip",
                            compression_opts=4, shuffle=True)  # fmt: skip
        file["depth_max"] = np.float32(max_depth)
        file["view"] = np.array(views, np.int64)
    return memory.getbuffer()


def write_dynamic(
    paths: dict[int, Path], scene: SkinnedScene, x: Sequence[Tensor], F: Sequence[Tensor], background: Gaussians,
    resolution: int,
) -> None:  # fmt: skip
    """Write one video for each view in `paths`.

    `x` and `F` are the particle positions (p, 3) [m] and deformation gradients (p, 3, 3) of each frame.
    """
    cameras, backdrop = orbit_cameras(resolution), RenderBackground(keep_scene=False, gaussians=background)
    for path in paths.values():
        path.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        videos = {i: stack.enter_context(VideoWriter(path, FPS)) for i, path in paths.items()}
        for positions, gradients in zip(x, F, strict=True):
            gaussians = backdrop.compose(scene.at(positions, gradients)[0])
            for i, video in videos.items():
                video.append(render_view(gaussians, cameras, i, backdrop).image)
