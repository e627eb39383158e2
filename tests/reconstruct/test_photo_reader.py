"""Typical folders of users' photos, and videos of phones."""

import logging
import os
import shutil
import struct
import zlib
from fractions import Fraction

import cv2
import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.reconstruct import photo_reader
from stages.reconstruct.photo_reader import read_photos

Image = pytest.importorskip("PIL.Image")
MILLISECOND = Fraction(1, 1000)
rng = np.random.default_rng(0)


def random_image(width: int = 96, height: int = 64) -> np.ndarray:
    """A random 8-bit RGB image whose left half is reddish and right half bluish."""
    small = rng.integers(0, 120, (height // 8, width // 8, 3), dtype=np.uint8)
    pixels = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    pixels[:, : width // 2, 0] |= 128
    pixels[:, width // 2 :, 2] |= 128
    return pixels


@pytest.fixture
def folder(tmp_path):
    """A folder with two valid photos."""
    for name in ("a.jpg", "b.jpg"):
        Image.fromarray(random_image()).save(tmp_path / name, quality=95)
    return tmp_path


def mean_of_left(image: torch.Tensor) -> torch.Tensor:
    return image[:, : image.shape[1] // 2].float().mean((0, 1))


KINDS = {
    "sixteen bit": lambda path, pixels: cv2.imwrite(str(path / "c.png"), pixels[..., ::-1].astype(np.uint16) * 257),
    "alpha": lambda path, pixels: Image.fromarray(np.dstack([pixels, pixels[..., 0] // 2])).save(path / "c.png"),
    "CMYK": lambda path, pixels: Image.fromarray(pixels).convert("CMYK").save(path / "c.jpg", quality=95),
    "TIFF": lambda path, pixels: Image.fromarray(pixels).save(path / "c.tiff"),
    "WebP": lambda path, pixels: Image.fromarray(pixels).save(path / "c.webp", quality=95),
    "upper case": lambda path, pixels: Image.fromarray(pixels).save(path / "c.JPG", quality=95),
    "unicode and spaces": lambda path, pixels: Image.fromarray(pixels).save(path / "c Küche 写真 №1.jpg", quality=95),
}


@pytest.mark.parametrize("kind", list(KINDS))
def test_colours_of_all_file_formats(folder, kind):
    pixels = random_image()
    KINDS[kind](folder, pixels)
    photos = read_photos(folder)
    assert len(photos) == 3
    true = torch.from_numpy(pixels)
    torch.testing.assert_close(mean_of_left(photos.images[2]), mean_of_left(true), rtol=0, atol=4.0)


def test_grey_photos_become_three_equal_channels(folder):
    Image.fromarray(random_image()[..., 1]).save(folder / "c.png")
    image = read_photos(folder).images[2]
    assert image.shape[2] == 3 and torch.equal(image[..., 0], image[..., 2])


def test_exif_rotation_is_applied(folder):
    pixels = random_image()
    exif = Image.Exif()
    exif[0x0112] = 6  # means that the image must be rotated by 90 degrees clockwise
    Image.fromarray(np.ascontiguousarray(np.rot90(pixels))).save(folder / "c.jpg", exif=exif, quality=95)
    photos = read_photos(folder)
    assert photos.size(2) == (96, 64)
    torch.testing.assert_close(mean_of_left(photos.images[2]), mean_of_left(torch.from_numpy(pixels)), rtol=0, atol=4.0)


def test_mixed_sizes_and_focal_lengths_give_separate_cameras(folder):
    pytest.importorskip("pycolmap")  # used to read EXIF
    from stages.reconstruct.matching import initial_cameras

    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 50  # 35 mm equivalent focal length
    for name, size in (("c.jpg", (64, 96)), ("d.jpg", (128, 96)), ("e.jpg", (96, 64))):
        Image.fromarray(random_image(*size)).save(folder / name, exif=exif)
    photos = read_photos(folder)
    cameras = initial_cameras(photos)
    assert cameras[0].camera_id == cameras[1].camera_id
    assert len({c.camera_id for c in cameras}) == 4  # e.jpg has the same size as a.jpg, but a known focal length
    assert cameras[4].has_prior_focal_length and not cameras[0].has_prior_focal_length
    assert cameras[4].mean_focal_length() == pytest.approx(50 / 36 * 96, rel=0.05)


def test_large_photos_and_their_focal_lengths_are_reduced(tmp_path):
    pytest.importorskip("pycolmap")  # used to read EXIF
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 36  # the focal length equals the image width
    for name in ("a.jpg", "b.jpg"):
        Image.fromarray(random_image(2400, 1600)).save(tmp_path / name, exif=exif)
    photos = read_photos(tmp_path)
    assert photos.size(0) == (1600, 1067)
    assert photos.focals[0] == pytest.approx(1600, rel=0.05)
    assert read_photos(tmp_path, side=1800).size(0) == (1800, 1200)


def test_unreadable_photos_are_named_and_left_out(folder, caplog):
    whole = (folder / "a.jpg").read_bytes()
    (folder / "c.jpg").write_bytes(whole[: len(whole) // 2])
    (folder / "d.jpg").write_bytes(b"")
    (folder / "e.jpg").write_bytes(b"no photo")
    Image.fromarray(random_image()).save(folder / "f.png")
    (folder / "f.png").write_bytes((folder / "f.png").read_bytes()[:-300])
    photos = read_photos(folder)
    assert photos.names == ("a.jpg", "b.jpg")
    for message in ("c.jpg: is truncated", "d.jpg: is empty", "e.jpg: is not an image", "f.png: is truncated"):
        assert message in caplog.text
    (folder / "b.jpg").unlink()
    with pytest.raises(InputError, match="contains one readable photo"):
        read_photos(folder)
    (folder / "a.jpg").unlink()
    with pytest.raises(InputError, match="c.jpg: is truncated"):
        read_photos(folder)


def test_other_files_with_photo_suffixes_are_left_out(folder, caplog):
    (folder / "folder.jpg").mkdir()
    (folder / "link.jpg").symlink_to(folder / "gone.jpg")
    (folder / "phone.jpg").write_bytes(b"\0\0\0\x18ftypheic" + bytes(500))  # HEIC with the suffix of JPEG
    (folder / "huge.png").write_bytes(png_with_declared_size(60_000, 60_000))
    shutil.copy(folder / "a.jpg", folder / os.fsdecode(b"caf\xe9.jpg"))  # Latin-1
    photos = read_photos(folder)
    assert photos.names == ("a.jpg", "b.jpg")
    for message in ("folder.jpg: is a folder", "link.jpg: no such file", "phone.jpg: is not an", "huge.png: is d",
                    "has a name that is not UTF-8; rename it"):  # fmt: skip
        assert message in caplog.text


def png_with_declared_size(width: int, height: int) -> bytes:
    """A PNG header without the pixels that it declares."""
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)), (b"IDAT", zlib.compress(b"0"))]
    out = b"\x89PNG\r\n\x1a\n"
    for kind, data in (*chunks, (b"IEND", b"")):
        out += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return out


def test_error_suggests_a_subfolder_or_video(tmp_path):
    (tmp_path / "day 1" / "images").mkdir(parents=True)
    Image.fromarray(random_image()).save(tmp_path / "day 1" / "images" / "a.png")
    with pytest.raises(InputError, match="day 1: contains no photos itself; give .*images"):
        read_photos(tmp_path / "day 1")
    (tmp_path / "films").mkdir()
    (tmp_path / "films" / "IMG 7.MOV").write_bytes(b"film")
    with pytest.raises(InputError, match="films: contains no photos itself; give .*IMG 7.MOV"):
        read_photos(tmp_path / "films")
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="none: contains no photos; supported formats"):
        read_photos(tmp_path / "none")


def test_appended_video_and_thumbnail_do_not_hide_truncation(folder):
    thumbnail, whole = (folder / "a.jpg").read_bytes(), (folder / "b.jpg").read_bytes()
    header = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    (folder / "c.jpg").write_bytes(whole[:2] + header + whole[2:] + b"ftypmp42 a film" * 1000)
    assert len(read_photos(folder)) == 3
    cut = (whole[:2] + header + whole[2:])[: -len(whole) // 2]  # only the end marker of the thumbnail remains
    (folder / "c.jpg").write_bytes(cut)
    assert len(read_photos(folder)) == 2


def test_formats_that_need_converting_are_named(tmp_path, caplog):
    (tmp_path / "IMG_1.HEIC").write_bytes(b"heic")
    (tmp_path / "IMG_2.HEIC").write_bytes(b"heic")
    with pytest.raises(InputError, match="contains 2 HEIC photos, which cannot be read; convert them to JPEG"):
        read_photos(tmp_path)
    for name in ("a.png", "b.png"):
        Image.fromarray(random_image()).save(tmp_path / name)
    assert len(read_photos(tmp_path)) == 2
    assert "2 HEIC photos are left out" in caplog.text


def test_sharpest_photo_of_each_span(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(photo_reader, "MAX_PHOTOS", 4)
    for i in range(12):
        pixels = random_image() if i % 3 == 1 else np.full((64, 96, 3), 90, np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{i:02d}.png")
    with caplog.at_level(logging.INFO):
        photos = read_photos(tmp_path)
    assert photos.names == ("01.png", "04.png", "07.png", "10.png")
    assert "of 12 photos the sharpest 4" in caplog.text


def test_number_and_size_of_many_photos_are_limited(tmp_path, monkeypatch):
    monkeypatch.setattr(photo_reader, "MAX_SIDES", (160, 64))
    pixels = random_image(96, 64)
    for i in range(500):
        cv2.imwrite(str(tmp_path / f"{i:03d}.jpg"), pixels)
    photos = read_photos(tmp_path)
    assert len(photos) == photo_reader.MAX_PHOTOS == 200
    assert all(max(photos.size(i)) == 64 for i in range(200))
    assert set(photos.file_sizes) == {(96, 64)} and photos[[3, 5]].file_size(1) == (96, 64)
    assert int(photos.names[0][:3]) < 3 and int(photos.names[-1][:3]) > 496  # photos are from the whole range


def write_video(path, times: list[float], size: tuple[int, int] = (96, 64), blurred: tuple[int, ...] = ()) -> None:
    """Write a video with frames at these times [s]; the red channel is the time in tenths of a second."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=1000, options={"crf": "10", "g": "10"})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.codec_context.time_base = MILLISECOND
        texture = random_image(*size)
        for i, time in enumerate(times):
            pixels = cv2.GaussianBlur(texture, (0, 0), 4) if i in blurred else texture.copy()
            pixels[..., 0] = round(time * 10)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = round(time * 1000), MILLISECOND
            file.mux(stream.encode(frame))
        file.mux(stream.encode())


def test_variable_frame_rate_is_sampled_by_time(tmp_path, monkeypatch):
    # 10 frames/s for 4 s, then 1 frame/s for 16 s: sampled by number, two thirds would be from the first fifth
    monkeypatch.setattr(photo_reader, "VIDEO_FRAMES", (10, 10))
    write_video(tmp_path / "v.mp4", [0.1 * i for i in range(40)] + [4.0 + i for i in range(17)])
    photos = read_photos(tmp_path / "v.mp4")
    times = torch.tensor([float(image[..., 0].float().mean()) / 10 for image in photos.images])
    assert len(photos) == 10
    assert (times < 4).sum() <= 3 and float((times[1:] - times[:-1]).max()) < 4.5


def test_blurred_frames_are_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr(photo_reader, "VIDEO_FRAMES", (5, 5))
    write_video(tmp_path / "v.mp4", [0.1 * i for i in range(25)], blurred=tuple(i for i in range(25) if i % 5 != 2))
    names = read_photos(tmp_path / "v.mp4").names
    assert [int(name[6:]) % 5 for name in names] == [2] * 5


@pytest.mark.parametrize(("matrix", "quarter_turns"), [((0, 1, -1, 0), -1), ((0, -1, 1, 0), 1), ((-1, 0, 0, -1), 2)])
def test_video_rotation_is_applied(tmp_path, matrix, quarter_turns):
    write_video(tmp_path / "v.mp4", [0.1 * i for i in range(3)])
    stored = read_photos(tmp_path / "v.mp4").images
    data = (tmp_path / "v.mp4").read_bytes()
    a, b, c, d = (65536 * k for k in matrix)  # fixed-point numbers (16.16) of a matrix for row vectors
    identity = struct.pack(">9i", 65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30)
    at = data.index(identity, data.index(b"tkhd"))  # position in the track header, ISO/IEC 14496-12
    (tmp_path / "v.mp4").write_bytes(data[:at] + struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30) + data[at + 36 :])
    photos = read_photos(tmp_path / "v.mp4")
    for image, before in zip(photos.images, stored, strict=True):
        assert torch.equal(image, torch.rot90(before, quarter_turns))


def test_large_video_frames_are_reduced(tmp_path):
    write_video(tmp_path / "v.mp4", [0.1 * i for i in range(3)], size=(1920, 1080))
    photos = read_photos(tmp_path / "v.mp4")
    assert len(photos) == 3 and photos.size(0) == (1600, 900)


def test_truncated_video_is_refused(tmp_path):
    write_video(tmp_path / "v.mp4", [0.1 * i for i in range(10)])
    whole = (tmp_path / "v.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])  # the index is at the end
    with pytest.raises(InputError, match="cut.mp4: is not a video that can be read"):
        read_photos(tmp_path / "cut.mp4")


def test_video_with_one_frame_is_refused(tmp_path):
    write_video(tmp_path / "v.mp4", [0.0])
    with pytest.raises(InputError, match="has 1 frame; give a video whose camera moves around"):
        read_photos(tmp_path / "v.mp4")


def test_other_files_in_the_folder_are_counted(folder, caplog):
    (folder / "notes.txt").write_text("not a photo")
    (folder / ".DS_Store").write_text("hidden")
    with caplog.at_level(logging.INFO):
        photos = read_photos(folder)
    assert photos.names == ("a.jpg", "b.jpg") and photos.size(0) == (96, 64)
    assert "1 other file" in caplog.text


def test_one_photo_is_refused(tmp_path):
    Image.fromarray(random_image()).save(tmp_path / "a.png")
    with pytest.raises(InputError, match="contains one photo; at least 2"):
        read_photos(tmp_path)
