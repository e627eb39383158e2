"""Reconstruction of a synthetic scene from rendered photos, and labels of the surfaces visible to its cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Int
from torch import Tensor
from tqdm import tqdm

from stages.core.raster.rasterise import rasterise, visibility
from stages.core.scene.images import write_jpeg
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.stage import run as reconstruct

BACKDROP = torch.tensor([0.62, 0.66, 0.70])  # background colour of the photos


def reconstruct_from_renders(scene: Scene, folder: Path, options: ReconstructOptions = ReconstructOptions()) -> Scene:  # noqa: B008
    """Render photos from the scene's cameras and reconstruct them with unknown cameras; both are left in `folder`."""
    photos = folder / "photos"
    photos.mkdir(parents=True)
    for i, name in enumerate(tqdm(scene.cameras.names, desc="photos", unit="photo", leave=False)):
        viewmat, K, (width, height) = scene.cameras.viewmats[i], scene.cameras.Ks[i], scene.cameras.sizes[i].tolist()
        drawn = rasterise(scene.gaussians, viewmat[None], K[None], width, height, BACKDROP)
        write_jpeg(photos / name, drawn.rgb[0])
    reconstruct(photos, folder / "scene.ply", options)
    return read_scene(folder / "scene.ply")


def visible_labels(scene: Scene, names: Sequence[str]) -> Int[Tensor, "p"]:
    """Object number of the Gaussian with the largest weight in each pixel, for the named views one after the other."""
    out = []
    for name in names:
        i = scene.cameras.names.index(name)
        width, height = scene.cameras.sizes[i].tolist()
        front = visibility(scene.gaussians, scene.cameras.viewmats[i], scene.cameras.Ks[i], width, height).index
        out.append(torch.where(front >= 0, scene.gaussians.object_id[front.clamp_min(0).long()], 0).flatten())
    return torch.cat(out)
