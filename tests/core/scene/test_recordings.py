"""Folders of films or of folders of frames, whose frames are read at limited size."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.scene import recordings
from stages.core.scene.images import VideoWriter, reduce_frame, write_png
from stages.core.scene.recordings import common_frame_rate, limit_size, list_recordings, read_recording


def write_film(path, fps=25.0, frames=2):
    pytest.importorskip("av")
    with VideoWriter(path, fps) as video:
        for _ in range(frames):
            video.append(torch.full((24, 32, 3), 0.5))


def write_frames(folder, *shades):
    folder.mkdir()
    for i, shade in enumerate(shades):
        write_png(folder / f"{i}.png", torch.full((24, 32, 3), shade))
    return folder


def test_recordings_are_films_and_folders_of_frames_by_name(tmp_path):
    write_film(tmp_path / "b.mp4")
    write_frames(tmp_path / "a", 0.1)
    write_frames(tmp_path / ".hidden", 0.1)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("x")
    found = list_recordings(tmp_path)
    assert list(found) == ["a", "b.mp4"] and found["a"] == tmp_path / "a"
    (tmp_path / "b.mp4").unlink()
    with pytest.raises(InputError, match="contains 1 videos or folders of frames; two cameras or more"):
        list_recordings(tmp_path)
    with pytest.raises(InputError, match="is not a folder; give one with a video"):
        list_recordings(tmp_path / "notes.txt")


def test_films_of_other_rates_are_refused(tmp_path):
    for name, fps in (("a.mp4", 25.0), ("b.mp4", 25.0), ("c.mp4", 30.0)):
        write_film(tmp_path / name, fps)
    folder = write_frames(tmp_path / "d", 0.1)
    films = {name: tmp_path / name for name in ("a.mp4", "b.mp4")}
    assert common_frame_rate(films, 99.0) == pytest.approx(25)
    assert common_frame_rate({**films, "d": folder}, 25.01) == pytest.approx(25, abs=0.02)
    assert common_frame_rate({"d": folder, "e": folder}, 60.0) == 60.0
    with pytest.raises(InputError, match="d: has 25.1 frames per second, but a.mp4 has 25; all films"):
        common_frame_rate({**films, "d": folder}, 25.1)
    with pytest.raises(InputError, match="c.mp4: has 30 frames per second, but a.mp4 has 25"):
        common_frame_rate({**films, "c.mp4": tmp_path / "c.mp4"}, 25.0)


def test_frames_are_read_in_order_at_limited_size(tmp_path):
    frames = list(read_recording(write_frames(tmp_path / "a", 0.2, 0.6), 16))
    assert [full for _, full in frames] == [(32, 24)] * 2
    assert [tuple(image.shape) for image, _ in frames] == [(12, 16, 3)] * 2
    assert [int(image.float().mean()) for image, _ in frames] == [51, 153]
    write_film(tmp_path / "b.mp4", frames=3)
    frames = list(read_recording(tmp_path / "b.mp4", 16))
    assert [(tuple(image.shape), full) for image, full in frames] == [((12, 16, 3), (32, 24))] * 3


def test_frames_of_other_sizes_are_refused(tmp_path):
    folder = write_frames(tmp_path / "a", 0.2)
    write_png(folder / "1.png", torch.zeros(20, 32, 3))
    with pytest.raises(
        InputError, match="a: has frames of 32x24 and of 32x20 pixels; all frames of a camera must have the same size"
    ):
        list(read_recording(folder, 16))


@pytest.mark.parametrize(
    ("rate", "message"), [(0.0, "does not say how many"), (1e7, "has 1e.07"), (1e-4, "has 0.0001")]
)
def test_rates_that_no_camera_has_are_refused(tmp_path, monkeypatch, rate, message):
    monkeypatch.setattr(recordings, "video_info", lambda path: (2, rate))
    (tmp_path / "a.mp4").touch()
    with pytest.raises(InputError, match=f"a.mp4: {message} .*frames .*a second; encode it again"):
        common_frame_rate({"a.mp4": tmp_path / "a.mp4"}, 50.0)


def test_limited_images_are_means_of_areas():
    image = torch.arange(8 * 4 * 3, dtype=torch.uint8).reshape(8, 4, 3)
    half = limit_size(image, 4)
    expected = image.float().reshape(4, 2, 2, 2, 3).mean((1, 3))
    assert half.dtype == torch.uint8 and (half.float() - expected).abs().max() <= 0.5
    assert limit_size(image, 8) is image and limit_size(image, 9) is image
    assert limit_size(torch.zeros(1000, 3, 3, dtype=torch.uint8), 10).shape == (10, 1, 3)
    assert limit_size(torch.zeros(30, 41, 3, dtype=torch.uint8), 20).shape == (15, 20, 3)


class Frame(SimpleNamespace):
    """Stub of a PyAV frame with 40 x 20 pixels."""

    width, height = 40, 20

    def reformat(self, width, height, format, interpolation):
        assert (format, interpolation) == ("rgb24", "AREA")
        pixels = np.zeros((height, width, 3), np.uint8)
        pixels[0, -1] = 255  # the upper right pixel
        return SimpleNamespace(to_ndarray=lambda: pixels)


@pytest.mark.parametrize(("rotation", "side", "shape", "corner", "full"), [
    (0, 99, (20, 40), (0, -1), (40, 20)), (0, 20, (10, 20), (0, -1), (40, 20)), (90, 20, (20, 10), (0, 0), (20, 40)),
    (-90, 40, (40, 20), (-1, -1), (20, 40)), (180, 20, (10, 20), (-1, 0), (40, 20)), (0, 1, (2, 2), (0, -1), (40, 20)),
])  # fmt: skip
def test_frames_are_turned_as_they_are_shown(rotation, side, shape, corner, full):
    image, size = reduce_frame(Frame(rotation=rotation), side)
    assert image.shape == (*shape, 3) and size == full
    assert image[corner].tolist() == [255] * 3 and int(image.sum()) == 3 * 255
