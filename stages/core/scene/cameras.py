"""Pinhole cameras, and readers for the camera files of other tools."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.similarity import Similarity


@dataclass(frozen=True)
class Cameras:
    """Pinhole cameras: x right, y down, z forward; pixel centres at +0.5."""

    viewmats: Float[Tensor, "c 4 4"]  # world to camera
    Ks: Float[Tensor, "c 3 3"]  # [px]
    sizes: Int[Tensor, "c 2"]  # width, height [px]
    names: tuple[str, ...]  # of the photos

    def __len__(self) -> int:
        return len(self.viewmats)

    def __getitem__(self, index: list[int] | slice) -> Cameras:
        rows = list(range(len(self)))[index] if isinstance(index, slice) else [int(i) for i in index]
        return Cameras(self.viewmats[rows], self.Ks[rows], self.sizes[rows], tuple(self.names[i] for i in rows))

    def transformed(self, similarity: Similarity) -> Cameras:
        """The same cameras in the transformed world."""
        return Cameras(similarity.viewmats(self.viewmats), self.Ks, self.sizes, self.names)


def to_json(cameras: Cameras) -> list[dict]:
    """One dict per camera, as stored in the header of scene.ply."""
    return [
        {"name": name, "viewmat": viewmat.tolist(), "K": K.tolist(), "size": size.tolist()}
        for name, viewmat, K, size in zip(cameras.names, cameras.viewmats, cameras.Ks, cameras.sizes, strict=True)
    ]


def from_json(rows: list[dict]) -> Cameras | None:
    """The inverse of `to_json`; None for an empty list."""
    if not rows:
        return None
    return Cameras(
        torch.tensor([r["viewmat"] for r in rows], dtype=torch.float32),
        torch.tensor([r["K"] for r in rows], dtype=torch.float32),
        torch.tensor([r["size"] for r in rows], dtype=torch.int64),
        tuple(str(r["name"]) for r in rows),
    )


@dataclass(frozen=True)
class LensDistortion:
    """Distortion coefficients of each camera in the order of OpenCV: k1 k2 p1 p2 k3 (zeros for none)."""

    coefficients: Float[Tensor, "c 5"]


def read_cameras(path: Path) -> tuple[Cameras, LensDistortion]:
    """Cameras of a nerfstudio transforms.json or of a COLMAP model folder (cameras, images, points3D), sorted by name.

    Raises InputError for other files and for camera models with other distortion parameters than OpenCV's first five.
    """
    path = Path(path)
    if path.is_dir():
        return _read_colmap(path)
    if not path.exists():
        raise InputError(f"{path}: no such file; give a transforms.json or a COLMAP model folder")
    try:
        data = json.loads(path.read_text())
        return _from_transforms(data)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: is not a nerfstudio transforms file ({error!r}); it needs frames with file_path and "
            "transform_matrix, and fl_x fl_y cx cy w h"
        ) from error


def _from_transforms(data: dict) -> tuple[Cameras, LensDistortion]:
    """Cameras of a transforms.json; OpenGL axes (y up, view along -z) become OpenCV axes by negating y and z."""
    viewmats, Ks, sizes, names, lenses = [], [], [], [], []
    for frame in sorted(data["frames"], key=lambda frame: frame["file_path"]):
        value = {**data, **frame}
        c2w = np.array(frame["transform_matrix"], dtype=np.float64) @ np.diag([1.0, -1, -1, 1])
        viewmats.append(np.linalg.inv(c2w))
        Ks.append([[value["fl_x"], 0, value["cx"]], [0, value["fl_y"], value["cy"]], [0, 0, 1]])
        sizes.append([value["w"], value["h"]])
        names.append(Path(frame["file_path"]).name)
        lenses.append([value.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3")])
    if not names:
        raise ValueError("no frames")
    cameras = Cameras(_float(viewmats), _float(Ks), torch.tensor(sizes, dtype=torch.int64), tuple(names))
    return cameras, LensDistortion(_float(lenses))


def _read_colmap(path: Path) -> tuple[Cameras, LensDistortion]:
    import pycolmap  # takes a second to import, and only this reader needs it

    try:
        model = pycolmap.Reconstruction(str(path))
    except (ValueError, RuntimeError, IndexError) as error:
        raise InputError(f"{path}: holds no COLMAP model (cameras, images and points3D, .bin or .txt)") from error
    viewmats, Ks, sizes, names, lenses = [], [], [], [], []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        camera = model.cameras[image.camera_id]
        viewmats.append(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))
        Ks.append(camera.calibration_matrix())
        sizes.append([camera.width, camera.height])
        names.append(Path(image.name).name)
        lenses.append(_colmap_lens(path, camera))
    if not names:
        raise InputError(f"{path}: the COLMAP model has no registered image")
    cameras = Cameras(_float(viewmats), _float(Ks), torch.tensor(sizes, dtype=torch.int64), tuple(names))
    return cameras, LensDistortion(_float(lenses))


def _colmap_lens(path: Path, camera) -> list[float]:
    """k1 k2 p1 p2 k3 of a COLMAP camera: its parameters after focal length and principal point."""
    tail = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 3, "RADIAL": 3, "OPENCV": 4}
    model = camera.model.name
    if model not in tail:
        raise InputError(f"{path}: camera model {model} is not supported; undistort it with `colmap image_undistorter`")
    k = list(camera.params[tail[model] :])
    return (k + [0.0] * 5)[:5]


def _float(rows: list) -> Tensor:
    return torch.from_numpy(np.array(rows, dtype=np.float64)).float()
