"""Read recordings of several fixed cameras: a folder with one video, or one folder of frames, per camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from stages.core.errors import InputError
from stages.core.scene.formats import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from stages.core.scene.images import list_photos, read_8_bit, read_reduced_video, video_info
from stages.core.scene.sequence import RATES


def list_recordings(folder: Path) -> dict[str, Path]:
    """The videos and folders of frames in a folder, by name. Raises InputError unless there are two or more."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; give one with a video, or a folder of frames, for each camera")
    found = {p.name: p for p in sorted(folder.iterdir()) if p.name[0] != "." and _is_recording(p)}
    if len(found) < 2:
        raise InputError(f"{folder}: contains {len(found)} videos or folders of frames; two cameras or more are needed")
    return found


def _is_recording(path: Path) -> bool:
    if path.is_dir():
        return any(p.suffix.lower() in IMAGE_SUFFIXES for p in path.iterdir())
    return path.suffix.lower() in VIDEO_SUFFIXES


def common_frame_rate(recordings: dict[str, Path], fps: float) -> float:
    """Frame rate of all videos [1/s], or `fps` for folders of frames.

    Raises InputError if the rates differ, or a video does not state its rate.
    """
    rates = {name: video_info(path)[1] if path.is_file() else fps for name, path in recordings.items()}
    for name, rate in rates.items():
        if not RATES[0] <= rate <= RATES[1]:
            says = f"has {rate:g} frames a second" if rate else "does not say how many frames it has in a second"
            raise InputError(f"{recordings[name]}: {says}; encode it again with a frame rate")
    name, rate = next(iter(rates.items()))
    other = next((n for n, r in rates.items() if abs(r - rate) > 1e-3 * rate), None)
    if other is not None:
        raise InputError(f"{recordings[other]}: has {rates[other]:g} frames per second, but {name} has {rate:g}; "
                         "all films "
                         "must have the same frame rate (--fps sets the rate of folders of frames)")  # fmt: skip
    return rate


def read_recording(path: Path, side: int) -> Iterator[tuple[UInt8[Tensor, "h w 3"], tuple[int, int]]]:
    """Yield the frames of a recording in order, reduced to a longest side of `side` pixels, with their original (w, h).

    Raises InputError if a frame's size differs from the first.
    """
    size = None
    for image, full in read_reduced_video(path, side) if path.is_file() else _read_folder(path, side):
        if full != (size := size or full):
            raise InputError(f"{path}: has frames of {size[0]}x{size[1]} and of {full[0]}x{full[1]} pixels; all "
                             "frames of a "
                             "camera must have the same size")  # fmt: skip
        yield image, full


def _read_folder(folder: Path, side: int) -> Iterator[tuple[UInt8[Tensor, "h w 3"], tuple[int, int]]]:
    for file in list_photos(folder):
        image = read_8_bit(file)
        yield limit_size(image, side), (image.shape[1], image.shape[0])


def limit_size(image: UInt8[Tensor, "h w 3"], side: int) -> UInt8[Tensor, "h2 w2 3"]:
    """The image, reduced to a longest side of `side` pixels by area averaging."""
    height, width = image.shape[:2]
    shrink = min(1.0, side / max(height, width))
    if shrink == 1:
        return image
    size = max(1, round(width * shrink)), max(1, round(height * shrink))
    return torch.from_numpy(np.ascontiguousarray(cv2.resize(image.numpy(), size, interpolation=cv2.INTER_AREA)))
