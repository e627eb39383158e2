"""Read and write images and videos; the only module that handles OpenCV's BGR order."""

from __future__ import annotations

import logging
import re
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from stages.core.errors import InputError, MissingPackage
from stages.core.scene.files import must_exist, replacing
from stages.core.scene.formats import IMAGE_SUFFIXES
from stages.core.scene.image_header import MAX_PIXELS, png_of_numbers, read_image_header

log = logging.getLogger(__name__)
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # our own errors say the same in one line
IGNORE_LABEL = 255  # value of pixels in label images that are not evaluated
MAX_IMAGE_BYTES = 1 << 30  # largest image file [bytes]
MAX_FLOAT = 16.0  # largest value of float images, whose white is 1 (highlights have more); above it white is 255
MAX_VIDEO_PIXELS = 1 << 26  # maximum number of pixels of a video frame; 8K has half as many
ENCODER_THREADS = 4  # fixed, because the encoded file depends on the number of threads
MAX_PENDING_FRAMES = 8  # maximum number of video frames that wait for the encoder


def list_photos(folder: Path) -> list[Path]:
    """Image files of a folder, without hidden files. Raises InputError if there are none.

    They are sorted by name, with numbers in names compared by value: 9.png comes before 10.png.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; give a folder of photos or a video file")
    photos = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    if not photos:
        raise InputError(f"{folder}: contains no photos; supported formats: {' '.join(sorted(IMAGE_SUFFIXES))}")
    return sorted(photos, key=_numbered_name)


def _numbered_name(path: Path) -> tuple[list, str]:
    """Sort key: the parts of a file's name, digits as numbers, then the name, since 01 and 1 are equal."""
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name


def read_image(path: Path) -> Float[Tensor, "h w 3"]:
    """Read an image as RGB in 0..1, rotated by its EXIF tag; alpha is dropped, 16-bit values keep their precision."""
    return _to_floats(path, _read_rgb(path))


def read_8_bit(path: Path) -> UInt8[Tensor, "h w 3"]:
    """As `read_image`, with 8 bits per channel; 8-bit files are not converted to floats in between."""
    pixels = _read_rgb(path)
    return torch.from_numpy(pixels if pixels.dtype == np.uint8 else to_bytes(_to_floats(path, pixels)))


def _read_rgb(path: Path) -> np.ndarray:
    data = image_data(path)
    _check_header(path, data)
    return cv2.cvtColor(_decode(path, data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH), cv2.COLOR_BGR2RGB)


def _to_floats(path: Path, pixels: np.ndarray) -> Float[Tensor, "h w 3"]:
    image = pixels.astype(np.float32)
    image /= np.float32(np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1.0)
    if pixels.dtype.kind == "f" and not (np.isfinite(image).all() and image.max() <= MAX_FLOAT):
        raise InputError(f"{path}: has values that are not finite, or not from 0 to 1; convert it to JPEG or PNG")
    return torch.from_numpy(image)


def read_labels(path: Path, max_bits: int = 16) -> Int[Tensor, "h w"]:
    """Read a label image: one integer per pixel (of at most `max_bits` bits), or the indices of a palette.

    Raises InputError for several channels, and for JPEG, whose compression changes the numbers at outlines.
    """
    data, factor = image_data(path, "a label image"), 1
    _check_header(path, data)
    if data.startswith(b"\xff\xd8"):
        raise InputError(f"{path}: is a JPEG, whose compression changes the numbers; save the label image as PNG")
    if data.startswith(b"\x89PNG"):
        data, factor = png_of_numbers(data)
    pixels = _decode(path, data, cv2.IMREAD_UNCHANGED)
    if pixels.ndim != 2:
        raise InputError(
            f"{path}: has {pixels.shape[2]} channels; a label image has one channel, which holds the object numbers"
        )
    if pixels.dtype.kind != "u":
        raise InputError(f"{path}: has values of type {pixels.dtype}; save the label image with 8 bits, as PNG")
    if 8 * pixels.itemsize > max_bits:
        raise InputError(f"{path}: has {8 * pixels.itemsize} bits per pixel; save the label image with {max_bits}")
    return torch.from_numpy(pixels.astype(np.int64) // factor)


def image_data(path: Path, what: str = "an image") -> bytes:
    """The bytes of an image file. Raises InputError, which says that `what` is expected, if it is absent or empty.

    Also raises InputError if the file is too large.
    """
    must_exist(path, what)
    with Path(path).open("rb") as file:
        data = file.read(MAX_IMAGE_BYTES + 1)
    if len(data) > MAX_IMAGE_BYTES:
        raise InputError(
            f"{path}: has more than {MAX_IMAGE_BYTES >> 20} MB; reduce the image, for example to 4000 pixels"
        )
    return data


def _check_header(path: Path, data: bytes) -> None:
    """Raise InputError for files other than images, and for more pixels than the file can hold."""
    try:
        header = read_image_header(data)
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: is not an image that can be read; convert it to JPEG or PNG") from error
    if header.width * header.height > MAX_PIXELS or header.stored > len(data):
        raise InputError(f"{path}: is damaged, or far too large ({header.width}x{header.height} pixels in {len(data)} "
                         "bytes); reduce the image, for example to 4000 pixels")  # fmt: skip


def _decode(path: Path, data: bytes, flags: int) -> np.ndarray:
    """Decode an image whose header was checked, to BGR. Raises InputError if it is damaged."""
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        if error.code == cv2.Error.STS_NO_MEM:
            raise
        raise InputError(f"{path}: is damaged; convert it to JPEG or PNG") from error
    if pixels is None:
        raise InputError(f"{path}: is not an image that can be read; convert it to JPEG or PNG")
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):  # TIFF allows other types
        raise InputError(f"{path}: has values of type {pixels.dtype}; convert it to 8 bits, as PNG")
    return pixels


def resize(image: Float[Tensor, "h w c"], width: int, height: int) -> Float[Tensor, "h2 w2 c"]:
    """Resize by area averaging to a smaller width, bilinearly to a larger one."""
    shrink = width < image.shape[1]
    pixels = cv2.resize(image.numpy(), (width, height), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
    return torch.from_numpy(pixels.reshape(height, width, -1))


def to_bytes(image: Float[Tensor, "h w 3"]) -> np.ndarray:
    """Convert RGB in 0..1 to 8 bits (h, w, 3), clamped and rounded."""
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def write_png(path: Path, image: Float[Tensor, "h w 3"]) -> None:
    """Write an 8-bit RGB PNG."""
    _write_pixels(path, cv2.cvtColor(to_bytes(image), cv2.COLOR_RGB2BGR))


def write_jpeg(path: Path, image: Float[Tensor, "h w 3"], quality: int = 92) -> None:
    """Write an 8-bit JPEG."""
    with replacing(path) as part:
        part.write_bytes(to_jpeg(image, quality))


def to_jpeg(image: Float[Tensor, "h w 3"], quality: int = 92) -> bytes:
    """The contents of an 8-bit JPEG file."""
    pixels = cv2.cvtColor(to_bytes(image), cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def write_labels(path: Path, labels: Int[Tensor, "h w"]) -> None:
    """Write a one-channel PNG of integers: 8 bits, or 16 bits for labels above 255."""
    highest = int(labels.max()) if labels.numel() else 0
    _write_pixels(path, labels.cpu().numpy().astype(np.uint8 if highest < 256 else np.uint16))


def write_depth(path: Path, depth: Float[Tensor, "h w"], unit: float = 1e-3) -> None:
    """Write depth as a 16-bit PNG in steps of `unit`, by default thousandths of a scene unit; 0: no surface."""
    _write_pixels(path, (depth.cpu() / unit).round().clamp(0, 65535).numpy().astype(np.uint16))


def _write_pixels(path: Path, pixels: np.ndarray) -> None:
    done, data = cv2.imencode(".png", pixels)
    if not done:
        raise InputError(f"{path}: the image could not be encoded as PNG")
    with replacing(path) as part:
        part.write_bytes(data.tobytes())


class VideoWriter:
    """Context manager that writes an H.264 MP4 frame by frame (yuv420p, index first, as browsers need it).

    A thread encodes while the next frames are computed. The file appears only on success. yuv420p needs even sizes, so
    an odd last row or column is dropped. `fps` is in frames per second.
    """

    def __init__(self, path: Path, fps: float):
        self.path, self.fps = Path(path), fps
        self._stream = None
        self._pending: deque[Future] = deque()

    def __enter__(self) -> VideoWriter:
        self._av = import_av(self.path)
        self._replacing = replacing(self.path)
        self._file = self._av.open(str(self._replacing.__enter__()), "w", options={"movflags": "faststart"})
        self._thread = ThreadPoolExecutor(1)
        return self

    def append(self, image: Float[Tensor, "h w 3"]) -> None:
        """Queue a frame, RGB in 0..1, for encoding; all frames have the same size. Raises errors of earlier frames."""
        self._pending.append(self._thread.submit(self._encode, to_bytes(image)))
        while len(self._pending) > MAX_PENDING_FRAMES:
            self._pending.popleft().result()

    def _encode(self, pixels: np.ndarray) -> None:
        pixels = pixels[: pixels.shape[0] // 2 * 2, : pixels.shape[1] // 2 * 2]
        if self._stream is None:
            rate = Fraction(self.fps).limit_denominator(1000)
            self._stream = self._file.add_stream("libx264", rate=rate, options={"crf": "17", "preset": "medium"})
            self._stream.height, self._stream.width = pixels.shape[:2]
            self._stream.pix_fmt = "yuv420p"
            self._stream.codec_context.thread_count = ENCODER_THREADS
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
        self._file.mux(self._stream.encode(frame))

    def __exit__(self, kind, error, trace) -> None:
        self._thread.shutdown(cancel_futures=kind is not None)
        try:
            for encoded in self._pending if kind is None else ():
                encoded.result()
            if kind is None and self._stream is not None:
                self._file.mux(self._stream.encode())
            self._file.close()
        except OSError as failed:
            kind, error, trace = type(failed), failed, failed.__traceback__
        self._replacing.__exit__(kind, error, trace)


def video_info(path: Path) -> tuple[int, float]:
    """Number of frames (as the container states it; 0: unknown) and frames per second."""
    with open_video(path) as file:
        stream = file.streams.video[0]
        return stream.frames, float(stream.average_rate or 0)


def read_video(path: Path) -> Iterator[Float[Tensor, "h w 3"]]:
    """Yield the frames of a video in order, upright, as RGB in 0..1. Raises InputError for a damaged video."""
    with open_video(path) as file:
        try:
            for frame in file.decode(video=0):
                yield torch.from_numpy(_upright(frame, frame.to_ndarray(format="rgb24")).astype(np.float32) / 255)
        except import_av(path).FFmpegError as error:
            raise InputError(
                f"{path}: the video is truncated or damaged ({error.strerror}); copy it again from its source"
            ) from error


def read_reduced_video(path: Path, side: int) -> Iterator[tuple[UInt8[Tensor, "h w 3"], tuple[int, int]]]:
    """Yield the frames of a video, upright and reduced to a longest side of `side` pixels, with their original (w, h).

    Logs a warning and ends if the video is truncated.
    """
    with open_video(path) as file:
        stream, count = file.streams.video[0], 0
        stream.thread_type = "AUTO"
        try:
            for count, frame in enumerate(file.decode(video=0), 1):  # noqa: B007 -- counted
                yield reduce_frame(frame, side)
        except import_av(path).FFmpegError as error:
            log.warning("%s: is truncated or damaged (%s); the frames before the damage are used", path, error.strerror)
            return
    if count < stream.frames:  # with threads, the decoder reports no error at the end of a truncated file
        log.warning("%s: is truncated or damaged; %d of its %d frames are used", path, count, stream.frames)


def reduce_frame(frame: Any, side: int) -> tuple[UInt8[Tensor, "h w 3"], tuple[int, int]]:
    """A PyAV frame, rotated upright and reduced to a longest side of `side` pixels, and its original (w, h)."""
    shrink = min(1.0, side / max(frame.width, frame.height))
    size = max(2, round(frame.width * shrink)), max(2, round(frame.height * shrink))
    pixels = frame.reformat(*size, format="rgb24", interpolation="AREA").to_ndarray()
    full = (frame.height, frame.width) if _quarter_turns(frame) % 2 else (frame.width, frame.height)
    return torch.from_numpy(_upright(frame, pixels)), full


def _quarter_turns(frame: Any) -> int:
    """Number of anticlockwise turns by 90 degrees that make a PyAV frame upright."""
    return round(getattr(frame, "rotation", 0) / 90)


def _upright(frame: Any, pixels: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.rot90(pixels, _quarter_turns(frame)))


def sample_frames(video: Path, count: int, longest: int) -> list[bytes]:
    """`count` evenly spaced frames of a video, including the first and the last, as JPEG of at most `longest` px.

    Gives all frames of a shorter video. Raises InputError for a video that cannot be read or has no frames.
    """
    total = video_info(video)[0] or sum(1 for _ in read_video(video))
    jpegs, frames = _sample(video, total, count, longest)
    if frames != total:  # the container's frame count is wrong
        jpegs, _ = _sample(video, frames, count, longest)
    if not jpegs:
        raise InputError(f"{video}: contains no frames; give another video")
    return jpegs


def _sample(video: Path, total: int, count: int, longest: int) -> tuple[list[bytes], int]:
    """`count` evenly spaced frames among the first `total`, and the number of all frames."""
    wanted = {round(i * (total - 1) / max(count - 1, 1)) for i in range(count)}
    jpegs, frames = [], 0
    for frames, image in enumerate(read_video(video), 1):
        if frames - 1 in wanted:
            h, w = image.shape[:2]
            factor = min(1.0, longest / max(h, w))
            jpegs.append(to_jpeg(resize(image, max(1, round(w * factor)), max(1, round(h * factor))), 85))
    return jpegs, frames


def import_av(path: Path) -> ModuleType:
    """Import PyAV, which only videos need. Raises MissingPackage, naming the video `path`, if it is not installed."""
    try:
        import av
    except ImportError as error:
        raise MissingPackage(f"{path}: videos need the package av, which is not installed; `pip install av`") from error
    return av


def open_video(path: Path) -> Any:
    """Open a video for decoding: an av.container.InputContainer. Raises InputError for other files."""
    must_exist(path, "a video")
    av = import_av(path)
    try:
        # titles and comments may be in any encoding; PyAV 19 no longer has this argument, and never fails on them
        options = {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}
        file = av.open(str(path), **options)
    except (av.FFmpegError, OSError, ValueError) as error:
        raise InputError(f"{path}: is not a video that can be read; convert it to MP4") from error
    if not file.streams.video:
        file.close()
        raise InputError(f"{path}: contains no video stream; give another file")
    codec = file.streams.video[0].codec_context  # None for a codec that the library does not support
    width, height = (codec.width, codec.height) if codec is not None else (0, 0)
    if not width * height:
        file.close()
        raise InputError(f"{path}: is not a video that can be read; convert it to MP4")
    if width * height > MAX_VIDEO_PIXELS:
        file.close()
        raise InputError(f"{path}: has frames of {width}x{height} pixels, but at most {MAX_VIDEO_PIXELS >> 20} "
                         "million are "
                         "supported; reduce their size")  # fmt: skip
    return file
