"""Pinhole cameras, the intrinsics of the photos as taken, and readers for the camera files of other tools."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.similarity import Similarity
from stages.core.scene.colmap_model import read_colmap
from stages.core.scene.schema import LARGEST, number, numbers, quote, read_json, reason

LENS_MODEL = "opencv"  # the only lens model: k1 k2 p1 p2 k3 of OpenCV
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
MAX_SIDE = 65536  # largest side of an image [px]
MIN_EXTENT = 1e-4  # smallest extent of camera positions, relative to their distance from the origin (float32: 7 digits)
PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")  # in transforms.json


@dataclass(frozen=True)
class PhotoIntrinsics:
    """Intrinsics and lens distortion of the photos as taken; the images of `Cameras` are undistorted views of them."""

    Ks: Float[Tensor, "c 3 3"]  # [px] of the photo, pixel centres at +0.5
    sizes: Int[Tensor, "c 2"]  # width, height of the photo [px]
    distortion: Float[Tensor, "c 5"]  # k1 k2 p1 p2 k3 of OpenCV; zeros: none

    def __getitem__(self, rows: list[int]) -> PhotoIntrinsics:
        return PhotoIntrinsics(self.Ks[rows], self.sizes[rows], self.distortion[rows])


@dataclass(frozen=True)
class Cameras:
    """Pinhole cameras: x right, y down, z forward; pixel centres at +0.5."""

    viewmats: Float[Tensor, "c 4 4"]  # world to camera
    Ks: Float[Tensor, "c 3 3"]  # [px]
    sizes: Int[Tensor, "c 2"]  # width, height [px]
    names: tuple[str, ...]  # of the photos
    photos: PhotoIntrinsics | None = None  # the photos as taken; None: they equal the views, except for the resolution

    def __len__(self) -> int:
        return len(self.viewmats)

    def __getitem__(self, index: list[int] | slice) -> Cameras:
        rows = list(range(len(self)))[index] if isinstance(index, slice) else [int(i) for i in index]
        photos = None if self.photos is None else self.photos[rows]
        return Cameras(self.viewmats[rows], self.Ks[rows], self.sizes[rows], tuple(self.names[i] for i in rows), photos)

    def transformed(self, similarity: Similarity) -> Cameras:
        """The same cameras in the transformed world."""
        return replace(self, viewmats=similarity.viewmats(self.viewmats))


def check_cameras(cameras: Cameras) -> Cameras:
    """Return the cameras. Raises ValueError, with the name of the first wrong one, unless all are rigid and finite."""
    V, R = cameras.viewmats.double(), cameras.viewmats[:, :3, :3].double()
    rigid = (R @ R.mT - torch.eye(3, dtype=R.dtype)).abs().amax((1, 2)) < 1e-2
    rigid &= (torch.linalg.det(R) > 0) & ((V[:, 3] - V.new_tensor([0, 0, 0, 1])).abs().amax(1) < 1e-4)
    _check_each(cameras.names, {
        "a value of viewmat that is not finite, or far too large": (V.abs() <= LARGEST).all(2).all(1),
        "a viewmat that is not a rotation and a translation": rigid,
    })  # fmt: skip
    _check_intrinsics(cameras.names, cameras.Ks, cameras.sizes)
    if cameras.photos is not None:
        names = [f"{name}: photo" for name in cameras.names]
        _check_intrinsics(names, cameras.photos.Ks, cameras.photos.sizes)
        lens = (cameras.photos.distortion.abs() <= LARGEST).all(1)
        _check_each(names, {"a value of distortion that is not finite, or far too large": lens})
    return cameras


def _check_intrinsics(names: Sequence[str], Ks: Float[Tensor, "c 3 3"], sizes: Int[Tensor, "c 2"]) -> None:
    others = Ks[:, [0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - Ks.new_tensor([0, 0, 0, 0, 1])
    _check_each(names, {
        "a value of K that is not finite, or far too large": (Ks.abs() <= LARGEST).all(2).all(1),
        "a focal length in K that is not above 0": (Ks[:, [0, 1], [0, 1]] > 0).all(1),
        "a K that is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]": (others.abs() < 1e-3).all(1),
        f"a size that is not 1 to {MAX_SIDE} px": ((sizes > 0) & (sizes <= MAX_SIDE)).all(1),
    })  # fmt: skip


def _check_each(names: Sequence[str], checks: dict[str, Bool[Tensor, "c"]]) -> None:
    """Raise ValueError with the name of the first camera that fails a check, and what is wrong with it."""
    for what, right in checks.items():
        if not right.all():
            raise ValueError(f"{quote(names[int((~right).nonzero()[0])])} has {what}")


def to_json(cameras: Cameras) -> list[dict]:
    """One dict per camera, as stored in the header of scene.ply."""
    rows = [
        {"name": name, "viewmat": viewmat.tolist(), "K": K.tolist(), "size": size.tolist()}
        for name, viewmat, K, size in zip(cameras.names, cameras.viewmats, cameras.Ks, cameras.sizes, strict=True)
    ]
    if cameras.photos is not None:
        photos = cameras.photos
        for row, K, size, lens in zip(rows, photos.Ks, photos.sizes, photos.distortion, strict=True):
            row["photo"] = {
                "K": K.tolist(), "size": size.tolist(), "model": LENS_MODEL, "distortion": lens.tolist()
            }  # fmt: skip
    return rows


def from_json(rows: list[dict]) -> Cameras | None:
    """The inverse of `to_json`; None for an empty list. Cameras without a `photo` get one that equals the view.

    Raises ValueError, with the name of the camera and of the field, for wrong shapes and values.
    """
    if not rows:
        return None
    names = tuple(quote(row["name"], 255) for row in rows)
    viewmats = torch.stack([_matrix(row["viewmat"], (4, 4), f"{row['name']}: viewmat") for row in rows])
    Ks, sizes = _intrinsics(rows, names)
    if not any("photo" in row for row in rows):
        return check_cameras(Cameras(viewmats, Ks, sizes, names))
    photos = [row.get("photo", {**row, "model": LENS_MODEL, "distortion": [0.0] * 5}) for row in rows]
    labels = tuple(f"{name}: photo" for name in names)
    if unknown := [photo["model"] for photo in photos if photo["model"] != LENS_MODEL]:
        raise ValueError(f"lens model {quote(repr(unknown[0]))} is not known; only {LENS_MODEL!r} is")
    lenses = [_matrix(p["distortion"], (5,), f"{label}: distortion") for p, label in zip(photos, labels, strict=True)]
    taken = PhotoIntrinsics(*_intrinsics(photos, labels), torch.stack(lenses))
    return check_cameras(Cameras(viewmats, Ks, sizes, names, taken))


def _intrinsics(rows: list[dict], labels: tuple[str, ...]) -> tuple[Float[Tensor, "c 3 3"], Int[Tensor, "c 2"]]:
    """K and size of each row; `labels` name the rows in errors."""
    Ks, sizes = [], []
    for row, label in zip(rows, labels, strict=True):
        K, size = _matrix(row["K"], (3, 3), f"{label}: K"), row["size"]
        if len(size) != 2 or not all(isinstance(side, int) and 0 < side <= MAX_SIDE for side in size):
            raise ValueError(f"{label}: size {quote(size, 40)} is not two whole numbers above 0")
        Ks.append(K)
        sizes.append(size)
    return torch.stack(Ks), torch.tensor(sizes, dtype=torch.int64)


def _matrix(values: list, shape: tuple[int, ...], label: str) -> Tensor:
    """A float tensor of the values. Raises ValueError for another shape and for values that are not finite."""
    matrix = torch.tensor(values, dtype=torch.float32)
    if matrix.shape != shape:
        raise ValueError(f"{label} has shape {tuple(matrix.shape)}, not {shape}")
    if not matrix.isfinite().all():
        raise ValueError(f"{label} has a value that is not finite")
    return matrix


@dataclass(frozen=True)
class LensDistortion:
    """Distortion coefficients of each camera in the order of OpenCV: k1 k2 p1 p2 k3 (zeros for none)."""

    coefficients: Float[Tensor, "c 5"]


def read_cameras(path: Path) -> tuple[Cameras, LensDistortion]:
    """Read the cameras of a nerfstudio transforms.json or a COLMAP model folder (cameras and images), sorted by name.

    K and size are those of the photos as taken. Raises InputError for other files, for two photos of one name, and for
    camera models with distortion parameters beyond OpenCV's first five, such as fisheye lenses.
    """
    path = Path(path)
    if path.is_dir():
        return _read_colmap(path)
    if not path.exists():
        raise InputError(f"{path}: no such file; give a transforms.json or a COLMAP model folder")
    try:
        return _from_transforms(read_json(path))
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError, OverflowError) as error:
        why = reason(error)
        raise InputError(
            f"{path}: is not a nerfstudio transforms file ({why}); such a file needs frames with file_path and "
            "transform_matrix, and fl_x fl_y cx cy w h"
        ) from error


def _from_transforms(data: dict) -> tuple[Cameras, LensDistortion]:
    """Cameras of a transforms.json; negating y and z turns OpenGL axes (y up, view along -z) into OpenCV axes."""
    viewmats, Ks, sizes, names, lenses = [], [], [], [], []
    for frame in sorted(data["frames"], key=lambda frame: frame["file_path"]):
        value = {**data, **frame}
        rows = [*frame["transform_matrix"], [0, 0, 0, 1]][:4]  # some tools omit the last row
        c2w = np.array([numbers(row, 4, "transform_matrix") for row in rows])
        viewmats.append(np.linalg.inv(c2w @ np.diag([1.0, -1, -1, 1])))
        sizes.append([number(value[name], name, 1, MAX_SIDE) for name in ("w", "h")])
        Ks.append(_transforms_K(value, *sizes[-1]))
        names.append(quote(Path(frame["file_path"]).name, 255))
        lenses.append(_transforms_lens(value))
    if not names:
        raise ValueError("no frames")
    return _known_cameras(viewmats, Ks, sizes, names), LensDistortion(_float(lenses))


def _transforms_K(value: dict, width: float, height: float) -> list[list[float]]:
    """K of a frame; angles of view, square pixels and the centre of the image replace what is absent."""
    fx, fy = (_focal(value, axis, side) for axis, side in (("x", width), ("y", height)))
    if fx is None and fy is None:
        raise KeyError("fl_x")
    cx, cy = number(value.get("cx", width / 2), "cx"), number(value.get("cy", height / 2), "cy")
    return [[fx if fx is not None else fy, 0.0, cx], [0.0, fy if fy is not None else fx, cy], [0.0, 0.0, 1.0]]


def _focal(value: dict, axis: str, side: float) -> float | None:
    """The focal length along an axis [px], from the angle of view where it is absent; None without either."""
    if f"fl_{axis}" in value:
        return number(value[f"fl_{axis}"], f"fl_{axis}")
    angle = f"camera_angle_{axis}"
    return side / 2 / math.tan(number(value[angle], angle, 1e-3, 3.1) / 2) if angle in value else None


def _transforms_lens(value: dict) -> list[float]:
    """k1 k2 p1 p2 k3 of a frame. Raises ValueError for another lens model."""
    model = "OPENCV_FISHEYE" if value.get("is_fisheye") else value.get("camera_model", "OPENCV")
    if model not in PINHOLE_MODELS or any(value.get(k, 0) for k in ("k4", "k5", "k6")):
        raise ValueError(f"camera_model {model} with k4 {value.get('k4', 0)}: only k1 k2 p1 p2 k3 are supported")
    return [number(value.get(k, 0.0), k) for k in DISTORTION]


def _read_colmap(path: Path) -> tuple[Cameras, LensDistortion]:
    try:
        images = read_colmap(path)
        if not images:
            raise ValueError("it has no registered image")
        if any(any(image.lens[5:]) for image in images):
            raise ValueError("camera model FULL_OPENCV with k4 to k6 is not supported; undistort it with `colmap "
                             "image_undistorter`")  # fmt: skip
        sizes = [numbers(image.size, 2, f"the size of {image.name}", 1, MAX_SIDE) for image in images]
        viewmats, Ks, names = zip(*((image.viewmat, image.K, image.name) for image in images), strict=True)
        return _known_cameras(viewmats, Ks, sizes, names), LensDistortion(_float([i.lens[:5] for i in images]))
    except OSError as error:
        inside = min((p.parent for depth in ("*/", "*/*/") for p in path.glob(f"{depth}cameras.*")), default=None)
        hint = inside or "a folder with cameras and images (.bin or .txt)"
        raise InputError(f"{path}: contains no COLMAP model; give {hint}") from error
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: the COLMAP model cannot be read: {reason(error)}; export it again") from error


def _known_cameras(viewmats: Sequence, Ks: Sequence, sizes: Sequence, names: Sequence[str]) -> Cameras:
    """The cameras, checked; ValueError for two of one name, and for positions beyond single precision."""
    if twice := next((name for name, count in Counter(names).items() if count > 1), None):
        raise ValueError(f"two photos are named {twice}, without their folders; rename them")
    cameras = check_cameras(Cameras(_float(viewmats), _float(Ks), torch.tensor(sizes).long(), tuple(names)))
    eyes = np.linalg.inv(np.array(viewmats, dtype=np.float64))[:, :3, 3]
    extent, far = np.ptp(eyes, axis=0).max(), np.abs(eyes).max()
    if 0 < extent < MIN_EXTENT * far:
        raise ValueError(
            f"the cameras are {far:.3g} from the origin, but only {extent:.3g} from each other; subtract an offset "
            "from their positions"
        )
    return cameras


def _float(rows: Sequence) -> Tensor:
    return torch.from_numpy(np.array(rows, dtype=np.float64)).float()
