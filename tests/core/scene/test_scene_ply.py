import dataclasses
import math
import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from stages.core.errors import InputError
from stages.core.geometry.rotations import covariance
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.schema import MAX_OBJECT_ID
from stages.core.scene.sequence import FilmedSequence
from tests.conftest import random_gaussians
from tests.core.scene.test_cameras import with_photos


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip_of_gaussians(tmp_path, degree):
    g = random_gaussians(50, degree=degree)
    write_scene(tmp_path / "s.ply", Scene(g))
    back = read_scene(tmp_path / "s.ply").gaussians
    for field in dataclasses.fields(g):
        torch.testing.assert_close(getattr(back, field.name), getattr(g, field.name), rtol=1e-5, atol=1e-6)


def test_round_trip_of_metadata(tmp_path, two_balls):
    scale = {"metres_per_unit": 0.5, "source": "known"}
    scene = dataclasses.replace(two_balls, scale=scale, provenance={"seed": 1}, background=(0.2, 0.4, 0.6))
    write_scene(tmp_path / "s.ply", scene)
    back = read_scene(tmp_path / "s.ply")
    for name in ("objects", "floor", "scale", "provenance", "background"):
        assert getattr(back, name) == getattr(scene, name)
    torch.testing.assert_close(back.cameras.viewmats, scene.cameras.viewmats)
    assert back.cameras.names == scene.cameras.names


def test_round_trip_of_the_films(tmp_path, two_balls):
    sequence = FilmedSequence(50.0, 40, {"a.mp4": 12.25, "b.mp4": -1.5})
    write_scene(tmp_path / "s.ply", dataclasses.replace(two_balls, sequence=sequence))
    assert read_scene(tmp_path / "s.ply").sequence == sequence
    data = (tmp_path / "s.ply").read_bytes()
    (tmp_path / "s.ply").write_bytes(data.replace(b'"a.mp4": 12.25', b'"a.mp4": "aaa"', 1))
    with pytest.raises(InputError, match=r"s.ply: .* is damaged .*the start of a.mp4"):
        read_scene(tmp_path / "s.ply")


def test_round_trip_of_the_photos_as_taken(tmp_path, two_balls):
    scene = dataclasses.replace(two_balls, cameras=with_photos(two_balls.cameras))
    write_scene(tmp_path / "s.ply", scene)
    photos = read_scene(tmp_path / "s.ply").cameras.photos
    for field in dataclasses.fields(photos):
        assert torch.equal(getattr(photos, field.name), getattr(scene.cameras.photos, field.name))


def test_files_without_a_lens_have_none(tmp_path, two_balls):
    write_scene(tmp_path / "s.ply", two_balls)
    assert b'"photo"' not in (tmp_path / "s.ply").read_bytes()
    assert read_scene(tmp_path / "s.ply").cameras.photos is None


def test_damaged_lens_is_refused_in_one_line(tmp_path, two_balls):
    write_scene(tmp_path / "s.ply", dataclasses.replace(two_balls, cameras=with_photos(two_balls.cameras)))
    data = (tmp_path / "s.ply").read_bytes()
    (tmp_path / "s.ply").write_bytes(data.replace(b'"model": "opencv"', b'"model": "pinole"', 1))
    with pytest.raises(InputError, match=r"s.ply: a header comment .* is damaged .*lens model 'pinole' is not known"):
        read_scene(tmp_path / "s.ply")


def test_stored_values_follow_the_standard_layout(tmp_path):
    """Read with plyfile alone: logits, logarithms and f_rest in channel-major order."""
    g = random_gaussians(4, degree=1)
    write_scene(tmp_path / "s.ply", Scene(g))
    vertex = PlyData.read(str(tmp_path / "s.ply"))["vertex"]
    np.testing.assert_allclose(vertex["scale_1"], g.scales[:, 1].log(), rtol=1e-5)
    np.testing.assert_allclose(vertex["opacity"], g.opacities.logit(), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(vertex["rot_0"], g.quats[:, 0], rtol=1e-6)
    np.testing.assert_allclose(vertex["f_rest_3"], g.sh[:, 1, 1], rtol=1e-6)  # the first of three coefficients of green
    assert [p.name for p in vertex.properties][:6] == ["x", "y", "z", "nx", "ny", "nz"]


@pytest.mark.parametrize("order", ["<", ">"])
def test_files_of_other_tools_are_read(tmp_path, order):
    """Files without normals, with an extra property, in either byte order, and with quaternions of any length."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
             "rot_0", "rot_1", "rot_2", "rot_3", "confidence"]  # fmt: skip
    row = np.zeros(2, [(name, f"{order}f4") for name in names])
    row["x"], row["rot_0"], row["scale_0"] = [1, 2], 3, np.log(0.1)
    PlyData([PlyElement.describe(row, "vertex")], byte_order=order).write(str(tmp_path / "o.ply"))
    scene = read_scene(tmp_path / "o.ply")
    assert scene.gaussians.means[:, 0].tolist() == [1, 2]
    assert scene.gaussians.quats[0].tolist() == [1, 0, 0, 0]
    torch.testing.assert_close(scene.gaussians.scales[0], torch.tensor([0.1, 1, 1]))
    assert (scene.floor, scene.objects, scene.cameras) == (None, (), None)


def test_packed_layout_decodes_to_the_same_gaussians(shared):
    plain = read_scene(shared / "data/splats/guitar.ply").gaussians
    packed = read_scene(shared / "data/splats/guitar.compressed.ply").gaussians
    for name in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(packed, name), getattr(plain, name), rtol=1e-5, atol=1e-5)
    ours, theirs = covariance(packed.quats, packed.scales), covariance(plain.quats, plain.scales)
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)


def test_rows_that_are_not_finite_or_far_too_large_are_dropped_and_counted(tmp_path, caplog):
    g = random_gaussians(6)
    g.means[0, 0], g.means[1, 1], g.scales[2, 0], g.quats[3] = torch.nan, 1e12, 1e12, 0.0
    write_scene(tmp_path / "s.ply", Scene(g))
    assert torch.equal(read_scene(tmp_path / "s.ply").gaussians.means, g.means[4:])
    assert "dropped 4" in caplog.text


def test_packed_values_are_fractions_between_the_bounds_of_their_chunk(tmp_path):
    """Gaussian 0 has the lowest values, 300 (in the second chunk) the highest; their omitted components are w and z."""
    n, ends = 301, ((-1.0, 3.0), (-5.0, 7.0))
    chunk = np.zeros(2, [(f"{end}_{part}{axis}", "<f4") for part in ("", "scale_") for end in ("min", "max")
                         for axis in "xyz"])  # fmt: skip
    for i, (low, high) in enumerate(ends):
        for axis in "xyz":
            chunk[f"min_{axis}"][i], chunk[f"max_{axis}"][i] = low, high
            chunk[f"min_scale_{axis}"][i], chunk[f"max_scale_{axis}"][i] = low - 9, high - 9
    names = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    vertex = np.zeros(n, [(name, "<u4") for name in names])
    vertex["packed_rotation"] = 511 << 20 | 511 << 10 | 511  # w is 1, as nearly as 10 bits allow
    vertex["packed_rotation"][300] = 3 << 30 | 511 << 20 | 511 << 10 | 511
    vertex["packed_position"][300], vertex["packed_scale"][300], vertex["packed_color"][300] = [2**32 - 1] * 3
    vertex["packed_position"][1] = 1024 << 21 | 512 << 11 | 256
    vertex["packed_rotation"][2] = 2 << 30 | 700 << 20 | 300 << 10 | 600  # w, x and z are given, and y is computed
    PlyData([PlyElement.describe(chunk, "chunk"), PlyElement.describe(vertex, "vertex")]).write(tmp_path / "p.ply")
    g = read_scene(tmp_path / "p.ply").gaussians
    torch.testing.assert_close(g.means[[0, 300]], torch.tensor([[-1.0] * 3, [7.0] * 3]))
    torch.testing.assert_close(g.means[1], -1 + 4 * torch.tensor([1024 / 2047, 512 / 1023, 256 / 2047]))
    torch.testing.assert_close(g.scales[[0, 300]].log(), torch.tensor([[-10.0] * 3, [-2.0] * 3]))
    torch.testing.assert_close(g.quats[[0, 300]], torch.eye(4)[[0, 3]], atol=2e-3, rtol=0)
    w, x, z = ((bits / 1023 - 0.5) * 2**0.5 for bits in (700, 300, 600))
    torch.testing.assert_close(g.quats[2], torch.tensor([w, x, (1 - w * w - x * x - z * z) ** 0.5, z]))
    torch.testing.assert_close(g.opacities[[0, 300]], torch.tensor([1 / 512, 1 - 1 / 512]))
    torch.testing.assert_close(g.sh[[0, 300], 0] * 0.28209479177387814 + 0.5, torch.tensor([[0.0] * 3, [1.0] * 3]))


def test_packed_colours_between_bounds_and_harmonics_in_bytes(tmp_path):
    """Colours are 0.2 + 0.6 f, between the chunk's bounds; coefficients start at -4 with steps of 8 / 256."""
    bounds = [(f"{end}_{part}{axis}", "<f4") for part in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    chunk = np.zeros(1, bounds + [(f"{end}_{c}", "<f4") for end in ("min", "max") for c in "rgb"])
    for c in "rgb":
        chunk[f"min_{c}"], chunk[f"max_{c}"] = 0.2, 0.8
    vertex = np.zeros(1, [(f"packed_{name}", "<u4") for name in ("position", "rotation", "scale", "color")])
    vertex["packed_color"] = 0 << 24 | 51 << 16 | 255 << 8 | 102
    sh = np.zeros(1, [(f"f_rest_{i}", "u1") for i in range(9)])
    for i in range(9):
        sh[f"f_rest_{i}"] = 28 * i
    elements = [PlyElement.describe(*row) for row in ((chunk, "chunk"), (vertex, "vertex"), (sh, "sh"))]
    PlyData(elements).write(tmp_path / "p.ply")
    g = read_scene(tmp_path / "p.ply").gaussians
    torch.testing.assert_close(g.sh[0, 0] * 0.28209479177387814 + 0.5, torch.tensor([0.2, 0.32, 0.8]))
    torch.testing.assert_close(g.opacities, torch.tensor([0.4]))
    coefficients = (28 * torch.arange(9) / 256 - 0.5) * 8  # three each of red, green and blue
    torch.testing.assert_close(g.sh[0, 1:], coefficients.reshape(3, 3).T)


def write_invalid_files(folder):
    (folder / "empty.ply").touch()
    (folder / "text.ply").write_text("hello")
    points = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    PlyData([PlyElement.describe(points, "vertex")]).write(str(folder / "points.ply"))
    write_scene(folder / "whole.ply", Scene(random_gaussians(100)))
    (folder / "cut.ply").write_bytes((folder / "whole.ply").read_bytes()[:-500])
    return folder


@pytest.mark.parametrize(
    ("name", "message"),
    [("empty.ply", "is empty"), ("text.ply", "not a readable PLY"), ("points.ply", "plain point cloud"),
     ("cut.ply", "not a readable PLY"), ("absent.ply", "no such file"), (".", "is a folder")],
)  # fmt: skip
def test_invalid_files_are_refused_in_one_line(tmp_path, name, message):
    with pytest.raises(InputError, match=message) as caught:
        read_scene(write_invalid_files(tmp_path) / name)
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("key", ["version", "scale", "floor", "background", "sequence", "provenance"])
def test_what_a_scene_has_once_is_in_one_comment(tmp_path, two_balls, key):
    sequence = FilmedSequence(50.0, 40, {"a.mp4": 12.25})
    write_scene(tmp_path / "s.ply", replace(two_balls, background=(0.2, 0.4, 0.6), sequence=sequence))
    data = (tmp_path / "s.ply").read_bytes()
    begin = data.index(f"comment ngff:{key} ".encode())
    end = data.index(b"\n", begin) + 1
    (tmp_path / "s.ply").write_bytes(data[:end] + data[begin:end] + data[end:])
    with pytest.raises(InputError, match=f"is damaged .*ngff:{key} is there more than once"):
        read_scene(tmp_path / "s.ply")


def test_only_provenance_may_have_values_that_are_not_finite(tmp_path, two_balls):
    """Options of a run can be infinite, values of a camera or an object cannot."""
    write_scene(tmp_path / "s.ply", replace(two_balls, provenance={"options": {"limit": math.inf}}))
    assert read_scene(tmp_path / "s.ply").provenance == {"options": {"limit": math.inf}}
    data = (tmp_path / "s.ply").read_bytes()
    first = b"comment ngff:"
    for more in (b'object {"id": 1, "name": "a", "weight": NaN}', b'camera {"weight": Infinity}'):
        (tmp_path / "s.ply").write_bytes(data.replace(first, first + more + b"\n" + first, 1))
        with pytest.raises(InputError, match="is damaged .*(NaN|Infinity)"):
            read_scene(tmp_path / "s.ply")


def test_files_without_gaussians_or_of_another_degree_or_version_are_refused(tmp_path, two_balls):
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3)),
             *(f"rot_{i}" for i in range(4))]  # fmt: skip
    for count, more, element, message in (
        # the second file has quaternions of length 0
        (0, [], "vertex", "contains no Gaussians"), (2, [], "vertex", "contains no Gaussians"),
        (2, [], "points", "has no element called vertex"),
        (2, [f"f_rest_{i}" for i in range(8)], "vertex", "8 f_rest properties; SH of degree 1, 2 or 3"),
    ):  # fmt: skip
        rows = np.zeros(count, [(name, "f4") for name in names + more])
        PlyData([PlyElement.describe(rows, element)]).write(str(tmp_path / "o.ply"))
        with pytest.raises(InputError, match=f"o.ply: .*{message}|o.ply: {message}"):
            read_scene(tmp_path / "o.ply")
    write_scene(tmp_path / "s.ply", two_balls)
    data = (tmp_path / "s.ply").read_bytes()
    (tmp_path / "s.ply").write_bytes(data.replace(b"ngff:version 1", b"ngff:version 2", 1))
    with pytest.raises(InputError, match="s.ply: format version 2 is newer than 1; upgrade ngff"):
        read_scene(tmp_path / "s.ply")


def test_failed_write_keeps_the_old_file(tmp_path, two_balls, monkeypatch):
    path = tmp_path / "s.ply"
    write_scene(path, two_balls)
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="No space left"):
        write_scene(path, two_balls)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["s.ply"]


def test_what_could_not_be_read_is_not_written(tmp_path, two_balls):
    tiny = replace(two_balls, scale={"metres_per_unit": 1e-9, "source": "given"})
    with pytest.raises(InputError, match="cannot be written, as metres_per_unit is 1e-09"):
        write_scene(tmp_path / "s.ply", tiny)
    assert not list(tmp_path.iterdir())


def test_an_object_that_is_there_twice_is_refused(tmp_path, two_balls):
    write_scene(tmp_path / "s.ply", replace(two_balls, objects=two_balls.objects[:1] * 2))
    with pytest.raises(InputError, match="object 1 occurs twice"):
        read_scene(tmp_path / "s.ply")


@pytest.mark.parametrize("id", [0, MAX_OBJECT_ID])
def test_ids_of_objects_up_to_the_largest_are_read(tmp_path, two_balls, id):
    g = two_balls.gaussians
    write_scene(
        tmp_path / "s.ply", replace(two_balls, gaussians=replace(g, object_id=torch.full_like(g.object_id, id)))
    )
    assert read_scene(tmp_path / "s.ply").gaussians.object_id.unique().tolist() == [id]


def test_more_gaussians_than_the_file_holds_are_refused_before_they_are_read(tmp_path, monkeypatch):
    write_scene(tmp_path / "s.ply", Scene(random_gaussians(50)))
    data = (tmp_path / "s.ply").read_bytes()
    (tmp_path / "s.ply").write_bytes(data.replace(b"element vertex 50", b"element vertex 51", 1))
    monkeypatch.setattr(PlyData, "read", lambda *_: pytest.fail("read"))
    with pytest.raises(InputError, match=r"s.ply: is not a readable PLY file .*declares \d+ bytes or more; it has"):
        read_scene(tmp_path / "s.ply")


@pytest.mark.parametrize("order", ["<", ">", "text"])
def test_comments_of_other_tools_need_not_be_ascii(tmp_path, two_balls, order):
    write_scene(tmp_path / "s.ply", two_balls)
    ply = PlyData.read(str(tmp_path / "s.ply"))
    ply.text, ply.byte_order = (True, "=") if order == "text" else (False, order)
    ply.write(str(tmp_path / "a.ply"))
    data = (tmp_path / "a.ply").read_bytes()
    data = data.replace(b"comment ngff:up", "comment José, 图, 😀\ncomment ".encode() + b"\xff\xfe\ncomment ngff:up", 1)
    (tmp_path / "b.ply").write_bytes(data.replace(b"green ball", "grüner Ball 😀".encode()))
    plain, found = read_scene(tmp_path / "a.ply"), read_scene(tmp_path / "b.ply")
    assert [o.name for o in found.objects] == ["red ball", "grüner Ball 😀"]
    for field in dataclasses.fields(plain.gaussians):
        assert torch.equal(getattr(found.gaussians, field.name), getattr(plain.gaussians, field.name)), field.name
    (tmp_path / "c.ply").write_bytes(data[:-500])
    with pytest.raises(InputError, match="c.ply: is not a readable PLY file"):
        read_scene(tmp_path / "c.ply")


@pytest.mark.parametrize("id", [1.5, math.nan, -1.0, math.inf])
def test_ids_of_objects_are_whole_numbers(tmp_path, two_balls, id):
    write_scene(tmp_path / "a.ply", two_balls)
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    rows = rows.astype([(name, "f4") for name in rows.dtype.names])
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "b.ply"))
    assert read_scene(tmp_path / "b.ply").gaussians.object_id.unique().tolist() == [0, 1, 2]
    rows["object_id"][-1] = id
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "b.ply"))
    with pytest.raises(InputError, match="an object_id is not a whole number from 0 to 65535"):
        read_scene(tmp_path / "b.ply")
