"""Reading of a folder of photos or a video; if there are many photos or frames, the sharpest are selected."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
from jaxtyping import UInt8
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.scene.formats import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from stages.core.scene.images import image_data, import_av, list_photos, open_video, read_8_bit, reduce_frame
from stages.core.scene.recordings import limit_size
from stages.core.scene.schema import quote
from stages.reconstruct.colmap import import_pycolmap
from stages.reconstruct.photos import Photos

log = logging.getLogger(__name__)
MAX_PHOTOS = 200  # most photos used of a folder, to bound time and memory
MANY_PHOTOS = 60  # number of photos above which they are kept at the smaller size
MAX_SIDES = (1600, 1024)  # longest side of photos in memory [px], for few and for many photos
VIDEO_FRAMES = (30, 60)  # fewest and most frames selected from a video
FRAMES_PER_SECOND = 1.5  # frames selected per second of a video, within VIDEO_FRAMES
MAX_CANDIDATES = 12  # most frames per span of a video whose sharpness is compared
PHONE_SUFFIXES = {".heic", ".heif", ".avif"}
RAW_SUFFIXES = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"}


class LoadedImage(NamedTuple):
    """A photo or a frame of a video."""

    name: str
    image: UInt8[Tensor, "h w 3"]
    focal: float  # from EXIF, in pixels of `image`; 0 where unknown
    file_size: tuple[int, int]  # width, height before `image` was reduced [px]


def read_photos(path: Path, side: int = 0, min_count: int = 2) -> Photos:
    """Read the photos of a folder, sorted by name, or the sharpest frames of a video.

    Photos larger than MAX_SIDES are reduced to it, or to `side` if that is larger. Of more than MAX_PHOTOS photos the
    sharpest of each span of neighbours is used; photos that cannot be read are left out with a warning. Raises
    InputError if fewer than `min_count` photos remain, or for a path without photos.
    """
    path = Path(path)
    if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES:
        loaded = _from_video(path, max(side, MAX_SIDES[0]))
    elif path.is_file():
        raise InputError(f"{path}: is neither a folder of photos nor a video ({' '.join(sorted(VIDEO_SUFFIXES))})")
    else:
        loaded = _from_folder(path, side, min_count)
    names, images, focals, file_sizes = zip(*loaded, strict=True)
    return Photos(images, names, focals, path, file_sizes)


def _from_folder(folder: Path, side: int, min_count: int) -> list[LoadedImage]:
    files = _files(folder)
    spans, side = min(len(files), MAX_PHOTOS), max(side, MAX_SIDES[len(files) > MANY_PHOTOS])
    unread: dict[str, str] = {}
    best = _sharpest(((i * spans // len(files), t) for i, t in _read_files(files, side, unread)), spans)
    for reason in unread.values():
        log.warning("left out: %s", reason)
    if len(best) < min_count:
        raise InputError(
            next(iter(unread.values())) if unread and not best else
            f"{folder}: contains one {'readable ' if unread else ''}photo; at least 2, better 10 or more, from "
            "around the scene, are needed"
        )  # fmt: skip
    if len(files) > MAX_PHOTOS:
        log.info("%s: of %d photos the sharpest %d are used, one from each interval", folder, len(files), len(best))
    return best


def _files(folder: Path) -> list[Path]:
    """The photo files of a folder; other files are counted, and formats that need converting are named."""
    inside = [p for p in sorted(folder.iterdir()) if p.name[0] != "."] if folder.is_dir() else []
    kinds = Counter(p.suffix.lower() for p in inside if p.is_file())
    foreign = {kind: kinds[kind] for kind in sorted({*PHONE_SUFFIXES, *RAW_SUFFIXES} & kinds.keys())}
    advice = "convert them to JPEG first, as photo apps do on export"
    if PHONE_SUFFIXES & foreign.keys():
        advice += ' (heif-convert, or sips on a Mac; a phone set to "most compatible" takes JPEG)'
    if foreign and not IMAGE_SUFFIXES & kinds.keys():
        raise InputError(f"{folder}: contains {_counted(foreign)} photos, which cannot be read; {advice}")
    if not IMAGE_SUFFIXES & kinds.keys() and (instead := next(filter(_is_source, inside), None)):
        raise InputError(f"{folder}: contains no photos itself; give {instead}")
    files = list_photos(folder)
    if foreign:
        log.warning("%s: %s photos are left out; %s", folder, _counted(foreign), advice)
    others = sum(kinds.values()) - len(files) - sum(foreign.values())
    if others > 0:
        log.info("%s: %d photos; %d other files ignored", folder, len(files), others)
    return files


def _is_source(path: Path) -> bool:
    """Whether a path is a video, or a folder that contains photos."""
    if path.is_dir():
        return any(p.suffix.lower() in IMAGE_SUFFIXES and p.is_file() for p in path.iterdir())
    return path.suffix.lower() in VIDEO_SUFFIXES


def _counted(kinds: dict[str, int]) -> str:
    """Counts by suffix in words, such as "2 HEIC and 1 DNG"."""
    return " and ".join(f"{count} {kind[1:].upper()}" for kind, count in kinds.items())


def _read_files(files: list[Path], side: int, unread: dict[str, str]) -> Iterator[tuple[int, LoadedImage]]:
    """Each readable photo with its index; the errors of the others are added to `unread`, by file name."""
    for i, file in enumerate(tqdm(files, desc="reading photos", unit="photo", leave=False)):
        try:
            if file.name.encode(errors="replace").decode() != file.name:
                raise InputError(f"{file.parent / quote(file.name)}: has a name that is not UTF-8; rename it")
            if _is_truncated(image_data(file, "a photo")):
                raise InputError(f"{file}: is truncated; copy it again from its source")
            image = read_8_bit(file)
        except InputError as error:
            unread[file.name] = str(error)
            continue
        bounded = limit_size(image, side)
        height, width = image.shape[:2]
        focal = _exif_focal(file) * max(bounded.shape[:2]) / max(width, height)
        yield i, LoadedImage(file.name, bounded, focal, (width, height))


def _is_truncated(data: bytes) -> bool:
    """Whether a JPEG has no end marker (decoders fill the missing part with grey), or a PNG no last chunk.

    The marker is searched for after the header segments, since thumbnails in them have one too, and not only at the
    end, since phones append videos.
    """
    if data[:2] == b"\xff\xd8":
        at = 2
        while data[at : at + 1] == b"\xff" and data[at : at + 2] != b"\xff\xda":  # segments up to the first scan
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        return data.find(b"\xff\xd9", at) < 0
    return data[:4] == b"\x89PNG" and b"IEND" not in data[-64:]


def _exif_focal(file: Path) -> float:
    """Focal length in pixels of the stored photo from EXIF (and COLMAP's table of sensors), 0 where unknown.

    It is also 0 if pycolmap is absent: `estimate_cameras`, which needs pycolmap, reports that; networks do not need it.
    """
    try:
        pycolmap = import_pycolmap()
    except ImportError:
        return 0.0
    try:
        camera = pycolmap.infer_camera_from_image(str(file))
    except (ValueError, RuntimeError):  # a format that OpenCV reads and COLMAP does not
        return 0.0
    return float(camera.mean_focal_length()) if camera.has_prior_focal_length else 0.0


def _from_video(path: Path, side: int) -> list[LoadedImage]:
    """The sharpest frame of each span of a video; spans have equal duration."""
    with open_video(path) as file:
        times = sorted(float(p.pts * p.time_base) for p in file.demux(video=0) if p.pts is not None)
    length = times[-1] - times[0] if times else 0.0
    spans = int(min(max(length * FRAMES_PER_SECOND, VIDEO_FRAMES[0]), VIDEO_FRAMES[1], len(times)))
    best = _sharpest(_frames(path, times, spans, side), spans)
    if len(best) < 2:
        raise InputError(f"{path}: has {len(best)} frame; give a video whose camera moves around the scene")
    log.info("%s: %d of %d frames are used, the sharpest of each interval", path, len(best), len(times))
    return best


def _frames(path: Path, times: list[float], spans: int, side: int) -> Iterator[tuple[int, LoadedImage]]:
    """Up to about MAX_CANDIDATES upright frames per span, each with its span; reading ends at damaged data."""
    seen: Counter[int] = Counter()
    interval = max(1, len(times) // max(1, spans * MAX_CANDIDATES))
    with open_video(path) as file:
        file.streams.video[0].thread_type = "AUTO"
        bar = tqdm(file.decode(video=0), total=len(times), desc="reading video", unit="frame", leave=False)
        try:
            for i, frame in enumerate(bar):
                fraction = ((frame.time or 0.0) - times[0]) / (times[-1] - times[0]) if times[-1] > times[0] else 0.0
                span = min(max(int(fraction * spans), 0), spans - 1)
                if i % interval and seen[span]:
                    continue
                seen[span] += 1
                image, full = reduce_frame(frame, side)
                yield span, LoadedImage(f"frame_{i:05d}", image, 0.0, full)
        except import_av(path).FFmpegError as error:
            log.warning("%s: is truncated or damaged (%s); the frames before the damage are used", path, error.strerror)


def _sharpest(photos: Iterable[tuple[int, LoadedImage]], spans: int) -> list[LoadedImage]:
    """The sharpest photo of each span that has one."""
    best: list[tuple[float, LoadedImage] | None] = [None] * spans
    for span, loaded in photos:
        score = sharpness(loaded.image)
        if best[span] is None or score > best[span][0]:
            best[span] = score, loaded
    return [entry[1] for entry in best if entry]


def sharpness(image: UInt8[Tensor, "h w 3"]) -> float:
    """Sharpness of an image: variance of the Laplacian of the grey image, reduced to at most 512 px."""
    grey = cv2.cvtColor(limit_size(image, 512).numpy(), cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())
