"""The picture of one object that a generator is shown: alone on white, upright, centred, from a camera that saw it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres, depths, intrinsics, look_at, project, resize
from stages.core.geometry.similarity import Similarity
from stages.core.models.diffsplat.maps import FOCAL, RADIUS, cameras
from stages.core.perception.visibility import MAX_VISIBILITY_SIDE as SMALL
from stages.core.raster.rasterise import rasterise, rasterise_features, visibility
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.images import list_photos, read_image
from stages.core.scene.scene import Scene

CROP_FILL = 0.8  # share of the side that the object's longer side takes, as in the public code
TRAINED_ELEVATIONS = (-5.0, 30.0)  # elevations that DiffSplat was trained from [degrees]
STEEP = 75.0  # elevation beyond which a camera has no upright any more [degrees]
AS_GOOD = 0.5  # of the most that any camera sees; among those the elevation decides
FINE = 3  # pixels drawn for one of the portrait, each way


@dataclass(frozen=True)
class ObjectCrop:
    """What was seen from where."""

    image: Float[Tensor, "s s 3"]
    elevation: float  # of the camera above the horizon, as seen from the object [degrees]
    place: Similarity  # DiffSplat's frame to the scene, as far as the camera tells
    name: str  # of the photo


def crop_object(scene: Scene, own: Gaussians, side: int, photos: Path | None = None) -> ObjectCrop | None:
    """An object, `own`, in the photo that shows it best; without `photos` drawn from the Gaussians. None: unseen.

    A camera in the photo's place is turned to the object, and its lens chosen so that the object fills it. So the
    portrait needs no guess of elevation, and where the generated object belongs is known but for errors of its size.
    """
    files = _files(photos, scene) if photos is not None else None
    view = _best(scene, own, files)
    aim = _aimed(scene, own, view, side) if view is not None else None
    if aim is None:
        return None
    viewmat, K, middle = aim
    if files is None:
        picture = rasterise(scene.gaussians, viewmat[None], K[None], side, side).rgb[0].clamp(0, 1)
    else:
        picture = _turned(read_image(files[view]), scene, view, viewmat, K, side)
    alone = _mask(scene.gaussians, own, viewmat, K, side)[..., None]
    eye = centres(viewmat[None])[0]
    elevation = _elevation(eye, middle)
    scale = float((eye - middle).norm()) * FOCAL * side / float(K[0, 0]) / RADIUS
    place = Similarity(scale, viewmat[:3, :3].mT @ cameras(elevation)[0, :3, :3], middle)
    return ObjectCrop(picture * alone + 1 - alone, elevation, place, scene.cameras.names[view])


def _files(photos: Path, scene: Scene) -> dict[int, Path]:
    """The photo of each camera, found by its name up to the suffix."""
    found = {p.stem: p for p in list_photos(photos)}
    names = scene.cameras.names if scene.cameras is not None else ()
    files = {i: found[Path(name).stem] for i, name in enumerate(names) if Path(name).stem in found}
    if not files:
        raise InputError(f"{photos}: holds no photo of the scene" + (f", such as {names[0]}" if names else ""))
    return files


def _best(scene: Scene, own: Gaussians, files: dict[int, Path] | None) -> int | None:
    """The camera that shows most of the object, its whole outline preferred; of similar ones the least steep."""
    worth, tilt, middle = {}, {}, own.means.median(0).values
    for i in range(len(scene.cameras)) if scene.cameras is not None else ():
        viewmat, elevation = scene.cameras.viewmats[i], _elevation(centres(scene.cameras.viewmats[i][None])[0], middle)
        if abs(elevation) > STEEP or (files is not None and i not in files):
            continue
        width, height = scene.cameras.sizes[i].tolist()
        shrink = SMALL / max(width, height)
        w, h = max(1, round(width * shrink)), max(1, round(height * shrink))
        K = resize(scene.cameras.Ks[i], w / width, h / height)
        inside = project(own.means, viewmat, K) / torch.tensor([w, h])
        whole = ((inside >= 0) & (inside <= 1)).all(1) & (depths(own.means, viewmat) > 0)
        weight = visibility(scene.gaussians, viewmat, K, w, h)[1][scene.gaussians.object_id == own.object_id[0]]
        worth[i] = float(weight.sum()) * float(whole.float().mean()) ** 2
        tilt[i] = max(TRAINED_ELEVATIONS[0] - elevation, elevation - TRAINED_ELEVATIONS[1], 0.0)
    top = max(worth.values(), default=0.0)
    good = [i for i, value in worth.items() if value > 0 and value >= AS_GOOD * top]
    return min(good, key=lambda i: (tilt[i], -worth[i]), default=None)


def _elevation(eye: Float[Tensor, "3"], middle: Float[Tensor, "3"]) -> float:
    up = eye - middle
    return math.degrees(math.atan2(float(up[2]), float(up[:2].norm())))


def _aimed(scene: Scene, own: Gaussians, view: int, side: int) -> tuple[Tensor, Tensor, Tensor] | None:
    """A camera in the place of another that looks at the middle of the object: viewmat, K, and that middle."""
    eye = centres(scene.cameras.viewmats[view][None])[0]
    middle = own.means.median(0).values
    for _ in range(2):  # the first look finds the middle of the outline, the second its size from there
        viewmat = look_at(eye, middle)
        reach = float(torch.quantile(project(own.means, viewmat, torch.eye(3)).abs(), 0.99))
        K = intrinsics(side, side, side / 4 / reach)
        rows, columns = torch.nonzero(_mask(scene.gaussians, own, viewmat, K, side) > 0.5, as_tuple=True)
        if not len(rows):
            return None
        low, high = torch.stack([columns.min(), rows.min()]), torch.stack([columns.max(), rows.max()]) + 1
        ray = torch.cat([((low + high) / 2 - side / 2) / K[0, 0], torch.ones(1)])
        near, far = torch.quantile(depths(own.means, viewmat), torch.tensor([0.02, 0.98]))
        middle = eye + (near + far) / 2 * ray @ viewmat[:3, :3]
    return look_at(eye, middle), intrinsics(side, side, float(K[0, 0] * CROP_FILL * side / (high - low).max())), middle


def _mask(
    g: Gaussians, own: Gaussians, viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"], side: int
) -> Float[Tensor, "s s"]:
    """How much of each pixel is the object, others in front of it taken off."""
    alone = (g.object_id == own.object_id[0]).to(g.means)[:, None]
    fine = resize(K, float(FINE), float(FINE))
    drawn = rasterise_features(g, alone, viewmat[None], fine[None], FINE * side, FINE * side)[0, ..., 0]
    return torch.nn.functional.avg_pool2d(drawn[None], FINE)[0].clamp(0, 1)


def _turned(
    photo: Float[Tensor, "h w 3"], scene: Scene, view: int, viewmat: Tensor, K: Tensor, side: int
) -> Float[Tensor, "s s 3"]:
    """A photo as the turned camera would have taken it: pixels move by K_photo R_photo R^T K^-1; white beyond it."""
    width, height = scene.cameras.sizes[view].tolist()
    lens = resize(scene.cameras.Ks[view], photo.shape[1] / width, photo.shape[0] / height).double()
    R = (scene.cameras.viewmats[view, :3, :3] @ viewmat[:3, :3].mT).double()
    half = torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]).double()  # OpenCV's pixel centres are whole numbers
    H = half.inverse() @ lens @ R @ resize(K, float(FINE), float(FINE)).double().inverse() @ half
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    out = cv2.warpPerspective(photo.numpy(), H.numpy(), (FINE * side, FINE * side), flags=flags,
                              borderMode=cv2.BORDER_CONSTANT, borderValue=(1.0, 1.0, 1.0))  # fmt: skip
    return torch.from_numpy(cv2.resize(np.ascontiguousarray(out), (side, side), interpolation=cv2.INTER_AREA))
