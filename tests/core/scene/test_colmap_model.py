"""COLMAP models, written here as bytes and text in the layout documented by COLMAP."""

import struct
from contextlib import nullcontext

import numpy as np
import pytest

from stages.core.errors import InputError
from stages.core.scene import colmap_model
from stages.core.scene.cameras import read_cameras
from stages.core.scene.colmap_model import read_colmap

POSE = (0.5, 0.5, 0.5, 0.5, 1.0, 2.0, 3.0)  # maps x to y, y to z, z to x
CAMERAS = "# a comment\n1 PINHOLE 64 48 50 51 32 24\n\n7 SIMPLE_RADIAL 8 6 5 4 3 0.1\n"
IMAGES = "# two lines for each\n1 0.5 0.5 0.5 0.5 1 2 3 1 some folder/b b.jpg\n1 2 -1\n2 2 0 0 0 0 0 0 7 a.jpg\n\n"


def binary(cameras=((1, 1, 64, 48, (50.0, 51, 32, 24)),), images=((POSE, 1, b"a.jpg", 2),)) -> tuple[bytes, bytes]:
    first = struct.pack("<Q", len(cameras))
    for id, model, width, height, parameters in cameras:
        first += struct.pack(f"<IiQQ{len(parameters)}d", id, model, width, height, *parameters)
    second = struct.pack("<Q", len(images))
    for pose, camera, name, features in images:
        second += struct.pack("<I7dI", 9, *pose, camera) + name + b"\0" + struct.pack("<Q", features)
        second += struct.pack("<ddq", 1.5, 2.5, -1) * features
    return first, second


def write(folder, cameras, images, suffix):
    for name, data in (("cameras", cameras), ("images", images)):
        path = folder / f"{name}.{suffix}"
        path.write_bytes(data) if isinstance(data, bytes) else path.write_text(data)
    return folder


def test_text_is_read_with_its_comments_and_empty_lines(tmp_path):
    first, second = read_colmap(write(tmp_path, CAMERAS, IMAGES, "txt"))
    assert (first.name, second.name) == ("a.jpg", "b b.jpg")  # folders are removed; a name may have spaces
    assert first.size == (8, 6) and first.K.tolist() == [[5, 0, 4], [0, 5, 3], [0, 0, 1]]
    assert first.lens == (0.1, 0, 0, 0, 0, 0, 0, 0) and not any(second.lens)
    assert second.size == (64, 48) and second.K.tolist() == [[50, 0, 32], [0, 51, 24], [0, 0, 1]]
    np.testing.assert_allclose(first.viewmat, np.eye(4))  # a quaternion of length 2 is normalised
    np.testing.assert_allclose(second.viewmat, [[0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(("value", "right"), [(1e9, True), (-1e9, True), (1.001e9, False), (-1.001e9, False)])
def test_parameters_and_poses_are_bounded(tmp_path, value, right):
    far = (*POSE[:4], value, 2.0, 3.0)
    wide = binary(cameras=((1, 1, 64, 48, (50.0, 51.0, value, 24.0)),))[0], GOOD[1]
    for cameras, images in (wide, (GOOD[0], binary(images=((far, 1, b"a.jpg", 0),))[1])):
        write(tmp_path, cameras, images, "bin")
        with nullcontext() if right else pytest.raises(ValueError, match="not finite"):
            assert len(read_colmap(tmp_path)) == 1


def test_binary_is_read_before_text(tmp_path):
    images = ((POSE, 1, b"x/b.jpg", 2), ((1, 0, 0, 0, 0, 0, 0), 3, b"a.jpg", 0))
    cameras = ((1, 1, 64, 48, (50.0, 51, 32, 24)), (3, 4, 8, 6, (5.0, 6, 4, 3, 0.1, 0.2, 0.3, 0.4)))
    write(tmp_path, *binary(cameras, images), "bin")
    write(tmp_path, "nonsense", "nonsense", "txt")
    first, second = read_colmap(tmp_path)
    assert first.lens == (0.1, 0.2, 0.3, 0.4, 0, 0, 0, 0) and first.size == (8, 6)
    assert second.name == "b.jpg" and second.K.tolist() == [[50, 0, 32], [0, 51, 24], [0, 0, 1]]
    np.testing.assert_allclose(second.viewmat[:3, 3], [1, 2, 3])


GOOD = binary()
WRONG_BINARY = {
    "truncated": ((GOOD[0][:-1], GOOD[1]), "cameras.bin is truncated"),
    "more rows than bytes": ((struct.pack("<Q", 3) + GOOD[0][8:], GOOD[1]), "declares 3 rows, but has 64 bytes"),
    "no end of a name": ((GOOD[0], GOOD[1][: 8 + 64 + 5].ljust(80, b"x")), "has a name without an end"),
    "more features than bytes": (binary(images=((POSE, 1, b"a.jpg", 0),))[:1] + (GOOD[1][:-24],), "declares 2 rows"),
    "unknown model": (binary(((1, 99, 64, 48, ()),)), "camera model number 99 is not supported"),
    "negative model": (binary(((1, -1, 64, 48, (0.0,) * 4),)), "camera model number -1 is not supported"),
    "fisheye": (binary(((1, 5, 64, 48, (0.0,) * 8),)), "OPENCV_FISHEYE is not supported; undistort"),
    "another camera": (binary(images=((POSE, 2, b"a.jpg", 0),)), "a.jpg has camera 2, which is not among"),
    "focal length": (binary(((1, 1, 64, 48, (np.nan, 51, 32, 24)),)), "parameter that is not finite"),
    "far too large": (binary(((1, 1, 64, 48, (50, 51, 32, 2e9)),)), "parameter that is not finite, or far too large"),
    "position": (binary(images=(((1, 0, 0, 0, 0, 0, 2e9), 1, b"a.jpg", 0),)), "the pose of a.jpg is not finite"),
}


@pytest.mark.parametrize("what", WRONG_BINARY)
def test_damaged_binary_models_are_refused(tmp_path, what):
    files, message = WRONG_BINARY[what]
    with pytest.raises(ValueError, match=message):
        read_colmap(write(tmp_path, *files, "bin"))


@pytest.mark.parametrize(("cameras", "images", "message"), [
    ("1 PINHOLE 64 48 50 51 32\n", IMAGES, "cameras.txt has the line 1 PINHOLE"),
    ("1 PINHOLE 64 48 50 51 32 24 1\n", IMAGES, "cameras.txt has the line 1 PINHOLE"),
    (CAMERAS, "1 1 0 0 0 0 0 0 7\n\n", "images.txt has the line 1 1 0"),
    (CAMERAS, "1 1 0 0 0 0 0 x 7 a.jpg\n\n", "could not convert"),
    (CAMERAS, IMAGES.replace("1 2 -1\n", ""), "images.txt has the line 2 2 0 .* a.jpg in place of"),
])  # fmt: skip
def test_damaged_text_models_are_refused(tmp_path, cameras, images, message):
    with pytest.raises(ValueError, match=message):
        read_colmap(write(tmp_path, cameras, images, "txt"))


@pytest.mark.parametrize(("length", "right"), [(999, True), (1000, False)])
def test_names_are_bounded(tmp_path, length, right):
    files = binary(images=((POSE, 1, b"a" * length, 0),))
    with nullcontext() if right else pytest.raises(ValueError, match="name without an end"):
        assert len(read_colmap(write(tmp_path, *files, "bin"))[0].name) == 255


def test_text_files_are_bounded(tmp_path, monkeypatch):
    write(tmp_path, CAMERAS, IMAGES, "txt")
    monkeypatch.setattr(colmap_model, "MAX_TEXT", len(IMAGES))
    assert len(read_colmap(tmp_path)) == 2
    monkeypatch.setattr(colmap_model, "MAX_TEXT", len(IMAGES) - 1)
    with pytest.raises(ValueError, match="images.txt has more than 0 MB"):
        read_colmap(tmp_path)


def test_a_model_without_images_is_refused(tmp_path):
    with pytest.raises(InputError, match="it has no registered image"):
        read_cameras(write(tmp_path, *binary(images=()), "bin"))
