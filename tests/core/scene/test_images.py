import os
import re
import struct
import sys
import wave
import zlib
from contextlib import nullcontext

import cv2
import numpy as np
import pytest
import torch

from stages.core.errors import InputError, MissingPackage
from stages.core.scene import images
from stages.core.scene.images import (
    VideoWriter,
    image_data,
    list_photos,
    read_8_bit,
    read_image,
    read_labels,
    read_reduced_video,
    read_video,
    resize,
    sample_frames,
    to_jpeg,
    video_info,
    write_depth,
    write_jpeg,
    write_labels,
    write_png,
)


def test_png_round_trip_keeps_the_channel_order(tmp_path):
    image = torch.zeros(4, 6, 3)
    image[..., 0] = 1.0
    write_png(tmp_path / "a.png", image)
    assert torch.equal(read_image(tmp_path / "a.png"), image)
    assert cv2.imread(str(tmp_path / "a.png"))[0, 0].tolist() == [0, 0, 255]


@pytest.mark.parametrize("pixels", [np.full((3, 3), 128, np.uint8), np.full((3, 3, 4), 128, np.uint8),
                                    np.full((3, 3, 3), 32896, np.uint16)], ids=["grey", "alpha", "16 bit"])  # fmt: skip
def test_grey_alpha_and_16_bit_images_are_read_as_rgb(tmp_path, pixels):
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    torch.testing.assert_close(read_image(tmp_path / "a.png"), torch.full((3, 3, 3), 128 / 255))


def test_values_of_float_images_are_kept(tmp_path):
    pixels = np.random.default_rng(0).random((3, 4, 3), np.float32)
    cv2.imwrite(str(tmp_path / "a.tiff"), pixels[..., ::-1])
    assert torch.equal(read_image(tmp_path / "a.tiff"), torch.from_numpy(pixels))


@pytest.mark.parametrize("largest", [256, 300, 65535])
def test_label_round_trip_with_16_bits(tmp_path, largest):
    labels = torch.tensor([[0, 1], [largest, 2]])
    write_labels(tmp_path / "l.png", labels)
    assert torch.equal(read_labels(tmp_path / "l.png"), labels)


def test_list_photos_skips_other_and_hidden_files(tmp_path):
    for name in ("b.JPG", "a.png", "notes.txt", ".hidden.png"):
        (tmp_path / name).touch()
    assert [p.name for p in list_photos(tmp_path)] == ["a.png", "b.JPG"]


def test_photos_are_sorted_by_the_numbers_in_their_names(tmp_path):
    numbers = ["01.png", "1.png", "2.png", "\u0663.png", "10.png"]  # also an Arabic 3
    names = [*numbers, "IMG.jpg", "IMG_2_b9.jpg", "IMG_2_b10.jpg", "IMG_11_a1.jpg"]
    for name in reversed(names):
        (tmp_path / name).touch()
    assert [p.name for p in list_photos(tmp_path)] == names


def test_video_is_h264_with_leading_index(tmp_path):
    path = tmp_path / "v.mp4"
    shades = [0.2, 0.5, 0.8]
    with VideoWriter(path, fps=50.0) as video:
        for shade in shades:
            video.append(torch.full((33, 48, 3), shade))  # the last row of an odd height is removed
    with pytest.importorskip("av").open(str(path)) as file:
        stream = file.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 50)
    data = path.read_bytes()
    assert data.find(b"moov") < data.find(b"mdat")  # the index comes first, so that playback can start early
    frames = list(read_video(path))
    assert [f.shape for f in frames] == [(32, 48, 3)] * 3
    torch.testing.assert_close(torch.tensor([float(f.mean()) for f in frames]), torch.tensor(shades), atol=0.02, rtol=0)


def test_frames_of_films_that_phones_turned_are_upright(tmp_path):
    path = tmp_path / "v.mp4"
    image = torch.zeros(32, 64, 3)
    image[:, :16] = 1.0  # the left part is white
    with VideoWriter(path, fps=50.0) as video:
        video.append(image)
    data, one = path.read_bytes(), 1 << 16
    at = data.find(struct.pack(">4i", one, 0, 0, 0), data.find(b"tkhd"))  # the matrix of the track has 9 numbers
    # rotation by 90 degrees clockwise
    path.write_bytes(data[:at] + struct.pack(">5i", 0, one, 0, -one, 0) + data[at + 20 :])
    frame = next(read_video(path))
    assert frame.shape == (64, 32, 3) and float(frame[:12].mean()) > 0.9 and float(frame[20:].mean()) < 0.1


@pytest.mark.parametrize("reader", [read_image, read_labels, lambda path: next(read_video(path))])
def test_file_that_is_no_image_is_refused(tmp_path, reader):
    path = tmp_path / "x.png"
    path.write_bytes(b"nonsense" * 50)
    with pytest.raises(InputError, match="can be read|is damaged"):
        reader(path)


@pytest.mark.parametrize("reader", [read_image, read_labels])
def test_image_with_too_many_pixels_is_refused(tmp_path, reader):
    path = tmp_path / "x.png"
    write_png(path, torch.zeros(4, 4, 3))
    data = path.read_bytes()
    header = struct.pack(">4sIIBBBBB", b"IHDR", 1 << 16, 1 << 16, 8, 2, 0, 0, 0)
    path.write_bytes(data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:])
    with pytest.raises(InputError, match="x.png: is damaged, or far too large"):
        reader(path)


@pytest.mark.skipif(sys.platform != "linux", reason="open files are listed in /proc")
def test_refused_videos_are_closed(tmp_path, monkeypatch):
    """Sound without video, and frames of too many pixels. The stored errors must not keep files open."""
    pytest.importorskip("av")
    with wave.open(str(tmp_path / "sound.wav"), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", None))
        sound.writeframes(bytes(1600))
    with VideoWriter(tmp_path / "film.mp4", fps=10.0) as video:
        video.append(torch.zeros(32, 64, 3))
    monkeypatch.setattr(images, "MAX_VIDEO_PIXELS", 32 * 64 - 1)
    before, errors = os.listdir("/proc/self/fd"), []
    for name in ("sound.wav", "film.mp4"):
        with pytest.raises(InputError) as error:
            next(read_video(tmp_path / name))
        errors.append(error)
    assert "sound.wav: contains no video stream" in str(errors[0].value)
    assert "film.mp4: has frames of 64x32 pixels, but at most" in str(errors[1].value)
    assert os.listdir("/proc/self/fd") == before
    monkeypatch.setattr(images, "MAX_VIDEO_PIXELS", 32 * 64)
    assert next(read_video(tmp_path / "film.mp4")).shape == (32, 64, 3)


def test_absent_av_is_reported_for_videos(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "a.mp4").write_bytes(b"video")
    with pytest.raises(MissingPackage, match="b.mp4: videos need the package av.*`pip install av`"):
        VideoWriter(tmp_path / "b.mp4", 25.0).__enter__()
    with pytest.raises(MissingPackage, match="a.mp4: videos need"):
        next(read_video(tmp_path / "a.mp4"))
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize("pixels", [np.full((3, 4, 3), 128, np.uint8), np.full((3, 4, 3), 32896, np.uint16)])
def test_8_bit_photos_are_those_of_read_image(tmp_path, pixels):
    pixels[..., 0] = 7
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    assert torch.equal(read_8_bit(tmp_path / "a.png"), (read_image(tmp_path / "a.png") * 255).round().byte())


def test_depth_is_stored_in_thousandths(tmp_path):
    write_depth(tmp_path / "d.png", torch.tensor([[0.0, 1.2344, 1.2346], [65.6, -1.0, 0.0004]]))
    pixels = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert pixels.dtype == np.uint16 and pixels.tolist() == [[0, 1234, 1235], [65535, 0, 0]]
    write_depth(tmp_path / "d.png", torch.tensor([[3.0]]), unit=0.5)
    assert cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED).tolist() == [[6]]


def test_images_are_shrunk_by_areas_and_enlarged_bilinearly():
    image = torch.arange(16.0).reshape(4, 4, 1)
    torch.testing.assert_close(resize(image, 2, 2)[..., 0], torch.tensor([[2.5, 4.5], [10.5, 12.5]]))
    wide = resize(torch.tensor([[[0.0, 1], [4, 5]]]), 4, 1)
    torch.testing.assert_close(wide, torch.tensor([[[0.0, 1], [1, 2], [3, 4], [4, 5]]]))


def test_jpegs_have_the_channels_and_the_quality_asked_for(tmp_path):
    image = torch.zeros(16, 16, 3)
    image[..., 0], image[..., 2] = 1.5, 0.25  # values above 1 are clamped
    write_jpeg(tmp_path / "a.jpg", image)
    expected = torch.tensor([1.0, 0.0, 0.25]).expand(16, 16, 3)
    torch.testing.assert_close(read_image(tmp_path / "a.jpg"), expected, atol=0.02, rtol=0)
    noise = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0))
    assert (tmp_path / "a.jpg").read_bytes() == to_jpeg(image) and len(to_jpeg(noise, 20)) < len(to_jpeg(noise)) / 2


def test_label_images_have_one_channel_and_a_bounded_depth(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((3, 3, 3), np.uint8))
    with pytest.raises(InputError, match="a.png: has 3 channels; a label image has one"):
        read_labels(tmp_path / "a.png")
    write_labels(tmp_path / "b.png", torch.tensor([[255, 0]]))
    assert read_labels(tmp_path / "b.png", max_bits=8).tolist() == [[255, 0]]
    write_labels(tmp_path / "b.png", torch.tensor([[256, 0]]))
    assert read_labels(tmp_path / "b.png").tolist() == [[256, 0]]
    with pytest.raises(InputError, match="b.png: has 16 bits per pixel; save the label image with 8"):
        read_labels(tmp_path / "b.png", max_bits=8)


def png(depth: int, row: bytes, width: int, palette: bytes | None = None) -> bytes:
    """A PNG with one row of packed pixels, grey, or with a palette whose first colour is transparent."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, 1, depth, 0 if palette is None else 3, 0, 0, 0))]
    parts += [] if palette is None else [(b"PLTE", palette), (b"tRNS", b"\0")]
    parts += [(b"IDAT", zlib.compress(b"\0" + row)), (b"IEND", b"")]
    chunks = [struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
              for kind, data in parts]  # fmt: skip
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


@pytest.mark.parametrize(("depth", "row", "expected"), [
    (1, b"\x50", [0, 1, 0, 1]), (2, b"\x1b", [0, 1, 2, 3]), (4, b"\x01\x2f", [0, 1, 2, 15]),
    (8, b"\x00\x01\x02\x03", [0, 1, 2, 3]),
])  # fmt: skip
def test_label_images_of_few_bits_or_with_a_palette_hold_their_numbers(tmp_path, depth, row, expected):
    """Decoders would scale numbers of few bits to 0 to 255, and return the colours of a palette."""
    (tmp_path / "grey.png").write_bytes(png(depth, row, 4))
    assert read_labels(tmp_path / "grey.png").tolist() == [expected]
    (tmp_path / "palette.png").write_bytes(png(depth, row, 4, bytes([0, 0, 0, 200, 0, 0, 0, 200, 0] * 7)[: 3 << depth]))
    assert read_labels(tmp_path / "palette.png").tolist() == [expected]


def test_label_images_whose_palette_is_of_other_greys_are_ambiguous(tmp_path):
    (tmp_path / "a.png").write_bytes(png(8, b"\0\1", 2, bytes([0, 0, 0, 7, 7, 7])))
    with pytest.raises(InputError, match="a.png: has [34] channels"):
        read_labels(tmp_path / "a.png")


def test_label_images_are_not_compressed_with_losses(tmp_path):
    labels = np.kron(np.array([[0, 1], [2, 3]], np.uint8), np.ones((20, 20), np.uint8))
    cv2.imwrite(str(tmp_path / "a.jpg"), labels)
    (tmp_path / "a.jpg").rename(tmp_path / "a.png")  # the file name has no effect
    with pytest.raises(InputError, match="a.png: is a JPEG, .* as PNG"):
        read_labels(tmp_path / "a.png")


@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.int32, np.float64])
def test_images_of_other_types_are_refused_in_one_line(tmp_path, dtype, capfd):
    cv2.imwrite(str(tmp_path / "a.tif"), np.full((8, 9), -3, dtype))
    for read in (read_image, read_labels):
        with pytest.raises(InputError, match="a.tif: .* (as|or) PNG$"):
            read(tmp_path / "a.tif")
    cv2.imwrite(str(tmp_path / "b.tif"), np.full((8, 9), 0.5, np.float32))
    with pytest.raises(InputError, match="b.tif: has values of type float32"):
        read_labels(tmp_path / "b.tif")
    assert capfd.readouterr().err == ""  # OpenCV would log there


def test_folders_without_photos_and_long_files_are_refused(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="contains no photos; supported formats: .*.png"):
        list_photos(tmp_path)
    write_png(tmp_path / "a.png", torch.zeros(4, 4, 3))
    with pytest.raises(InputError, match="a.png: is not a folder"):
        list_photos(tmp_path / "a.png")
    size = (tmp_path / "a.png").stat().st_size
    monkeypatch.setattr(images, "MAX_IMAGE_BYTES", size)
    assert len(image_data(tmp_path / "a.png")) == size
    monkeypatch.setattr(images, "MAX_IMAGE_BYTES", size - 1)
    with pytest.raises(InputError, match="a.png: has more than 0 MB"):
        image_data(tmp_path / "a.png")


def test_frames_are_sampled_evenly_with_both_ends(tmp_path):
    pytest.importorskip("av")
    with VideoWriter(tmp_path / "v.mp4", fps=10.0) as video:
        for n in range(9):
            video.append(torch.full((32, 64, 3), n / 8))
    assert video_info(tmp_path / "v.mp4") == (9, 10.0)
    for count, expected in ((3, [0, 4, 8]), (1, [0]), (20, list(range(9)))):
        jpegs = sample_frames(tmp_path / "v.mp4", count, 32)
        pixels = [cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) for jpeg in jpegs]
        assert [p.shape for p in pixels] == [(16, 32, 3)] * len(expected)
        assert [round(p.mean() / 255 * 8) for p in pixels] == expected


def test_a_film_of_another_number_of_frames_than_it_states(tmp_path, monkeypatch):
    """The container states 0, 5 or 30 frames; three of the actual 9 are sampled. Without any frame it is refused."""
    pytest.importorskip("av")
    with VideoWriter(tmp_path / "v.mp4", fps=10.0) as video:
        for n in range(9):
            video.append(torch.full((16, 16, 3), n / 8))
    for stated in (0, 5, 30):
        monkeypatch.setattr(images, "video_info", lambda path, stated=stated: (stated, 10.0))
        assert len(sample_frames(tmp_path / "v.mp4", 3, 16)) == 3
    monkeypatch.setattr(images, "read_video", lambda path: iter(()))
    with pytest.raises(InputError, match="v.mp4: contains no frames"):
        sample_frames(tmp_path / "v.mp4", 3, 16)


def test_a_film_that_breaks_off_is_refused_or_used_up_to_there(tmp_path, caplog):
    pytest.importorskip("av")
    with VideoWriter(tmp_path / "v.mp4", fps=10.0) as video:
        for n in range(9):
            video.append(torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(n)))
    data = (tmp_path / "v.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) * 2 // 3])
    (tmp_path / "zeros.mp4").write_bytes(data[: len(data) // 2] + bytes(len(data) // 4) + data[-len(data) // 4 :])
    assert len(list(read_reduced_video(tmp_path / "v.mp4", 32))) == 9 and not caplog.text
    for name, message in (
        ("cut.mp4", r"; \d of its 9 frames are used"),
        ("zeros.mp4", ".*; the frames before the damage are used"),
    ):
        assert 0 < len(list(read_reduced_video(tmp_path / name, 32))) < 9
        assert re.search(f"{name}: is truncated or damaged{message}", caplog.text)
        with pytest.raises(InputError, match=f"{name}: the video is truncated or damaged"):
            list(read_video(tmp_path / name))


@pytest.mark.parametrize(("value", "right"), [(1.5, True), (255.0, False), (float("nan"), False)])
def test_float_images_are_white_at_one(tmp_path, value, right):
    cv2.imwrite(str(tmp_path / "a.tiff"), np.full((3, 4, 3), value, np.float32))
    with nullcontext() if right else pytest.raises(InputError, match="a.tiff: has values .* not from 0 to 1; convert"):
        assert float(read_image(tmp_path / "a.tiff").max()) == value


def test_damaged_pixels_are_refused(tmp_path, monkeypatch):
    write_png(tmp_path / "b.png", torch.zeros(4, 4, 3))

    def failing(*_):
        raise cv2.error("damaged")

    monkeypatch.setattr(images.cv2, "imdecode", failing)
    with pytest.raises(InputError, match="b.png: is damaged; convert it to JPEG or PNG"):
        read_image(tmp_path / "b.png")
    monkeypatch.setattr(images.cv2, "imencode", lambda *_: (False, None))
    with pytest.raises(InputError, match="c.png: the image could not be encoded as PNG"):
        write_png(tmp_path / "c.png", torch.zeros(4, 4, 3))
    assert not (tmp_path / "c.png").exists()
