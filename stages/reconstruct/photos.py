"""Photos as taken, their undistorted views, and the result of a reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from stages.core.geometry.cameras import resize
from stages.core.scene.cameras import Cameras, LensDistortion, PhotoIntrinsics
from stages.core.scene.lens import HALF_PIXEL, Undistortion
from stages.core.scene.scene import Scene


@dataclass(frozen=True)
class Photos:
    """Photos as taken, but large ones are reduced; sizes may differ."""

    images: tuple[UInt8[Tensor, "h w 3"], ...]
    names: tuple[str, ...]
    focals: tuple[float, ...]  # from EXIF, in pixels of `images`; 0 where unknown
    source: Path  # folder or video, for error messages
    file_sizes: tuple[tuple[int, int], ...] = ()  # width, height of the files [px]; empty: those of `images`

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: list[int]) -> Photos:
        images, names, focals = (tuple(x[i] for i in index) for x in (self.images, self.names, self.focals))
        return Photos(images, names, focals, self.source, tuple(self.file_size(i) for i in index))

    def size(self, i: int) -> tuple[int, int]:
        """Width and height of photo i [px]."""
        return self.images[i].shape[1], self.images[i].shape[0]

    def file_size(self, i: int) -> tuple[int, int]:
        """Width and height of photo i before it was reduced [px]."""
        return self.file_sizes[i] if self.file_sizes else self.size(i)


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
    """Indices of the photos to fit, and of every `holdout`-th photo, which is held out; a single photo is fitted."""
    held_out = [i for i in range(count) if holdout and i % holdout == 0] if count > 1 else []
    return [i for i in range(count) if i not in held_out], held_out


def undistort(photos: Photos, cameras: Cameras, lenses: LensDistortion, side: int) -> Views:
    """Pinhole views of the photos named in `cameras`, at most `side` wide or high.

    `cameras` are in pixels of `photos`. The new K is chosen so that every pixel of a view is inside the photo. The
    cameras of the views also store the intrinsics of the photos, in pixels of their files.
    """
    row = {name: i for i, name in enumerate(photos.names)}
    images, Ks, sizes, photo_Ks, file_sizes = [], [], [], [], []
    for c, name in enumerate(cameras.names):
        i, lens = row[name], lenses.coefficients[c]
        width, height = photos.size(i)
        K = _pinhole_K(cameras.Ks[c], lens, (width, height))
        pixels = Undistortion(cameras.Ks[c], (width, height), lens, K, (width, height)).image(photos.images[i])
        scale = min(1.0, side / max(width, height))
        size, file = (round(width * scale), round(height * scale)), photos.file_size(i)
        if scale < 1:
            pixels = torch.from_numpy(cv2.resize(pixels.numpy(), size, interpolation=cv2.INTER_AREA))
        images.append(pixels)
        Ks.append(resize(K, size[0] / width, size[1] / height).float())
        sizes.append(size)
        photo_Ks.append(resize(cameras.Ks[c], file[0] / width, file[1] / height))
        file_sizes.append(file)
    taken = PhotoIntrinsics(torch.stack(photo_Ks), torch.tensor(file_sizes), lenses.coefficients)
    return Views(tuple(images), Cameras(cameras.viewmats, torch.stack(Ks), torch.tensor(sizes), cameras.names, taken))


def _pinhole_K(K: Float[Tensor, "3 3"], lens: Float[Tensor, "5"], size: tuple[int, int]) -> Float[Tensor, "3 3"]:
    """K of the largest undistorted view of the same size that shows only pixels of the photo."""
    if not lens.any():
        return K
    new, _ = cv2.getOptimalNewCameraMatrix((K.double() - HALF_PIXEL).numpy(), lens.double().numpy(), size, 0)
    return torch.from_numpy(new) + HALF_PIXEL  # double precision; rounded only once, when stored
