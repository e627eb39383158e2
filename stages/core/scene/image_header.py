"""Read the size of an image from its file header, before memory is allocated for its pixels."""

from __future__ import annotations

import zlib
from typing import NamedTuple

from stages.core.scene.schema import MAX_DEFLATE_RATIO

MAX_PIXELS = 1 << 27  # maximum number of pixels of an image, 134 million
MAX_RATIO = 4096  # largest ratio of uncompressed to stored bytes in formats other than PNG; JPEG reaches 1500
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # number of channels by colour type
JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # start-of-frame markers: all but DHT, JPG and DAC
JPEG_ALONE = {0x01, *range(0xD0, 0xD9)}  # markers without a length field
TIFF_WIDTH, TIFF_HEIGHT, TIFF_TILE_WIDTH, TIFF_TILE_HEIGHT = 256, 257, 322, 323


class ImageHeader(NamedTuple):
    """Size that the header of an image file declares."""

    width: int  # [px]
    height: int
    stored: float = 0.0  # lower bound of the file's size [bytes]; 0: unknown


def read_image_header(data: bytes) -> ImageHeader:
    """The header of a PNG, JPEG, WebP, BMP or TIFF file. Raises ValueError for anything else."""
    for begin, read in (
        (b"\x89PNG\r\n\x1a\n", _png), (b"\xff\xd8", _jpeg), (b"RIFF", _webp), (b"BM", _bmp), (b"II", _tiff),
        (b"MM", _tiff),
    ):  # fmt: skip
        if data.startswith(begin):
            return read(data)
    raise ValueError("no image")


def png_of_numbers(data: bytes) -> tuple[bytes, int]:
    """A one-channel PNG that decodes to the stored numbers of this PNG times the returned factor.

    With a palette, the stored numbers are its indices, which annotation tools use as labels. Decoders stretch numbers
    of fewer than 8 bits to the range 0 to 255, hence the factor. PNGs of several channels are returned unchanged, as
    are those with a palette of greys that differ from their indices, where the greys may be the labels.
    """
    chunks, at = [], 8
    while at < len(data):
        chunks.append(data[at : at + 12 + _big(data, at, 4)])
        at += len(chunks[-1])
    depth, colour = data[24], data[25]
    palette = next((c[8:-4] for c in chunks if c[4:8] == b"PLTE"), b"") if colour == 3 else b""
    greys = palette[::3] == palette[1::3] == palette[2::3]
    if colour not in (0, 3) or (greys and palette[::3] != bytes(range(len(palette) // 3))):
        return data, 1
    size = b"IHDR" + data[16:25] + b"\0" + data[26:29]
    needed = [c for c in chunks if c[4:8] in (b"IDAT", b"IEND")]
    head = [data[:8], data[8:12], size, zlib.crc32(size).to_bytes(4, "big")]
    return b"".join(head + needed), {1: 255, 2: 85, 4: 17}.get(depth, 1)


def _png(data: bytes) -> ImageHeader:
    """Read the header, and check the length of each chunk, which decoders allocate."""
    if data[12:16] != b"IHDR" or data[25] not in PNG_CHANNELS:
        raise ValueError("no image")
    at = 8
    while at < len(data) and data[at + 4 : at + 8] != b"IEND":
        at += 12 + _big(data, at, 4)
        if at > len(data):
            raise ValueError("a chunk is longer than the file")
    width, height = _big(data, 16, 4), _big(data, 20, 4)
    return ImageHeader(width, height, height * (width * data[24] * PNG_CHANNELS[data[25]] / 8) / MAX_DEFLATE_RATIO)


def _jpeg(data: bytes) -> ImageHeader:
    at = 2
    while (at := data.find(b"\xff", at)) >= 0 and at + 9 < len(data):
        marker = data[at + 1]
        if marker in JPEG_FRAMES:
            width, height = _big(data, at + 7, 2), _big(data, at + 5, 2)
            return ImageHeader(width, height, width * height * data[at + 9] / MAX_RATIO)
        skip = marker in (0, 0xFF) or marker in JPEG_ALONE
        at += 1 if skip else 2 + _big(data, at + 2, 2)
    raise ValueError("no image")


def _webp(data: bytes) -> ImageHeader:
    """Read the header, without a bound of the file's size: an image of one colour has few bytes at any resolution."""
    kind = data[12:16]
    if data[8:12] != b"WEBP" or len(data) < 30:
        raise ValueError("no image")
    if kind == b"VP8X":
        return ImageHeader(_little(data, 24, 3) + 1, _little(data, 27, 3) + 1)
    if kind == b"VP8L":
        bits = _little(data, 21, 4)
        return ImageHeader((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1)
    return ImageHeader(_little(data, 26, 2) & 0x3FFF, _little(data, 28, 2) & 0x3FFF)


def _bmp(data: bytes) -> ImageHeader:
    old = _little(data, 14, 4) == 12
    width, height = (_little(data, 18 + (2 if old else 4) * i, 2 if old else 4, signed=not old) for i in range(2))
    return ImageHeader(
        abs(width), abs(height), abs(width * height) * _little(data, 24 if old else 28, 2) / 8 / MAX_RATIO
    )


def _tiff(data: bytes) -> ImageHeader:
    """Read the size of the first image, or of a tile if that is larger, since decoders allocate whole tiles."""
    order = "little" if data[:2] == b"II" else "big"

    def number(at: int, length: int) -> int:
        if at + length > len(data):
            raise ValueError("no image")
        return int.from_bytes(data[at : at + length], order)

    big = number(2, 2) == 43  # BigTIFF, with 64-bit offsets
    if not big and number(2, 2) != 42:
        raise ValueError("no image")
    start, entry, word = (number(8, 8), 20, 8) if big else (number(4, 4), 12, 4)
    first = start + (8 if big else 2)
    tags = {}
    for at in range(first, first + entry * number(start, first - start), entry):
        if number(at, 2) in (TIFF_WIDTH, TIFF_HEIGHT, TIFF_TILE_WIDTH, TIFF_TILE_HEIGHT):
            tags[number(at, 2)] = number(at + 4 + word, {3: 2, 4: 4}.get(number(at + 2, 2), word))
    if TIFF_WIDTH not in tags or TIFF_HEIGHT not in tags:
        raise ValueError("no image")
    width = max(tags[tag] for tag in (TIFF_WIDTH, TIFF_TILE_WIDTH) if tag in tags)
    height = max(tags[tag] for tag in (TIFF_HEIGHT, TIFF_TILE_HEIGHT) if tag in tags)
    return ImageHeader(width, height, width * height / 8 / MAX_RATIO)


def _big(data: bytes, at: int, length: int) -> int:
    return int.from_bytes(data[at : at + length], "big")


def _little(data: bytes, at: int, length: int, signed: bool = False) -> int:
    return int.from_bytes(data[at : at + length], "little", signed=signed)
