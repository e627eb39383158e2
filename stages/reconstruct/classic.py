"""The classic backend: structure from motion, multi-view depth, then Gaussians fitted to the photos."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

import torch
from torch import Tensor

from stages.errors import InputError
from stages.geometry.cameras import depths, resize
from stages.geometry.rotations import multiply, quaternion
from stages.geometry.similarity import Similarity
from stages.reconstruct import depth, initialise, photometric, sfm, upright
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.photos import Photos, Reconstruction, Views, undistort
from stages.scene.cameras import Cameras, Lenses, read_cameras
from stages.scene.gaussians import Gaussians, concatenate
from stages.scene.scene import Scene

log = logging.getLogger(__name__)
FAR = 3.0  # what has no depth is put so many camera distances away
FARTHEST = 10.0  # Gaussians farther from the focus than so many camera distances are dropped


def reconstruct(photos: Photos, options: ReconstructOptions) -> Reconstruction:
    """Gaussians of what the photos show, upright, with the cameras that took them."""
    device = _device(options.device)
    model, photos = _cameras(photos, options, device)
    views = undistort(photos, model.cameras, model.lenses, options.side)
    focus = upright.focus_of(model.cameras.viewmats, _typical_depths(model))
    first = upright.find_ground(model.points, model.cameras.viewmats, focus, options.seed)
    trained, held = _split(views, options.holdout)
    part = _restrict(model, trained)
    used = views[trained]
    maps = depth.estimate(used, part, first.plane, device)
    least = 2 if len(used) > 3 else 1
    cloud = initialise.fuse(used, maps, least)
    if len(cloud) < 1000:
        raise InputError(f"{photos.source}: the photos agree on the depth of too few places; {sfm.ADVICE}")
    log.info("%d depth samples confirmed by %d or more other photos", len(cloud), least)
    cloud = initialise.thin(cloud, options.level.gaussians, focus, first.radius)
    ground = upright.find_ground(cloud.points, used.cameras.viewmats, focus, options.seed)
    if ground.plane is None:
        log.info("no supporting plane found: up is how the cameras were held, the floor is at the lowest points")
    else:
        log.info("the supporting plane holds %.0f %% of the points in focus", 100 * ground.share)
    move = upright.to_world(ground, cloud.points, used.cameras.viewmats, metric=options.cameras is not None)
    gaussians = _first_gaussians(used, maps, cloud, ground, least, options)
    gaussians = _cropped(_moved(gaussians, move), move(ground.focus), move.scale * ground.radius)
    views = dataclasses.replace(views, cameras=views.cameras.moved(move))
    reach = move.scale * ground.radius
    steps = options.steps(len(used), device)
    known = [torch.where(m.support >= least, m.depth * move.scale, torch.zeros_like(m.depth)) for m in maps]
    gaussians = photometric.refine(gaussians, views[trained], steps, reach, options.seed, device, known)
    facts = {"upright": _plain(move), "supporting_plane": ground.plane is not None}
    scene = Scene(gaussians, cameras=views.cameras, floor=0.0, scale=_scale(options), provenance=facts)
    return Reconstruction(scene, views, trained, held)


def _device(name: str) -> str:
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: no CUDA device is available here; use --device cpu")
    return name


def _cameras(photos: Photos, options: ReconstructOptions, device: str) -> tuple[sfm.SparseModel, Photos]:
    """Cameras and sparse points: solved for, or triangulated with the cameras that the user gave."""
    if options.cameras is None:
        return sfm.solve(photos, options.seed, device), photos
    cameras, lenses = read_cameras(options.cameras)
    row = {name: i for i, name in enumerate(cameras.names)}
    both = [i for i, name in enumerate(photos.names) if name in row]
    if len(both) < 2:
        raise InputError(
            f"{options.cameras}: names {len(both)} of the photos in {photos.source}; its file_path entries must end "
            f"in the photos' names, such as {photos.names[0]}"
        )
    if len(both) < len(photos):
        log.info("no camera is given for, and left out: %s", ", ".join(sorted(set(photos.names) - set(row))))
    photos = photos[both]
    rows = [row[name] for name in photos.names]
    cameras, lenses = _in_pixels_of(photos, cameras[rows]), Lenses(lenses.coefficients[rows])
    return sfm.triangulate(photos, cameras, lenses, options.seed), photos


def _in_pixels_of(photos: Photos, cameras: Cameras) -> Cameras:
    """The cameras with K for photos as loaded, which may be smaller than the files."""
    sizes = torch.tensor([photos.size(i) for i in range(len(photos))])
    share = sizes / cameras.sizes
    Ks = torch.stack([resize(K, float(sx), float(sy)) for K, (sx, sy) in zip(cameras.Ks, share, strict=True)])
    return Cameras(cameras.viewmats, Ks, sizes, cameras.names)


def _typical_depths(model: sfm.SparseModel) -> Tensor:
    """Median depth of the sparse points that each camera sees."""
    out = []
    for i, viewmat in enumerate(model.cameras.viewmats):
        seen = model.seen_point[model.seen_view == i]
        z = depths(model.points[seen], viewmat) if len(seen) else depths(model.points, viewmat).clamp_min(0)
        out.append(z.median())
    return torch.stack(out)


def _split(views: Views, holdout: int) -> tuple[list[int], list[int]]:
    """Indices of the photos to learn from and of those kept out."""
    held = [i for i in range(len(views)) if holdout and i % holdout == 0]
    return [i for i in range(len(views)) if i not in held], held


def _restrict(model: sfm.SparseModel, index: list[int]) -> sfm.SparseModel:
    """The model as some of its cameras see it."""
    new = torch.full((len(model.cameras),), -1)
    new[index] = torch.arange(len(index))
    keep = new[model.seen_view] >= 0
    return sfm.SparseModel(
        model.cameras[index], Lenses(model.lenses.coefficients[index]), model.points,
        model.seen_point[keep], new[model.seen_view[keep]],
    )  # fmt: skip


def _first_gaussians(
    views: Views, maps: list[depth.DepthMap], cloud: initialise.Cloud, ground: upright.Ground, least: int, options
) -> Gaussians:
    """Confirmed points, and fainter, sparser ones where the photos show something no depth was confirmed at."""
    more = initialise.fill(views, maps, cloud, ground.plane, least, FAR * ground.radius)
    more = initialise.thin(more, options.level.gaussians // 4, ground.focus, ground.radius)
    log.info("%d Gaussians on confirmed surfaces, %d on surfaces filled in", len(cloud), len(more))
    degree = options.level.degree
    parts = [initialise.to_gaussians(cloud, torch.full((len(cloud),), 0.8), degree)]
    if len(more) > 10:
        parts.append(initialise.to_gaussians(more, torch.full((len(more),), 0.5), degree))
    return concatenate(parts)


def _moved(gaussians: Gaussians, move: Similarity) -> Gaussians:
    """Before any colour depends on direction, so the harmonics need no turning."""
    turn = quaternion(move.rotation).expand(len(gaussians), 4)
    means, scales = move(gaussians.means), gaussians.scales * move.scale
    return dataclasses.replace(gaussians, means=means, quats=multiply(turn, gaussians.quats), scales=scales)


def _cropped(gaussians: Gaussians, focus: Tensor, radius: float) -> Gaussians:
    """Without what lies absurdly far away."""
    return gaussians[(gaussians.means - focus).norm(dim=1) < FARTHEST * radius]


def _scale(options: ReconstructOptions) -> dict:
    if options.cameras is not None:
        return {"metres_per_unit": 1.0, "source": f"cameras in {Path(options.cameras).name}, taken as metres"}
    return {"metres_per_unit": 1.0, "source": "assumed: cameras about 1 m from the scene"}


def _plain(move: Similarity) -> dict:
    return {"scale": move.scale, "rotation": move.rotation.tolist(), "translation": move.translation.tolist()}
