"""A folder of photos, or a video -> photos in memory, the sharpest of them when there are many."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import av
import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.scene.files import must_exist
from stages.core.scene.formats import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from stages.core.scene.images import list_photos, open_video, read_image, to_bytes
from stages.reconstruct.photos import Photos

log = logging.getLogger(__name__)
MAX_PHOTOS = 200  # photos used of a folder: about what a table top can make use of, and what bounds time and memory
MANY_PHOTOS = 60  # from so many photos on they are kept smaller
MAX_SIDES = (1600, 1024)  # photos are kept in memory at no more than this [px]: few, and many
VIDEO_FRAMES = (30, 60)  # fewest and most taken from a video
FRAMES_PER_SECOND = 1.5
MAX_CANDIDATES = 12  # frames in each span of a video whose sharpness is compared
PHONE_SUFFIXES = {".heic", ".heif", ".avif"}
RAW_SUFFIXES = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"}


class LoadedImage(NamedTuple):
    """A photo, or a frame of a video."""

    name: str
    image: UInt8[Tensor, "h w 3"]
    focal: float  # by EXIF, in pixels of `image`; 0 where unknown


def read_photos(path: Path, side: int = 0, least: int = 2) -> Photos:
    """The photos of a folder, in order of name, or the sharpest frames of a video.

    They are kept at `side` pixels or more, if the files have as many. Of more than MOST photos the sharpest of each
    span of neighbours is used; a photo that cannot be read is left out, and said so. Fewer than `least` are refused.
    """
    path = Path(path)
    if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES:
        taken = _from_video(path, max(side, MAX_SIDES[0]))
    elif path.is_file():
        raise InputError(f"{path}: is neither a folder of photos nor a video ({' '.join(sorted(VIDEO_SUFFIXES))})")
    else:
        taken = _from_folder(path, side, least)
    names, images, focals = zip(*taken, strict=True)
    return Photos(images, names, focals, path)


def _from_folder(folder: Path, side: int, least: int) -> list[LoadedImage]:
    files = _files(folder)
    spans, side = min(len(files), MAX_PHOTOS), max(side, MAX_SIDES[len(files) > MANY_PHOTOS])
    unread: dict[str, str] = {}
    best = _sharpest(((i * spans // len(files), t) for i, t in _read_files(files, side, unread)), spans)
    for sentence in unread.values():
        log.warning("left out: %s", sentence)
    if len(best) < least:
        raise InputError(
            next(iter(unread.values())) if unread and not best else
            f"{folder}: holds one photo{' that can be read' if unread else ''}; at least 2, better 10 or more from "
            "around the scene, are needed"
        )  # fmt: skip
    if len(files) > MAX_PHOTOS:
        log.info("%s: of %d photos the sharpest %d were taken, one of each span", folder, len(files), len(best))
    return best


def _files(folder: Path) -> list[Path]:
    """The photos' files; what else lies there is counted, and kinds that would need converting are named."""
    inside = [p for p in sorted(folder.iterdir()) if p.name[0] != "."] if folder.is_dir() else []
    kinds = Counter(p.suffix.lower() for p in inside if p.is_file())
    foreign = {kind: kinds[kind] for kind in sorted({*PHONE_SUFFIXES, *RAW_SUFFIXES} & kinds.keys())}
    advice = "convert them to JPEG first, as photo apps do on export"
    if PHONE_SUFFIXES & foreign.keys():
        advice += ' (heif-convert, or sips on a Mac; a phone set to "most compatible" takes JPEG)'
    if foreign and not IMAGE_SUFFIXES & kinds.keys():
        raise InputError(f"{folder}: holds {_counted(foreign)} photos, which cannot be read; {advice}")
    if not IMAGE_SUFFIXES & kinds.keys() and (instead := next(filter(_is_source, inside), None)):
        raise InputError(f"{folder}: holds no photos itself; give {instead}")
    files = list_photos(folder)
    if foreign:
        log.warning("%s: %s photos are left out; %s", folder, _counted(foreign), advice)
    others = sum(kinds.values()) - len(files) - sum(foreign.values())
    if others > 0:
        log.info("%s: %d photos; %d other files left alone", folder, len(files), others)
    return files


def _is_source(path: Path) -> bool:
    """Whether this is a video, or a folder with photos in it."""
    if path.is_dir():
        return any(p.suffix.lower() in IMAGE_SUFFIXES and p.is_file() for p in path.iterdir())
    return path.suffix.lower() in VIDEO_SUFFIXES


def _counted(kinds: dict[str, int]) -> str:
    return " and ".join(f"{count} {kind[1:].upper()}" for kind, count in kinds.items())


def _read_files(files: list[Path], side: int, unread: dict[str, str]) -> Iterator[tuple[int, LoadedImage]]:
    """Each photo with its place in the list; what is wrong with the others goes to `unread`."""
    for i, file in enumerate(tqdm(files, desc="reading photos", unit="photo", leave=False)):
        try:
            if _is_truncated(must_exist(file, "a photo")):
                raise InputError(f"{file}: breaks off before its end; copy it again from where it came")
            image = read_image(file)
        except InputError as error:
            unread[file.name] = str(error)
            continue
        bounded = _limit_size(to_bytes(image), side)
        yield i, LoadedImage(file.name, bounded, _exif_focal(file) * max(bounded.shape[:2]) / max(image.shape[:2]))


def _is_truncated(file: Path) -> bool:
    """Whether a JPEG lacks its end, which decoders paint grey, or a PNG its last chunk.

    The end is looked for after the header: a thumbnail in the header has an end of its own, and phones append films.
    """
    data = file.read_bytes()
    if data[:2] == b"\xff\xd8":
        at = 2
        while data[at : at + 1] == b"\xff" and data[at : at + 2] != b"\xff\xda":  # segments up to the first scan
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        return data.find(b"\xff\xd9", at) < 0
    return data[:4] == b"\x89PNG" and b"IEND" not in data[-64:]


def _exif_focal(file: Path) -> float:
    """Focal length in pixels of the stored photo by its EXIF tags (and COLMAP's table of sensors), else 0."""
    import pycolmap

    try:
        camera = pycolmap.infer_camera_from_image(str(file))
    except (ValueError, RuntimeError):  # a kind of image that COLMAP does not read, though OpenCV does
        return 0.0
    return float(camera.mean_focal_length()) if camera.has_prior_focal_length else 0.0


def _from_video(path: Path, side: int) -> list[LoadedImage]:
    """The video is cut into spans of equal time, and the sharpest frame of each is taken."""
    with open_video(path) as file:
        times = sorted(float(p.pts * p.time_base) for p in file.demux(video=0) if p.pts is not None)
    length = times[-1] - times[0] if times else 0.0
    spans = int(min(max(length * FRAMES_PER_SECOND, VIDEO_FRAMES[0]), VIDEO_FRAMES[1], len(times)))
    best = _sharpest(_frames(path, times, spans, side), spans)
    if len(best) < 2:
        raise InputError(f"{path}: has {len(best)} frame; a video that moves around the scene is needed")
    log.info("%s: took %d of %d frames, the sharpest of each span", path, len(best), len(times))
    return best


def _frames(path: Path, times: list[float], spans: int, side: int) -> Iterator[tuple[int, LoadedImage]]:
    """Up to LOOKED_AT frames of each span, upright, with the span they fall in. A damaged end is left out."""
    seen: Counter[int] = Counter()
    due = max(1, len(times) // max(1, spans * MAX_CANDIDATES))
    with open_video(path) as file:
        file.streams.video[0].thread_type = "AUTO"
        bar = tqdm(file.decode(video=0), total=len(times), desc="reading video", unit="frame", leave=False)
        try:
            for i, frame in enumerate(bar):
                share = ((frame.time or 0.0) - times[0]) / (times[-1] - times[0]) if times[-1] > times[0] else 0.0
                span = min(max(int(share * spans), 0), spans - 1)
                if i % due and seen[span]:
                    continue
                seen[span] += 1
                shrink = min(1.0, side / max(frame.width, frame.height))
                size = max(2, round(frame.width * shrink)), max(2, round(frame.height * shrink))
                pixels = frame.reformat(*size, format="rgb24", interpolation="AREA").to_ndarray()
                pixels = np.rot90(pixels, round(getattr(frame, "rotation", 0) / 90))
                yield span, LoadedImage(f"frame_{i:05d}", torch.from_numpy(np.ascontiguousarray(pixels)), 0.0)
        except av.FFmpegError as error:
            log.warning("%s: breaks off or is damaged (%s); what comes before is used", path, error.strerror)


def _sharpest(photos: Iterable[tuple[int, LoadedImage]], spans: int) -> list[LoadedImage]:
    """The sharpest photo of each span; none where a span is empty."""
    best: list[tuple[float, LoadedImage] | None] = [None] * spans
    for span, taken in photos:
        score = sharpness(taken.image)
        if best[span] is None or score > best[span][0]:
            best[span] = score, taken
    return [entry[1] for entry in best if entry]


def sharpness(image: UInt8[Tensor, "h w 3"]) -> float:
    """Variance of the Laplacian of the grey image at a fixed small size."""
    grey = cv2.cvtColor(_limit_size(image.numpy(), 512).numpy(), cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def _limit_size(pixels: np.ndarray, side: int) -> UInt8[Tensor, "h2 w2 3"]:
    """The image, no longer than `side`."""
    height, width = pixels.shape[:2]
    shrink = min(1.0, side / max(height, width))
    if shrink < 1:
        size = max(1, round(width * shrink)), max(1, round(height * shrink))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.ascontiguousarray(pixels))
