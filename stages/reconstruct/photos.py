"""What comes in: a folder of photos or a video, and how lens distortion is taken out of it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from tqdm import tqdm

from stages.errors import InputError
from stages.scene.cameras import Cameras, Lenses
from stages.scene.images import VIDEOS, list_photos, read_image, read_video, to_bytes, video_info
from stages.scene.scene import Scene

log = logging.getLogger(__name__)
FRAMES = 30  # taken from a video
LOADED_SIDE = 1600  # photos are kept in memory at no more than this [px]


@dataclass(frozen=True)
class Photos:
    """Photos as taken, at most LOADED_SIDE wide or high; sizes may differ."""

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
    held: list[int]  # views kept out


def read_photos(path: Path) -> Photos:
    """The photos of a folder, in order of name, or the sharpest frames of a video."""
    path = Path(path)
    if path.is_file() and path.suffix.lower() in VIDEOS:
        return _from_video(path)
    if path.is_file():
        raise InputError(f"{path}: is neither a folder of photos nor a video ({' '.join(sorted(VIDEOS))})")
    files = list_photos(path)
    others = sum(1 for p in path.iterdir() if p.is_file() and not p.name.startswith(".")) - len(files)
    if others > 0:
        log.info("%s: %d photos; %d other files left alone", path, len(files), others)
    if len(files) < 2:
        raise InputError(f"{path}: holds one photo; at least 2, better 10 or more from around the scene, are needed")
    images, focals = [], []
    for file in tqdm(files, desc="reading photos", unit="photo", leave=False):
        image = read_image(file)
        full = max(image.shape[:2])
        images.append(_bounded(image, LOADED_SIDE))
        focals.append(_exif_focal(file) * max(images[-1].shape[:2]) / full)
    return Photos(tuple(images), tuple(f.name for f in files), tuple(focals), path)


def _exif_focal(file: Path) -> float:
    """Focal length in pixels of the stored photo by its EXIF tags (and COLMAP's table of sensors), else 0."""
    import pycolmap

    try:
        camera = pycolmap.infer_camera_from_image(str(file))
    except (ValueError, RuntimeError):  # a kind of image that COLMAP does not read, though OpenCV does
        return 0.0
    return float(camera.mean_focal_length()) if camera.has_prior_focal_length else 0.0


def _from_video(path: Path) -> Photos:
    """The video is cut into FRAMES equal spans, and the sharpest frame of each is taken.

    Sharpness is the variance of the Laplacian of the grey image, at a fixed small size.
    """
    count, _ = video_info(path)
    count = count or sum(1 for _ in read_video(path))
    best: dict[int, tuple[float, int, Tensor]] = {}
    for i, frame in enumerate(tqdm(read_video(path), total=count, desc="reading video", unit="frame", leave=False)):
        span = min(i * FRAMES // max(count, 1), FRAMES - 1)
        pixels = _bounded(frame, LOADED_SIDE)
        grey = cv2.cvtColor(_bounded(frame, 512).numpy(), cv2.COLOR_RGB2GRAY)
        sharpness = float(cv2.Laplacian(grey, cv2.CV_32F).var())
        if span not in best or sharpness > best[span][0]:
            best[span] = (sharpness, i, pixels)
    if len(best) < 2:
        raise InputError(f"{path}: has {len(best)} frame; a video that moves around the scene is needed")
    log.info("%s: took %d of %d frames, the sharpest of each span", path, len(best), count)
    chosen = [best[span] for span in sorted(best)]
    return Photos(tuple(c[2] for c in chosen), tuple(f"frame_{c[1]:05d}" for c in chosen), (0.0,) * len(chosen), path)


def _bounded(image: Float[Tensor, "h w 3"], side: int) -> UInt8[Tensor, "h2 w2 3"]:
    """8 bit, no longer than `side`."""
    pixels = to_bytes(image)
    height, width = pixels.shape[:2]
    shrink = min(1.0, side / max(height, width))
    if shrink < 1:
        size = max(1, round(width * shrink)), max(1, round(height * shrink))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.ascontiguousarray(pixels))


def undistort(photos: Photos, cameras: Cameras, lenses: Lenses, side: int) -> Views:
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
