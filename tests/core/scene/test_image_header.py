"""Sizes in image headers equal those of the decoder, and impossible sizes are refused before decoding."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest

from stages.core.errors import InputError
from stages.core.scene import images
from stages.core.scene.image_header import read_image_header
from stages.core.scene.images import read_image, read_labels

FORMATS = {
    ".png": [], ".jpg": [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], ".jpeg": [cv2.IMWRITE_JPEG_RST_INTERVAL, 2], ".bmp": [],
    ".webp": [cv2.IMWRITE_WEBP_QUALITY, 80], ".tif": [cv2.IMWRITE_TIFF_COMPRESSION, 1],
    ".tiff": [cv2.IMWRITE_TIFF_COMPRESSION, 5],
}  # fmt: skip
DEEP = (".png", ".tif", ".tiff")  # formats that can have 16 bits


def encode(suffix, pixels):
    return cv2.imencode(suffix, pixels, FORMATS[suffix])[1].tobytes()


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("channels", [1, 3])
def test_sizes_are_those_of_the_decoder(suffix, channels):
    pixels = np.random.default_rng(0).integers(0, 255, (37, 300, channels), np.uint8)
    data = encode(suffix, pixels)
    header = read_image_header(data)
    assert (header.width, header.height) == (300, 37) and header.stored < len(data)


@pytest.mark.parametrize(("format", "options"), [
    ("PNG", {}), ("JPEG", {"comment": "x" * 60000, "exif": b"Exif\0\0" + b"\xff\xc0" * 900}), ("BMP", {}),
    ("WEBP", {"lossless": True}), ("WEBP", {"exif": b"Exif\0\0"}), ("TIFF", {"big_tiff": True}),
    ("TIFF", {"compression": "tiff_deflate"}),
])  # fmt: skip
def test_sizes_are_those_of_pillow(format, options):
    image = pytest.importorskip("PIL.Image")
    file = io.BytesIO()
    image.new("RGB", (300, 37)).save(file, format, **options)
    header = read_image_header(file.getvalue())
    assert (header.width, header.height) == (300, 37)


@pytest.mark.parametrize(
    ("suffix", "dtype"), [*((suffix, np.uint8) for suffix in FORMATS), *((suffix, np.uint16) for suffix in DEEP)]
)
def test_blank_images_can_be_held(suffix, dtype):
    pixels = np.zeros((5000, 6000), dtype)
    data = encode(suffix, pixels)
    assert read_image_header(data).stored < len(data)


def with_size(suffix, side):
    """A small image whose header declares `side` x `side` pixels."""
    data = encode(suffix, np.zeros((8, 8, 3), np.uint8))
    if suffix == ".png":
        chunk = b"IHDR" + struct.pack(">II", side, side) + data[24:29]
        return data[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
    if suffix in (".jpg", ".jpeg"):
        at = data.index(b"\xff\xc2" if suffix == ".jpg" else b"\xff\xc0") + 5
        return data[:at] + struct.pack(">HH", side, side) + data[at + 4 :]
    if suffix == ".bmp":
        return data[:18] + struct.pack("<ii", side, -side) + data[26:]
    for tag in (256, 257):
        at = data.index(struct.pack("<HHI", tag, 3, 1))
        data = data[:at] + struct.pack("<HHII", tag, 4, 1, side) + data[at + 12 :]
    return data


@pytest.mark.parametrize("side", [5000, 40_000])
@pytest.mark.parametrize("suffix", [suffix for suffix in FORMATS if suffix != ".webp"])
def test_more_pixels_than_the_file_holds_are_refused_before_decoding(tmp_path, monkeypatch, suffix, side):
    monkeypatch.setattr(images.cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    path = tmp_path / f"x{suffix}"
    path.write_bytes(with_size(suffix, side))
    for read in (read_image, read_labels):
        with pytest.raises(InputError, match=rf"x{suffix}: is damaged, or far too large \({side}x{side} pixels in"):
            read(path)


def test_webp_of_too_many_pixels_and_tiles_that_are_too_large_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(images.cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    canvas = b"WEBPVP8X" + struct.pack("<II", 10, 0) + b"\xff\xff\x00" * 2 + b"VP8 " + bytes(20)
    tags = [(256, 8), (257, 8), (258, 8), (322, 1 << 15), (323, 1 << 15)]
    tiles = struct.pack(">IH", 8, len(tags)) + b"".join(struct.pack(">HHIHH", t, 3, 1, v, 0) for t, v in tags)
    for name, data in (("a.webp", b"RIFF" + struct.pack("<I", len(canvas)) + canvas), ("b.tif", b"MM\0*" + tiles)):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=f"{name}: is damaged, or far too large"):
            read_image(tmp_path / name)


def test_a_chunk_of_a_png_that_is_longer_than_the_file_is_refused_before_decoding(tmp_path, monkeypatch):
    data = encode(".png", np.zeros((8, 8), np.uint8))
    at = data.index(b"IDAT") - 4
    length = int.from_bytes(data[at : at + 4], "big")
    (tmp_path / "a.png").write_bytes(data[:at] + struct.pack(">I", length) + data[at + 4 :] + b"after its end")
    assert not read_image(tmp_path / "a.png").any()
    monkeypatch.setattr(images.cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    for wrong in (len(data) - at - 11, 2_097_152_160):
        (tmp_path / "b.png").write_bytes(data[:at] + struct.pack(">I", wrong) + data[at + 4 :])
        with pytest.raises(InputError, match="b.png: is not an image that can be read"):
            read_image(tmp_path / "b.png")


@pytest.mark.parametrize("suffix", FORMATS)
def test_headers_that_break_off_are_refused(tmp_path, suffix):
    data = encode(suffix, np.zeros((8, 8, 3), np.uint8))
    for length in range(1, 30):
        (tmp_path / "x").write_bytes(data[:length])
        with pytest.raises(InputError, match="x: is (not an image|damaged)"):
            read_image(tmp_path / "x")


def test_files_of_other_kinds_and_of_any_length_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "x.png"
    path.write_bytes(b"P5 8 8 255\n" + bytes(64))  # OpenCV would read it
    with pytest.raises(InputError, match="x.png: is not an image that can be read; convert it"):
        read_image(path)
    with path.open("wb") as file:
        file.truncate(images.MAX_IMAGE_BYTES + 1)
    monkeypatch.setattr(images, "MAX_IMAGE_BYTES", 1 << 20)
    with pytest.raises(InputError, match="x.png: has more than 1 MB"):
        read_image(path)


def tiff(order: str, tags: dict[int, tuple[int, int]]) -> bytes:
    """The header of a TIFF file with these tags, given by kind (3: 16 bits, 4: 32 bits) and value."""
    entries = b"".join(struct.pack(order + ("HHIHxx" if kind == 3 else "HHII"), tag, kind, 1, value)
                       for tag, (kind, value) in tags.items())  # fmt: skip
    name = b"II*\0" if order == "<" else b"MM\0*"
    return name + struct.pack(order + "I", 10) + b"\0\0" + struct.pack(order + "H", len(tags)) + entries + bytes(4)


@pytest.mark.parametrize("order", "<>")
def test_sizes_of_tiff_files_are_those_of_the_tags_or_of_a_larger_tile(order):
    data = tiff(order, {255: (3, 9), 256: (3, 300), 257: (4, 70_000), 258: (3, 8)})
    header = read_image_header(data)
    assert header[:2] == (300, 70_000) and header.stored == pytest.approx(300 * 70_000 / 8 / 4096)
    tiles = {256: (4, 300), 257: (4, 37), 322: (3, 512), 323: (3, 32)}
    assert read_image_header(tiff(order, tiles))[:2] == (512, 37)
    for size in ({256: (3, 300)}, {257: (3, 37), 322: (3, 512), 323: (3, 32)}, {}):
        with pytest.raises(ValueError, match="no image"):
            read_image_header(tiff(order, size))
    with pytest.raises(ValueError, match="no image"):
        read_image_header(data[:2] + data[2:4][::-1] + data[4:])
    with pytest.raises(ValueError, match="no image"):
        read_image_header(data[:40])


def test_sizes_of_bmp_files_of_both_kinds():
    """A negative height means rows from top to bottom; the older kind has 16 bits per side."""
    new = b"BM" + bytes(12) + struct.pack("<IiiHH", 40, 300, -37, 1, 24)
    assert read_image_header(new) == (300, 37, pytest.approx(300 * 37 * 3 / 4096))
    old = b"BM" + bytes(12) + struct.pack("<IHHHH", 12, 40_000, 37, 1, 8)
    assert read_image_header(old) == (40_000, 37, pytest.approx(40_000 * 37 / 4096))


@pytest.mark.parametrize("marker", [0xC4, 0xC8, 0xCC, 0xDB, 0xFE])
def test_segments_of_a_jpeg_before_its_frame_are_skipped(marker):
    """Includes segments whose markers resemble those of frames; the file may end after the number of channels."""
    frame = b"\xff\xc2" + struct.pack(">HBHHB", 8, 8, 37, 300, 3)
    between = bytes([0xFF, marker]) + struct.pack(">H", 12) + b"\xff\xc0" * 5
    alone = b"\xff\xff\x01\xff\xd0\xff\xd7"  # fill bytes, and markers without a length
    data = b"\xff\xd8" + between + alone + frame
    assert read_image_header(data) == (300, 37, pytest.approx(300 * 37 * 3 / 4096))
    with pytest.raises(ValueError, match="no image"):
        read_image_header(data[:-1])


def test_bound_of_a_png_is_that_of_deflate():
    """The tested images have 16 bits and all channels of each colour type."""
    for kind, channels in ((0, 1), (2, 3), (3, 1), (4, 2), (6, 4)):
        body = b"IHDR" + struct.pack(">IIBBBBB", 300, 37, 16, kind, 0, 0, 0)
        data = (
            b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + body + bytes(4) + struct.pack(">I", 0) + b"IEND" + bytes(4)
        )
        assert read_image_header(data) == (300, 37, pytest.approx(37 * 300 * 2 * channels / 1100))
        with pytest.raises(ValueError, match="a chunk is longer than the file"):
            read_image_header(data.replace(b"IEND", b"IDAT")[:-5])
    with pytest.raises(ValueError, match="no image"):
        read_image_header(data[:25] + b"\x05" + data[26:])


def test_sizes_of_extended_webp_files_have_24_bits():
    header = b"RIFF" + bytes(4) + b"WEBPVP8X" + bytes(8)
    data = header + (300_000 - 1).to_bytes(3, "little") + (70_000 - 1).to_bytes(3, "little")
    assert read_image_header(data)[:2] == (300_000, 70_000)
