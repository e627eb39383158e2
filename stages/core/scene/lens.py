"""Undistort photos: images, label images, points and boxes, from the photo as taken to the view of its camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.cameras import resize
from stages.core.scene.cameras import Cameras

ASPECT_TOLERANCE = 0.03  # largest relative difference of the aspect ratios of an image and its photo
INVERSION_STEPS = 100  # iterations of the fixed point that undistorts points
MAX_INVERSION_ERROR = 0.1  # largest error of an undistorted point, mapped back through the lens [px]
BOX_EDGE_POINTS = 17  # points along each edge of a box, which the lens bends
HALF_PIXEL = torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], dtype=torch.float64)  # OpenCV has pixel centres at 0


@dataclass(frozen=True)
class Undistortion:
    """The map from an image of a photo as taken, at any resolution, to the undistorted view of its camera."""

    K: Float[Tensor, "3 3"]  # of the given image [px]
    size: tuple[int, int]  # width, height of the given image [px]
    distortion: Float[Tensor, "5"]  # k1 k2 p1 p2 k3 of OpenCV
    view_K: Float[Tensor, "3 3"]  # of the view [px]
    view_size: tuple[int, int]

    @classmethod
    def of(cls, cameras: Cameras, view: int, size: tuple[int, int], undistorted: bool = False) -> Undistortion:
        """The map for an image of camera number `view` with this width and height.

        With `undistorted` the image already shows the undistorted view, and is at most resized. Raises InputError if
        its aspect ratio differs from that of the photo, or of the view.
        """
        K, full, lens = photo_of(cameras, view, undistorted)
        if abs(size[0] / size[1] / (full[0] / full[1]) - 1) > ASPECT_TOLERANCE:
            raise InputError(f"{cameras.names[view]} is {size[0]}x{size[1]} pixels, but {full[0]}x{full[1]} in the "
                             "scene; both must have the same aspect ratio")  # fmt: skip
        K = resize(K, size[0] / full[0], size[1] / full[1])
        return cls(K, size, lens, cameras.Ks[view], tuple(cameras.sizes[view].tolist()))

    def image(
        self, image: Float[Tensor, "h w 3"] | UInt8[Tensor, "h w 3"]
    ) -> Float[Tensor, "h2 w2 3"] | UInt8[Tensor, "h2 w2 3"]:
        """Undistort an image by bilinear interpolation, to the size of the view or the image, whichever is larger."""
        scale = max(1.0, self.size[0] / self.view_size[0])
        width, height = (round(side * scale) for side in self.view_size)
        K = resize(self.view_K, width / self.view_size[0], height / self.view_size[1])
        if not self.distortion.any() and (width, height) == self.size and torch.allclose(K, self.K, rtol=1e-5):
            return image
        x, y = self._map(K, (width, height))
        return torch.from_numpy(cv2.remap(image.numpy(), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    def labels(self, labels: Int[Tensor, "h w"]) -> Int[Tensor, "h2 w2"]:
        """Undistort a label image by nearest-neighbour sampling, to the size of the view."""
        x, y = (torch.from_numpy(m).round().long() for m in self._map(self.view_K, self.view_size))
        return labels[y.clamp(0, self.size[1] - 1), x.clamp(0, self.size[0] - 1)]

    def points(self, points: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """Undistort points of the image, to the view [px]; nan if the distortion has no inverse there."""
        distorted = (points.double() - self.K[:2, 2].double()) / self.K.double()[[0, 1], [0, 1]]
        k1, k2, p1, p2, k3 = self.distortion.double()
        x = distorted
        for _ in range(INVERSION_STEPS):
            xy, r2 = x.prod(1, keepdim=True), x.square().sum(1, keepdim=True)
            shift = 2 * xy * torch.stack([p1, p2]) + (r2 + 2 * x.square()) * torch.stack([p2, p1])
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            error = distorted - (x * radial + shift)
            x = (distorted - shift) / radial
        found = (error.abs() * float(self.K[0, 0])).amax(1, keepdim=True) < MAX_INVERSION_ERROR
        out = x * self.view_K.double()[[0, 1], [0, 1]] + self.view_K[:2, 2].double()
        return torch.where(found, out, torch.nan).float()

    def boxes(self, boxes: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
        """Bounding boxes x0 y0 x1 y1 in the view of boxes in the image [px]; empty if they lie outside the view."""
        size, view = (torch.tensor(s, dtype=torch.float32).repeat(2) for s in (self.size, self.view_size))
        inside = torch.minimum(boxes.clamp_min(0), size)
        t = torch.linspace(0, 1, BOX_EDGE_POINTS)
        zero, one = torch.zeros_like(t), torch.ones_like(t)
        edges = torch.cat([torch.stack(p, 1) for p in ((t, zero), (t, one), (zero, t), (one, t))])
        border = torch.lerp(inside[:, None, :2], inside[:, None, 2:], edges)
        moved = self.points(border.flatten(0, 1)).unflatten(0, (len(boxes), 4 * BOX_EDGE_POINTS))
        low, high = moved.nan_to_num(torch.inf).amin(1), moved.nan_to_num(-torch.inf).amax(1)
        return torch.minimum(torch.cat([low, high], 1).clamp_min(0), view)

    def _map(self, K: Float[Tensor, "3 3"], size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Sampling positions x, y in the image (pixel centres at 0) for each pixel of a view with this K and size."""
        source, target = ((k.double() - HALF_PIXEL).numpy() for k in (self.K, K))
        return cv2.initUndistortRectifyMap(source, self.distortion.double().numpy(), None, target, size, cv2.CV_32FC1)


def photo_of(cameras: Cameras, view: int, undistorted: bool = False) -> tuple[Tensor, tuple[int, int], Tensor]:
    """K [px], size and distortion of the photo of a camera; those of the view if `undistorted` or not stored."""
    if undistorted or cameras.photos is None:
        return cameras.Ks[view], tuple(cameras.sizes[view].tolist()), torch.zeros(5)
    photos = cameras.photos
    return photos.Ks[view], tuple(photos.sizes[view].tolist()), photos.distortion[view]
