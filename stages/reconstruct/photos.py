"""Photos as taken, and undistorted views of them."""

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
    """Photos as taken, large ones reduced; sizes may differ."""

    images: tuple[UInt8[Tensor, "h w 3"], ...]
    names: tuple[str, ...]
    focals: tuple[float, ...]  # from EXIF, in pixels of `images`; 0 where unknown
    source: Path  # folder or video, for error messages

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: list[int]) -> Photos:
        return Photos(*(tuple(x[i] for i in index) for x in (self.images, self.names, self.focals)), self.source)

    def size(self, i: int) -> tuple[int, int]:
        """Width and height of photo i [px]."""
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
        """Image of view i, RGB in 0..1."""
        return self.images[i].to(device).float() / 255


@dataclass(frozen=True)
class Reconstruction:
    """Result of a backend: the scene, and the views in its frame to evaluate it with."""

    scene: Scene
    views: Views
    trained: list[int]  # views that the Gaussians are fitted to
    held_out: list[int]  # views kept out of the fit
    dropped: dict[str, str]  # photos left out -> reason
    advice: list[str]  # how to improve the result, one sentence each


def split_holdout(count: int, holdout: int) -> tuple[list[int], list[int]]:
    """Indices of the photos to fit and of every `holdout`-th, kept out; a single photo is fitted."""
    held_out = [i for i in range(count) if holdout and i % holdout == 0] if count > 1 else []
    return [i for i in range(count) if i not in held_out], held_out


def undistort(photos: Photos, cameras: Cameras, lenses: LensDistortion, side: int) -> Views:
    """Pinhole views of the photos named in `cameras`, at most `side` wide or high.

    `cameras` are in pixels of `photos`. The new K is chosen so that every pixel of a view is inside the photo.
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
    """The undistorted image, same size, and its K; pixel centres are at 0 in OpenCV, at +0.5 here."""
    if not lens.any():
        return pixels, K
    height, width = pixels.shape[:2]
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    K_cv = K - half
    new, _ = cv2.getOptimalNewCameraMatrix(K_cv, lens, (width, height), 0)
    maps = cv2.initUndistortRectifyMap(K_cv, lens, None, new, (width, height), cv2.CV_32FC1)
    return cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), new + half
