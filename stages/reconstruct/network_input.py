"""Input of a vision transformer: photos cropped and resized to one size, with sides that are multiples of its patch."""

from __future__ import annotations

from itertools import product

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from stages.core.geometry.cameras import resize as resize_K
from stages.core.models.pi3.dinov2 import PATCH
from stages.core.scene.cameras import Cameras, PhotoIntrinsics
from stages.core.scene.images import resize
from stages.reconstruct.photos import Photos

MAX_PIXELS = 201_000  # most pixels per photo, as published (448 x 448 for a square photo)


def network_size(width: int, height: int, longest: int | None = None) -> tuple[int, int]:
    """Largest width and height, in multiples of 14, within the photo, MAX_PIXELS and the longest side `longest`.

    Among the multiples next to the exact size, those with most pixels are chosen.
    """
    shrink = min(1.0, (MAX_PIXELS / (width * height)) ** 0.5, (longest or width + height) / max(width, height))
    choices = []
    for side in (width, height):
        patches = int(side * shrink + 1e-6) // PATCH
        choices.append([n * PATCH for n in (patches, patches + 1) if n and n * PATCH <= min(side, longest or side)])
    fitting = [(w, h) for w, h in product(*choices) if w * h <= MAX_PIXELS]
    return max(fitting, key=lambda size: size[0] * size[1], default=(PATCH, PATCH))


def crop_photos(photos: Photos, longest: int | None = None) -> list[UInt8[Tensor, "_ _ 3"]]:
    """Crop every photo at its centre to the aspect ratio of `common_size`.

    The optical axis remains in the centre and pixels remain square.
    """
    target, out = common_size(photos, longest), []
    for i, image in enumerate(photos.images):
        left, top, wide, high = _centre(photos.size(i), target)
        out.append(image[top : top + high, left : left + wide].contiguous())
    return out


def photo_intrinsics(photos: Photos, cameras: Cameras) -> PhotoIntrinsics:
    """Intrinsics of the whole photos, in pixels of their files, from the cameras of their crops; without distortion.

    `cameras` have the size `common_size`.
    """
    Ks = []
    for i, (K, (w, h)) in enumerate(zip(cameras.Ks, cameras.sizes.tolist(), strict=True)):
        left, top, wide, high = _centre(photos.size(i), (w, h))
        whole = resize_K(K, wide / w, high / h)
        whole[:2, 2] += torch.tensor([left, top])
        Ks.append(resize_K(whole, *(f / s for f, s in zip(photos.file_size(i), photos.size(i), strict=True))))
    sizes = torch.tensor([photos.file_size(i) for i in range(len(photos))])
    return PhotoIntrinsics(torch.stack(Ks), sizes, torch.zeros(len(photos), 5))


def _centre(size: tuple[int, int], target: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, top, width and height of the largest centred part of an image with the aspect ratio of `target`."""
    (w, h), (width, height) = size, target
    shrink = min(w / width, h / height)
    wide, high = min(w, round(width * shrink)), min(h, round(height * shrink))
    return (w - wide) // 2, (h - high) // 2, wide, high


def common_size(photos: Photos, longest: int | None = None) -> tuple[int, int]:
    """Network size (width, height) for the photo with the median aspect ratio."""
    sizes = sorted((photos.size(i) for i in range(len(photos))), key=lambda size: size[0] / size[1])
    return network_size(*sizes[len(sizes) // 2], longest)


def resize_bytes(image: UInt8[Tensor, "h w 3"], width: int, height: int) -> UInt8[Tensor, "h2 w2 3"]:
    """Resize an 8-bit image."""
    return (resize(image.float() / 255, width, height) * 255).round().clamp(0, 255).to(torch.uint8)


def make_batch(images: list[UInt8[Tensor, "_ _ 3"]], size: tuple[int, int]) -> Float[Tensor, "v 3 h w"]:
    """Images of one aspect ratio at the network size (width, height), RGB in 0..1."""
    return torch.stack([resize(image.float() / 255, *size) for image in images]).permute(0, 3, 1, 2).contiguous()
