"""Object files in the layout of the data set, and portraits of objects and backgrounds for overview sheets."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import centres, intrinsics, look_at, orbit
from stages.core.geometry.harmonics import rgb_to_sh
from stages.core.geometry.neighbours import knn
from stages.core.raster.rasterise import rasterise
from stages.core.scene.files import replacing
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.images import resize
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.lab.assets.objects import POINT_CLOUD
from stages.render.overlay import draw_caption

VIEWS, RESOLUTION = 100, 1280  # number of cameras in cameras.json, and their image side [px]
SHEET_BACKGROUND = torch.tensor([0.955, 0.95, 0.94])  # background colour of portraits


def write_object(folder: Path, g: Gaussians, name: str, provenance: dict) -> None:
    """Write FOLDER/point_cloud/iteration_30000/point_cloud.ply, and a camera orbit as FOLDER/cameras.json."""
    ply = folder / POINT_CLOUD
    ply.parent.mkdir(parents=True, exist_ok=True)
    with replacing(folder / "cameras.json") as part:
        part.write_text(json.dumps(camera_rows(orbit(VIEWS, torch.zeros(3), 2.4, 20.0), RESOLUTION)))
    # written last: a folder with this file is complete
    write_scene(ply, Scene(g, (SceneObject(1, name),), None, None, provenance=provenance))


def camera_rows(viewmats: Float[Tensor, "c 4 4"], size: int) -> list[dict]:
    """Cameras in the JSON format of 3D Gaussian Splatting: camera-to-world rotation, principal point at the centre.

    Images have `size` px on each side and the focal length of the data set.
    """
    rows = zip(viewmats[:, :3, :3].mT.tolist(), centres(viewmats).tolist(), strict=True)
    return [
        {"id": i, "img_name": f"{i:05d}", "width": size, "height": size, "position": position, "rotation": rotation,
         "fx": 1.5 * size, "fy": 1.5 * size}
        for i, (rotation, position) in enumerate(rows)
    ]  # fmt: skip


def object_portrait(g: Gaussians, elevation: float, label: str, size: int = 280) -> Float[Tensor, "h w 3"]:
    """Image of an object, fitted to the frame, on white ground with a shadow; camera `elevation` in [deg]."""
    side = float((g.means.amax(0) - g.means.amin(0)).max())
    g = replace(g, means=g.means / side, scales=g.scales / side)
    eye = 2.2 * _direction(elevation)
    return _labelled_image(concatenate([_ground(g), g]), eye, torch.zeros(3), (size, size), 1.6 * size, label)


def background_portrait(g: Gaussians, label: str) -> Float[Tensor, "h w 3"]:
    """Image of a background with the whole table, from a corner of the room."""
    eye = torch.tensor([0.0, 0, -1.1]) + 6.9 * _direction(24.0, -52.0)
    return _labelled_image(g, eye, torch.tensor([0.0, 0, -1.1]), (340, 255), 330.0, label)


def _direction(elevation: float, azimuth: float = -75.0) -> Float[Tensor, "3"]:
    """Unit vector with these angles [deg]."""
    el, az = torch.deg2rad(torch.tensor([elevation, azimuth])).unbind()
    return torch.stack([el.cos() * az.cos(), el.cos() * az.sin(), el.sin()])


def _labelled_image(
    g: Gaussians, eye: Tensor, target: Tensor, size: tuple[int, int], focal: float, label: str
) -> Float[Tensor, "h w 3"]:
    """Image of `size` (width, height) px with a caption, rendered at twice the size and downscaled."""
    width, height = size
    K = intrinsics(2 * width, 2 * height, 2 * focal)
    drawn = rasterise(g, look_at(eye, target)[None], K[None], 2 * width, 2 * height, SHEET_BACKGROUND)
    return draw_caption(resize(drawn.rgb[0].clamp(0, 1), width, height), label)


def _ground(g: Gaussians) -> Gaussians:
    """Ground plane of flat Gaussians under an object, dark near the object and transparent far from it."""
    step = 0.025
    line = torch.arange(-1.3, 1.3, step)
    flat = torch.nn.functional.pad(torch.cartesian_prod(line, line), (0, 1), value=float(g.means[:, 2].min()) - 0.004)
    near = knn(g.means[::7].contiguous(), flat, 1)[0][:, 0]
    rgb = SHEET_BACKGROUND * (1 - 0.55 * torch.exp(-near / 0.09))[:, None]
    n = len(flat)
    return Gaussians(
        flat, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.tensor([[0.02, 0.02, 0.001]]).repeat(n, 1),
        0.97 * torch.exp(-((near / 0.6) ** 4)), rgb_to_sh(rgb), torch.zeros(n, dtype=torch.int64),
    )  # fmt: skip
