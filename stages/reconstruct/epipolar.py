"""Distances of pixels from the epipolar lines of known cameras."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


class EpipolarLines:
    """Epipolar geometry of n pixels `a` of one camera and m pixels `b` of another.

    Cameras are pycolmap cameras, poses are world-to-camera. Distances [px] are first-order: Sampson 1982, "Fitting
    conic sections to very scattered data".
    """

    def __init__(self, camera_a, camera_b, viewmats: Float[Tensor, "2 4 4"], a: np.ndarray, b: np.ndarray):
        rays_a, self.rays_b = _rays(camera_a, a), _rays(camera_b, b)
        motion = viewmats[1].double() @ torch.linalg.inv(viewmats[0].double())
        E = torch.linalg.cross(motion[:3, 3:].expand(3, 3), motion[:3, :3], dim=0)
        self.in_b, self.in_a = rays_a @ E.mT, self.rays_b @ E
        self.focal = camera_a.mean_focal_length()

    def distances(self) -> Float[Tensor, "n m"]:
        """Distance of each pixel of the second camera from the epipolar line of each pixel of the first."""
        slopes = self.in_b[:, :2].square().sum(1)[:, None] + self.in_a[:, :2].square().sum(1)
        return (self.in_b.float() @ self.rays_b.float().mT).abs() / slopes.sqrt().clamp_min(1e-12).float() * self.focal

    def of_matches(self) -> Float[Tensor, "n"]:
        """Distance of each pair of matching pixels, which are in the same order in both cameras (n = m)."""
        slopes = self.in_b[:, :2].square().sum(1) + self.in_a[:, :2].square().sum(1)
        return (self.in_b * self.rays_b).sum(1).abs() / slopes.sqrt().clamp_min(1e-12) * self.focal


def _rays(camera, pixels: np.ndarray) -> Float[Tensor, "k 3"]:
    """Undistorted ray directions, z = 1, of pixels (k, 2)."""
    plane = np.asarray(camera.cam_from_img(pixels.astype(np.float64)))
    return torch.from_numpy(np.pad(plane, ((0, 0), (0, 1)), constant_values=1))
