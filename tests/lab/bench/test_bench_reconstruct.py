"""Metrics of the reconstruction benchmark, for cameras with known errors."""

import json
import math

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres, orbit
from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.scene.cameras import Cameras
from stages.lab.bench import reconstruct as bench
from tests.conftest import ring
from tests.reconstruct.raycast import arc, write_set


def elsewhere(cameras: Cameras, seed: int = 0) -> Cameras:
    """The same cameras in a world that is rotated, translated and scaled."""
    generator = torch.Generator().manual_seed(seed)
    R = matrix(torch.randn(4, generator=generator))
    return cameras.transformed(Similarity(0.3, R, torch.randn(3, generator=generator)))


def tilted(degrees: float) -> torch.Tensor:
    """A rotation about the x axis."""
    half = math.radians(degrees) / 2
    return matrix(torch.tensor([math.cos(half), math.sin(half), 0.0, 0.0]))


def test_a_similarity_is_no_pose_error():
    error = bench.pose_error(elsewhere(ring(8)), ring(8))
    assert error.cameras == 8
    assert error.rotation_most < 0.05 and error.shift < 1e-3  # the tolerance is for arc cosines of float32 matrices


def test_rotation_and_position_errors_are_measured():
    true = ring(8)
    viewmats = true.viewmats.clone()
    viewmats[2, :3] = tilted(1.0) @ viewmats[2, :3]  # 7 of the 28 pairs are affected
    error = bench.pose_error(Cameras(viewmats, true.Ks, true.sizes, true.names), true)
    assert error.rotation < 0.05 and error.rotation_most == pytest.approx(1.0, abs=0.02)
    viewmats = true.viewmats.clone()
    viewmats[0, :3, 3] += torch.tensor([0.0, 0.0, 0.04])  # 0.04 along its axis; the diameter of the ring is 3.6
    shift = bench.pose_error(Cameras(viewmats, true.Ks, true.sizes, true.names), true).shift
    extent = float(torch.pdist(centres(true.viewmats)).max())
    assert 0.5 < shift / (100 * 0.04 / 8**0.5 / extent) <= 1.0  # the alignment compensates for a part of the error


def test_photos_are_matched_by_name():
    true = ring(6)
    error = bench.pose_error(elsewhere(true)[[4, 1, 0, 3]], true)
    assert error.cameras == 4 and error.rotation_most < 0.05
    with pytest.raises(InputError, match="include 2 of the photos"):
        bench.pose_error(true[[0, 1]], true)


@pytest.mark.parametrize("degrees", [0.0, 1.5])
def test_tilt_is_measured(degrees):
    true = ring(8)
    found = true.transformed(Similarity(2.0, tilted(degrees), torch.zeros(3)))
    tilt, height = bench.upright_error(found, true, 0.0, 0.0)
    assert tilt == pytest.approx(degrees, abs=0.05)
    assert height < 0.1


def test_floor_error_is_relative_to_the_scene_size():
    true = ring(8)
    found = true.transformed(Similarity(2.0, torch.eye(3), torch.tensor([0.3, 0.1, 0.0])))
    _, height = bench.upright_error(found, true, floor=-0.1, true_floor=0.0)
    size = 4 * math.cos(math.radians(25))  # twice the cameras' distance from their centre
    assert height == pytest.approx(100 * 0.05 / size, rel=1e-3)


def test_photo_folder_is_found(tmp_path):
    assert bench.photo_folder(tmp_path) == tmp_path
    (tmp_path / "images").mkdir()
    assert bench.photo_folder(tmp_path) == tmp_path / "images"
    with pytest.raises(InputError, match="no such folder"):
        bench.photo_folder(tmp_path / "absent")
    with pytest.raises(InputError, match="name one or more"):
        list(bench.run([], tmp_path / "r.json", bench.ReconstructBenchOptions()))


@pytest.mark.parametrize("content", ["", "{", "[]", '{"sets": []}', "\xff", '{"rows": {}}'])
def test_a_file_of_something_else_is_not_replaced(tmp_path, content):
    (tmp_path / "images").mkdir()
    (tmp_path / "r.json").write_text(content, encoding="latin-1")
    with pytest.raises(InputError, match="r.json: contains no results of this benchmark .*; name another file"):
        list(bench.run([tmp_path], tmp_path / "r.json", bench.ReconstructBenchOptions()))
    assert (tmp_path / "r.json").read_text(encoding="latin-1") == content


def test_rows_of_other_sets_are_kept(tmp_path, monkeypatch, device):
    report = dict(
        photos=5, placed=5, held_out={"photos": 1, "psnr": 20.0, "ssim": 0.7}, seconds={"model": 2.0}, memory=1.0,
        cpu_seconds=3.0, device=device,
    )  # fmt: skip
    monkeypatch.setattr(bench, "measure_in_subprocess", lambda *_: report)
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        lines = list(bench.run([tmp_path / name], tmp_path / "r.json", bench.ReconstructBenchOptions()))
    assert "5/  5" in lines[1] and "20.00 dB" in lines[1]
    rows = json.loads((tmp_path / "r.json").read_text())["sets"]
    assert set(rows) == {f"{name}, normal, {device}" for name in ("one", "two")}


def test_failures_have_a_row_and_matchers_separate_rows(tmp_path, monkeypatch, device):
    (tmp_path / "set").mkdir()
    monkeypatch.setattr(bench, "measure_in_subprocess", bench.measure)  # failures do not need a subprocess
    for matcher in ("sift", "aliked-lightglue"):
        options = bench.ReconstructBenchOptions(matcher=matcher)
        lines = list(bench.run([tmp_path / "set"], tmp_path / "r.json", options))
        assert lines[1].startswith("set ") and "no photos" in lines[1]
    rows = json.loads((tmp_path / "r.json").read_text())["sets"]
    assert set(rows) == {f"set, normal, {device}", f"set, normal, {device}, aliked-lightglue"}
    assert str(tmp_path) not in str(rows)


def test_cameras_alone_are_compared_with_references(tmp_path, monkeypatch, device):
    pytest.importorskip("pycolmap")
    write_set(tmp_path / "set", arc(4, (240, 180), sweep=40.0)).rename(tmp_path / "set" / "cameras.json")
    monkeypatch.setattr(bench, "measure_in_subprocess", bench.measure)
    options = bench.ReconstructBenchOptions(cameras_only=True)
    lines = list(bench.run([tmp_path / "set"], tmp_path / "r.json", options))
    row = json.loads((tmp_path / "r.json").read_text())["sets"][f"set, normal, {device}, cameras"]
    assert row["placed"] == row["photos"] == row["poses"]["cameras"] == 4 and "4/  4" in lines[1]
    assert row["poses"]["rotation"] < 0.5 and row["poses"]["shift"] < 2.0
    assert set(row["seconds"]) == {"features", "matches", "model"}  # later steps are skipped


def test_orbits_are_level():
    """An orbit's mean up axis is the reference for the tilt."""
    up = -orbit(8, torch.zeros(3), 2.0, 30.0)[:, 1, :3].mean(0)
    assert float(up[2] / up.norm()) > 0.9999
