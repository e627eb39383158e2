"""Camera paths from a JSON list of cameras, and smooth interpolation between cameras.

Each entry is {rotation (3x3, camera to world), position, width, height, fx, fy} as in the public NGFF files
(principal point at the centre), or {viewmat (4x4, world to camera), K, size}.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.geometry.rotations import nearest_rotation
from stages.core.scene.cameras import MAX_SIDE, Cameras, check_cameras
from stages.core.scene.files import must_exist
from stages.core.scene.schema import number, numbers, read_json, reason, whole

EXPECTED = "a camera path (.json: a list of {rotation, position, width, height, fx, fy} or of {viewmat, K, size})"


def read_camera_path(path: str | Path) -> Cameras:
    """Read the cameras of a path file. Raises InputError unless it is valid and all have the same image size."""
    path = Path(path)
    must_exist(path, EXPECTED)
    try:
        rows = read_json(path)
        if not isinstance(rows, list) or not rows:
            raise TypeError("not a list of cameras")
        entries = [_entry(row) for row in rows]
        viewmats, Ks = (torch.from_numpy(np.stack([e[i] for e in entries])).float() for i in (0, 1))
        sizes = torch.tensor([entry[2] for entry in entries])
        if not (sizes == sizes[0]).all():
            raise ValueError("the cameras differ in image size; give all the same size")
        return check_cameras(Cameras(viewmats, Ks, sizes, tuple(f"{path.stem} {i}" for i in range(len(entries)))))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RuntimeError, IndexError) as error:
        raise InputError(f"{path}: is not a valid camera path ({reason(error)}); {EXPECTED} is expected") from error


def _entry(row: dict) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """viewmat, K and size of one camera in either format."""
    if "viewmat" in row:
        viewmat, K = _matrix(row, "viewmat", 4, 4), _matrix(row, "K", 3, 3)
        width, height = numbers(row["size"], 2, "size", 1, MAX_SIDE)
    else:
        R = _matrix(row, "rotation", 3, 3).T  # world to camera
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ numbers(row["position"], 3, "position")
        width, height, fx, fy = (number(row[name], name) for name in ("width", "height", "fx", "fy"))
        K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])
    R = viewmat[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0:
        raise ValueError("a rotation is not orthonormal")
    viewmat[:3, :3] = nearest_rotation(torch.from_numpy(R)).numpy()
    return viewmat, K, [whole(width, "width", 1, MAX_SIDE), whole(height, "height", 1, MAX_SIDE)]


def _matrix(row: dict, name: str, height: int, width: int) -> np.ndarray:
    """A matrix given as rows of numbers, or as one flat list."""
    values = row[name]
    if isinstance(values, list) and len(values) == height and isinstance(values[0], list):
        return np.array([numbers(line, width, name) for line in values])
    return np.array(numbers(values, height * width, name)).reshape(height, width)


def interpolate_cameras(cameras: Cameras, frames: int) -> Cameras:
    """`frames` cameras from the first to the last, evenly spaced in the order given; a single camera is repeated.

    Rotations are interpolated by slerp, positions and intrinsics by monotone cubics (PCHIP), which pass through
    every camera without overshoot.
    """
    from scipy.interpolate import PchipInterpolator  # 0.3 s to import with scipy.optimize, only for camera paths
    from scipy.spatial.transform import Rotation, Slerp

    c = len(cameras)
    sizes = cameras.sizes[:1].expand(frames, 2)
    if c == 1:
        return Cameras(
            cameras.viewmats.expand(frames, 4, 4), cameras.Ks.expand(frames, 3, 3), sizes, cameras.names * frames
        )
    index = np.linspace(0, c - 1, frames) if frames > 1 else np.array([0.0])
    knots = np.arange(c)
    R = Slerp(knots, Rotation.from_matrix(cameras.viewmats[:, :3, :3].double().numpy()))(index).as_matrix()
    eyes = PchipInterpolator(knots, centres(cameras.viewmats).double().numpy())(index)
    viewmats = np.tile(np.eye(4), (frames, 1, 1))
    viewmats[:, :3, :3], viewmats[:, :3, 3] = R, -(R @ eyes[..., None])[..., 0]
    Ks = PchipInterpolator(knots, cameras.Ks.double().numpy())(index)
    return Cameras(torch.from_numpy(viewmats).float(), torch.from_numpy(Ks).float(), sizes, ("",) * frames)
