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
from stages.core.scene.cameras import Cameras
from stages.core.scene.files import must_exist
from stages.core.scene.schema import read_json, reason

EXPECTED = "a camera path (.json: a list of {rotation, position, width, height, fx, fy} or of {viewmat, K, size})"


def read_camera_path(path: str | Path) -> Cameras:
    """The cameras of a path file; InputError unless it is valid and all have the same image size."""
    path = Path(path)
    must_exist(path, EXPECTED)
    try:
        rows = read_json(path)
        if not isinstance(rows, list) or not rows:
            raise TypeError("not a list of cameras")
        entries = [_entry(row) for row in rows]
        viewmats, Ks = (torch.from_numpy(np.stack([e[i] for e in entries])).float() for i in (0, 1))
        sizes = torch.tensor([entry[2] for entry in entries])
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RuntimeError, IndexError) as error:
        raise InputError(f"{path}: is not a valid camera path ({reason(error)}); {EXPECTED} is expected") from error
    if not (sizes == sizes[0]).all() or not (sizes > 0).all():
        raise InputError(f"{path}: the cameras differ in image size, or it is zero; give all the same size")
    if not (viewmats.isfinite().all() and Ks.isfinite().all() and (Ks[:, [0, 1], [0, 1]] > 0).all()):
        raise InputError(f"{path}: values must be finite and focal lengths above 0")
    return Cameras(viewmats, Ks, sizes, tuple(f"{path.stem} {i}" for i in range(len(entries))))


def _entry(row: dict) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """viewmat, K and size of one camera in either format."""
    if "viewmat" in row:
        viewmat, K = np.array(row["viewmat"], np.float64).reshape(4, 4), np.array(row["K"], np.float64).reshape(3, 3)
        width, height = row["size"]
    else:
        R = np.array(row["rotation"], np.float64).reshape(3, 3).T  # world to camera
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ np.array(row["position"], np.float64).reshape(3)
        width, height = row["width"], row["height"]
        K = np.array([[row["fx"], 0, width / 2], [0, row["fy"], height / 2], [0, 0, 1]], np.float64)
    R = viewmat[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0:
        raise ValueError("a rotation is not orthonormal")
    viewmat[:3, :3] = nearest_rotation(torch.from_numpy(R)).numpy()
    return viewmat, K, [int(width), int(height)]


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
    return Cameras(
        torch.from_numpy(viewmats).float(), torch.from_numpy(Ks).float(), sizes, ("",) * frames
    )
