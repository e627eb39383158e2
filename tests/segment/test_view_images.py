"""Image files of the photos of a scene."""

import logging

import pytest

from stages.core.errors import InputError
from stages.segment.view_images import match_files


def test_files_are_matched_by_name_without_suffix(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    for name in ("b.png", "a.JPG", "c.txt", "d.png"):
        (tmp_path / name).touch()
    assert match_files(tmp_path, ("a.jpg", "b.jpeg"), "mask", "--masks") == {
        0: tmp_path / "a.JPG", 1: tmp_path / "b.png"}  # fmt: skip
    assert not caplog.text
    assert match_files(tmp_path, ("c.jpg", "b.jpg", "x.jpg"), "mask", "--masks") == {1: tmp_path / "b.png"}
    assert "masks for 1 of 3 photos" in caplog.text
    (tmp_path / "e.jpg.png").touch()  # as COLMAP and other tools name masks
    assert match_files(tmp_path, ("e.jpg",), "mask", "--masks") == {0: tmp_path / "e.jpg.png"}


def test_a_folder_without_a_matching_file_is_an_error(tmp_path):
    with pytest.raises(InputError, match="is not a folder; --masks takes a folder of masks named like the photos"):
        match_files(tmp_path / "none", ("a.jpg",), "mask", "--masks")
    with pytest.raises(InputError, match="contains no mask named like a photo of the scene, such as a.png"):
        match_files(tmp_path, ("a.jpg",), "mask", "--masks")
    with pytest.raises(InputError, match="the scene does not state the names of its photos"):
        match_files(tmp_path, (), "mask", "--masks")
