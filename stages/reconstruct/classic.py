"""The classic backend: structure from motion, multi-view stereo, and Gaussians fitted to the photos."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import depths, resize
from stages.core.scene.cameras import Cameras, LensDistortion, read_cameras
from stages.core.scene.lens import ASPECT_TOLERANCE
from stages.reconstruct import depth, sfm, world_frame
from stages.reconstruct.build_scene import SceneGeometry, build_scene
from stages.reconstruct.matching import MatchingOptions
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.photos import Photos, Reconstruction, split_holdout, undistort
from stages.reconstruct.step_cache import StepCache

log = logging.getLogger(__name__)


def reconstruct(photos: Photos, options: ReconstructOptions, steps: StepCache) -> Reconstruction:
    """Backend `classic`: cameras by COLMAP or as given, depth by plane sweep, Gaussians by a photometric fit."""
    device = pick_device(options.device)
    model, photos = _cameras(photos, options, device, steps)
    return reconstruct_from_model(photos, model, options, steps, device)


def reconstruct_from_model(
    photos: Photos, model: sfm.SparseModel, options: ReconstructOptions, steps: StepCache, device: str
) -> Reconstruction:
    """Run the steps after structure from motion; the model has a camera for each photo."""
    views = undistort(photos, model.cameras, model.lenses, options.max_side)
    focus = world_frame.focus_point(model.cameras.viewmats, _typical_depths(model))
    ground = world_frame.find_ground(model.points, model.cameras.viewmats, focus, options.seed, options.up)
    trained, held_out = split_holdout(len(views), options.holdout)
    used, part = views[trained], _subset(model, trained)
    maps = steps.cached("depth", lambda: depth.estimate_depth_maps(used, part, ground.plane, device), (depth.DepthMap,))
    found = SceneGeometry(
        photos.source, views, trained, held_out, maps, min_support=2 if len(used) > 3 else 1, focus=focus,
        radius=ground.radius, dropped=model.dropped,
    )  # fmt: skip
    return build_scene(found, options, steps, device)


def _cameras(
    photos: Photos, options: ReconstructOptions, device: str, steps: StepCache
) -> tuple[sfm.SparseModel, Photos]:
    """Cameras and sparse points, estimated or triangulated with given cameras; and the photos that have a camera."""
    matching = MatchingOptions(options.matcher, options.seed, device)
    if options.cameras is None:
        return sfm.estimate_cameras(photos, matching, steps), photos
    cameras, lenses = read_cameras(options.cameras)
    row = {name: i for i, name in enumerate(cameras.names)}
    both = [i for i, name in enumerate(photos.names) if name in row]
    if len(both) < 2:
        raise InputError(
            f"{options.cameras}: names {len(both)} of the photos in {photos.source}; its image paths must end in "
            f"the photos' names, such as {photos.names[0]}"
        )
    if len(both) < len(photos):
        log.info("photos without a given camera are left out: %s", ", ".join(sorted(set(photos.names) - set(row))))
    photos = photos[both]
    rows = [row[name] for name in photos.names]
    cameras = _rescale_to_photos(photos, cameras[rows], options.cameras)
    lenses = LensDistortion(lenses.coefficients[rows])
    return sfm.triangulate(photos, cameras, lenses, matching, steps), photos


def _rescale_to_photos(photos: Photos, cameras: Cameras, source: Path) -> Cameras:
    """Scale K to pixels of the loaded photos, which may be smaller than the files.

    Raises InputError, which names the file `source` of the cameras, if one has another aspect ratio than its photo.
    """
    sizes = torch.tensor([photos.size(i) for i in range(len(photos))])
    ratio = sizes / cameras.sizes
    wrong = ((ratio[:, 0] / ratio[:, 1] - 1).abs() > ASPECT_TOLERANCE).nonzero().flatten().tolist()
    if wrong:
        (w, h), (width, height) = cameras.sizes[wrong[0]].tolist(), photos.file_size(wrong[0])
        raise InputError(
            f"{source}: says that {cameras.names[wrong[0]]} has {w}x{h} pixels, but upright the photo has "
            f"{width}x{height}; estimate the cameras from these photos, saved upright"
        )
    Ks = torch.stack([resize(K, float(sx), float(sy)) for K, (sx, sy) in zip(cameras.Ks, ratio, strict=True)])
    return replace(cameras, Ks=Ks, sizes=sizes)


def _typical_depths(model: sfm.SparseModel) -> Tensor:
    """Median depth of the sparse points observed by each camera."""
    out = []
    for i, viewmat in enumerate(model.cameras.viewmats):
        seen = model.point_index[model.view_index == i]
        z = depths(model.points[seen], viewmat) if len(seen) else depths(model.points, viewmat).clamp_min(0)
        out.append(z.median())
    return torch.stack(out)


def _subset(model: sfm.SparseModel, index: list[int]) -> sfm.SparseModel:
    """The model with some of its cameras and their observations."""
    new = torch.full((len(model.cameras),), -1)
    new[index] = torch.arange(len(index))
    keep = new[model.view_index] >= 0
    return sfm.SparseModel(
        model.cameras[index], LensDistortion(model.lenses.coefficients[index]), model.points,
        model.point_index[keep], new[model.view_index[keep]],
    )  # fmt: skip
