"""Photos as taken, and the views that they become once lens distortion is taken out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from stages.core.scene.cameras import Cameras, LensDistortion
from stages.core.scene.scene import Scene


@dataclass(frozen=True)
class Photos:
    """Photos as taken, though smaller when they were very large; sizes may differ."""

    images: tuple[UInt8[Tensor, "h w 3"], ...]
    names: tuple[str, ...]
    focals: tuple[float, ...]  # from EXIF, in pixels of `images`; 0 where the file does not say
    source: Path  # folder or video they came from, to be named in errors

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: list[int]) -> Photos:
        return Photos(*(tuple(x[i] for i in index) for x in (self.images, self.names, self.focals)), self.source)

    def size(self, i: int) -> tuple[int, int]:
        """Width and height [px]."""
        return self.images[i].shape[1], self.images[i].shape[0]


@dataclass(frozen=True)
class Views:
    """Undistorted photos at working resolution with their pinhole cameras."""

    images: tuple[UInt8[Tensor, "h w 3"], ...]
    cameras: Cameras

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: list[int]) -> Views:
        return Views(tuple(self.images[i] for i in index), self.cameras[index])

    def image(self, i: int, device: str | torch.device = "cpu") -> Float[Tensor, "h w 3"]:
        return self.images[i].to(device).float() / 255


@dataclass(frozen=True)
class Reconstruction:
    """What a backend returns: the scene, and the photos it may be judged by, upright like the scene."""

    scene: Scene
    views: Views
    trained: list[int]  # views the Gaussians were fitted to
    held_out: list[int]  # views kept out
    dropped: dict[str, str]  # photos left out, and why
    advice: list[str]  # what would improve the result, a sentence each


def undistort(photos: Photos, cameras: Cameras, lenses: LensDistortion, side: int) -> Views:
    """Pinhole views of the photos that `cameras` names, at most `side` wide or high.

    The new K keeps only pixels the photo really has, so no black borders enter the Gaussians.
    `cameras` are in pixels of `photos`.
    """
    row = {name: i for i, name in enumerate(photos.names)}
    images, Ks, sizes = [], [], []
    for c, name in enumerate(cameras.names):
        source = photos.images[row[name]].numpy()
        height, width = source.shape[:2]
        scale = min(1.0, side / max(width, height))
        size = round(width * scale), round(height * scale)
        K = cameras.Ks[c].double().numpy()
        pixels, K = _pinhole(source, K, lenses.coefficients[c].double().numpy())
        if scale < 1:
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
            K = np.diag([size[0] / width, size[1] / height, 1]) @ K
        images.append(torch.from_numpy(pixels))
        Ks.append(torch.from_numpy(K).float())
        sizes.append(size)
    return Views(tuple(images), Cameras(cameras.viewmats, torch.stack(Ks), torch.tensor(sizes), cameras.names))


def _pinhole(pixels: np.ndarray, K: np.ndarray, lens: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image without distortion, same size, and its K. OpenCV has pixel centres at 0, we at +0.5."""
    if not lens.any():
        return pixels, K
    height, width = pixels.shape[:2]
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    theirs = K - half
    new, _ = cv2.getOptimalNewCameraMatrix(theirs, lens, (width, height), 0)
    maps = cv2.initUndistortRectifyMap(theirs, lens, None, new, (width, height), cv2.CV_32FC1)
    return cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), new + half
