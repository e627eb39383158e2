"""The input image of a generator: one object alone on white, upright and centred, from a camera that sees it."""

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
from stages.core.perception.visibility import MAX_VISIBILITY_SIDE
from stages.core.raster.rasterise import rasterise, rasterise_features, visibility
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.images import list_photos, read_image
from stages.core.scene.lens import Undistortion
from stages.core.scene.scene import Scene

CROP_FILL = 0.8  # longer side of the object, relative to the side of the crop, as in the public code
TRAINED_ELEVATIONS = (-5.0, 30.0)  # range of the camera elevations of DiffSplat's training images [degrees]
MAX_ELEVATION = 75.0  # elevation beyond which the upright direction of an image is ill-defined [degrees]
MIN_RELATIVE_VISIBILITY = 0.5  # visibility relative to the best camera, above which elevation decides between cameras
SUPERSAMPLING = 3  # pixels rendered per pixel of the crop, in each direction


@dataclass(frozen=True)
class ObjectCrop:
    """An image of one object and the camera that it belongs to."""

    image: Float[Tensor, "s s 3"]
    elevation: float  # of the camera above the horizontal, seen from the object [degrees]
    place: Similarity  # from DiffSplat's frame to the scene, as estimated from the camera
    name: str  # of the photo
    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    coverage: Float[Tensor, "s s"]  # coverage of each pixel by the object, 0..1; the rest is white


def crop_object(scene: Scene, own: Gaussians, side: int, photos: Path | None = None) -> ObjectCrop | None:
    """Image of the object `own` from the photo that shows it best, or rendered without `photos`; None if not visible.

    A virtual camera at the photo's position is rotated towards the object, with a focal length such that the object
    fills the image. It determines the elevation and the approximate pose of the generated object. Raises InputError if
    `photos` contains no photo of the scene.
    """
    files = _files(photos, scene) if photos is not None else None
    view = _best(scene, own, files)
    aim = _rotated_camera(scene, own, view, side) if view is not None else None
    if aim is None:
        return None
    viewmat, K, centre = aim
    if files is None:
        image = rasterise(scene.gaussians, viewmat[None], K[None], side, side).rgb[0].clamp(0, 1)
    else:
        photo = read_image(files[view])
        photo = Undistortion.of(scene.cameras, view, (photo.shape[1], photo.shape[0])).image(photo)
        image = _rotated_photo(photo, scene, view, viewmat, K, side)
    coverage = _mask(scene.gaussians, own, viewmat, K, side)
    alone = coverage[..., None]
    eye = centres(viewmat[None])[0]
    elevation = _elevation(eye, centre)
    scale = float((eye - centre).norm()) * FOCAL * side / float(K[0, 0]) / RADIUS
    place = Similarity(scale, viewmat[:3, :3].mT @ cameras(elevation)[0, :3, :3], centre)
    return ObjectCrop(image * alone + 1 - alone, elevation, place, scene.cameras.names[view], viewmat, K, coverage)


def _files(photos: Path, scene: Scene) -> dict[int, Path]:
    """The photo file of each camera, by name without suffix."""
    found = {p.stem: p for p in list_photos(photos)}
    names = scene.cameras.names if scene.cameras is not None else ()
    files = {i: found[Path(name).stem] for i, name in enumerate(names) if Path(name).stem in found}
    if not files:
        raise InputError(f"{photos}: contains no photo of the scene" + (f", such as {names[0]}" if names else ""))
    return files


def _best(scene: Scene, own: Gaussians, files: dict[int, Path] | None) -> int | None:
    """The camera that shows most of the object, preferably uncropped; None if no camera shows it.

    Among cameras that show similar amounts, elevation decides: nearest to TRAINED_ELEVATIONS.
    """
    visible, tilt, centre = {}, {}, own.means.median(0).values
    for i in range(len(scene.cameras)) if scene.cameras is not None else ():
        viewmat, elevation = scene.cameras.viewmats[i], _elevation(centres(scene.cameras.viewmats[i][None])[0], centre)
        if abs(elevation) > MAX_ELEVATION or (files is not None and i not in files):
            continue
        width, height = scene.cameras.sizes[i].tolist()
        shrink = MAX_VISIBILITY_SIDE / max(width, height)
        w, h = max(1, round(width * shrink)), max(1, round(height * shrink))
        K = resize(scene.cameras.Ks[i], w / width, h / height)
        inside = project(own.means, viewmat, K) / torch.tensor([w, h])
        whole = ((inside >= 0) & (inside <= 1)).all(1) & (depths(own.means, viewmat) > 0)
        weight = visibility(scene.gaussians, viewmat, K, w, h).weight[scene.gaussians.object_id == own.object_id[0]]
        visible[i] = float(weight.sum()) * float(whole.float().mean()) ** 2
        tilt[i] = max(TRAINED_ELEVATIONS[0] - elevation, elevation - TRAINED_ELEVATIONS[1], 0.0)
    top = max(visible.values(), default=0.0)
    good = [i for i, value in visible.items() if value > 0 and value >= MIN_RELATIVE_VISIBILITY * top]
    return min(good, key=lambda i: (tilt[i], -visible[i]), default=None)


def _elevation(eye: Float[Tensor, "3"], centre: Float[Tensor, "3"]) -> float:
    up = eye - centre
    return math.degrees(math.atan2(float(up[2]), float(up[:2].norm())))


def _rotated_camera(scene: Scene, own: Gaussians, view: int, side: int) -> tuple[Tensor, Tensor, Tensor] | None:
    """The camera of a view, rotated towards the object's centre: viewmat, K and this centre; None if not visible."""
    eye = centres(scene.cameras.viewmats[view][None])[0]
    centre = own.means.median(0).values
    for _ in range(2):  # the first pass finds the centre of the outline, the second its size
        viewmat = look_at(eye, centre)
        extent = float(torch.quantile(project(own.means, viewmat, torch.eye(3)).abs(), 0.99))
        K = intrinsics(side, side, side / 4 / extent)
        rows, columns = torch.nonzero(_mask(scene.gaussians, own, viewmat, K, side) > 0.5, as_tuple=True)
        if not len(rows):
            return None
        low, high = torch.stack([columns.min(), rows.min()]), torch.stack([columns.max(), rows.max()]) + 1
        ray = torch.cat([((low + high) / 2 - side / 2) / K[0, 0], torch.ones(1)])
        near, far = torch.quantile(depths(own.means, viewmat), torch.tensor([0.02, 0.98]))
        centre = eye + (near + far) / 2 * ray @ viewmat[:3, :3]
    return look_at(eye, centre), intrinsics(side, side, float(K[0, 0] * CROP_FILL * side / (high - low).max())), centre


def _mask(
    g: Gaussians, own: Gaussians, viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"], side: int
) -> Float[Tensor, "s s"]:
    """Coverage 0..1 of each pixel by the visible part of the object."""
    alone = (g.object_id == own.object_id[0]).to(g.means)[:, None]
    fine = resize(K, float(SUPERSAMPLING), float(SUPERSAMPLING))
    large = SUPERSAMPLING * side
    rendered = rasterise_features(g, alone, viewmat[None], fine[None], large, large)[0, ..., 0]
    return torch.nn.functional.avg_pool2d(rendered[None], SUPERSAMPLING)[0].clamp(0, 1)


def _rotated_photo(
    photo: Float[Tensor, "h w 3"], scene: Scene, view: int, viewmat: Tensor, K: Tensor, side: int
) -> Float[Tensor, "s s 3"]:
    """Warp an undistorted photo to the rotated camera by the homography K_photo R_photo R^T K^-1; white outside."""
    width, height = scene.cameras.sizes[view].tolist()
    K_photo = resize(scene.cameras.Ks[view], photo.shape[1] / width, photo.shape[0] / height).double()
    R = (scene.cameras.viewmats[view, :3, :3] @ viewmat[:3, :3].mT).double()
    half = torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]).double()  # OpenCV's pixel centres are integers
    H = half.inverse() @ K_photo @ R @ resize(K, float(SUPERSAMPLING), float(SUPERSAMPLING)).double().inverse() @ half
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    out = cv2.warpPerspective(photo.numpy(), H.numpy(), (SUPERSAMPLING * side, SUPERSAMPLING * side), flags=flags,
                              borderMode=cv2.BORDER_CONSTANT, borderValue=(1.0, 1.0, 1.0))  # fmt: skip
    return torch.from_numpy(cv2.resize(np.ascontiguousarray(out), (side, side), interpolation=cv2.INTER_AREA))
