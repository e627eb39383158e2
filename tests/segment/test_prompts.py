"""User inputs of `ngff segment`: prompts.json, names of labels, folders of images, measured lengths."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from stages.core.errors import InputError
from stages.core.scene.cameras import PhotoIntrinsics
from stages.segment import masks, prompts, view_images
from stages.segment.boxes import MAX_VIEWS, nearest_first
from stages.segment.masks import read_names
from stages.segment.object_scale import ObjectScaleReference, parse_object_scale
from stages.segment.prompted import point_prompts
from stages.segment.prompts import ObjectPrompts, read_prompts
from stages.segment.propagation import label_image
from stages.segment.view_images import match_files, render_view
from tests.conftest import ring


def prompts_file(folder, **data) -> Path:
    (folder / "p.json").write_text(json.dumps(data))
    return folder / "p.json"


def test_rows_of_prompts_and_their_names(tmp_path):
    cameras = ring(count=2)
    one = read_prompts(prompts_file(tmp_path, bbox=[1, 2, 3, 4]), cameras)  # the outer brackets may be omitted
    assert one.boxes.tolist() == [[1, 2, 3, 4]] and one.points is None and one.names == ("object_1",)
    two = read_prompts(prompts_file(tmp_path, center_point=[[5, 6], [7, 8]], text=["a", "b"]), cameras)
    assert two.boxes is None and two.points.tolist() == [[5, 6], [7, 8]] and two.names == ("a", "b")
    both = read_prompts(prompts_file(tmp_path, bbox=[[0, 0, 9, 9]], center_point=[[4, 4]], text=["c"]), cameras)
    assert both.boxes.shape == (1, 4) and both.points.shape == (1, 2)


@pytest.mark.parametrize(("data", "message"), [
    ({}, "neither a bbox nor a center_point"), ({"bbox": [], "text": ["a"]}, "neither a bbox"),
    ({"bbox": [[0, 0, 1, 1]] * 2, "center_point": [[0, 0]]}, "2 boxes, 1 points and 2 names"),
    ({"bbox": [[0, 0, 1, 1]], "text": ["a", "b"]}, "1 boxes, 0 points and 2 names"),
    ({"bbox": [[0, 0, 1]]}, "is not a prompts file .bbox is"), ({"bbox": {"a": 1}}, "bbox is"),
    ({"bbox": [[0, 0, 1, 2e6]]}, "bbox is"), ({"bbox": [[0, 0, 1, 1]], "text": [3]}, "text is"),
    ({"bbox": [[0, 5, 1, 5]]}, "a box has no area"), ({"bbox": [[3, 0, 1, 5]]}, "a box has no area"),
    ({"bbox": [[0, 0, 1, 1]], "size": [64, 0]}, "size is"), ({"bbox": [[0, 0, 1, 1]], "size": [64.5, 64]}, "size is"),
])  # fmt: skip
def test_other_prompts_are_refused(tmp_path, data, message):
    with pytest.raises(InputError, match=f"p.json: .*{message}|{message}"):
        read_prompts(prompts_file(tmp_path, **data), ring(count=1))


def test_points_where_the_lens_shows_nothing_are_refused(tmp_path):
    """r (1 - r^2 / 4) is at most 0.77, so no direction is seen in the corners of a wide photo."""
    cameras = ring(count=1)
    K = torch.tensor([[[30.0, 0, 32], [0, 30, 32], [0, 0, 1]]])
    barrel = PhotoIntrinsics(K, cameras.sizes, torch.tensor([[-0.25, 0, 0, 0, 0]]))
    cameras = replace(cameras, photos=barrel)
    assert read_prompts(prompts_file(tmp_path, center_point=[[40, 32]]), cameras).points.isfinite().all()
    with pytest.raises(InputError, match="p.json: a center_point is where the lens of 00.png shows nothing"):
        read_prompts(prompts_file(tmp_path, center_point=[[40, 32], [1, 1]]), cameras)


def test_the_number_of_prompts_is_bounded(tmp_path, monkeypatch):
    path = prompts_file(tmp_path, bbox=[[0, 0, 1, 1]] * 3)
    monkeypatch.setattr(prompts, "MAX_OBJECT_ID", 3)
    assert len(read_prompts(path, ring(count=1)).names) == 3
    monkeypatch.setattr(prompts, "MAX_OBJECT_ID", 2)
    with pytest.raises(InputError, match="bbox has 3 rows; at most 2 are read"):
        read_prompts(path, ring(count=1))


def test_networks_take_fractions_of_the_first_view(two_balls):
    sizes = torch.tensor([[80, 40]] + [[30, 30]] * 5)
    scene = replace(two_balls, cameras=replace(two_balls.cameras, sizes=sizes))
    (box,) = point_prompts(ObjectPrompts(torch.tensor([[8.0, 4, 16, 20]]), torch.tensor([[9.0, 9]]), ("a",)), scene)
    torch.testing.assert_close(box.points, torch.tensor([[0.1, 0.1], [0.2, 0.5]]))
    (point,) = point_prompts(ObjectPrompts(None, torch.tensor([[8.0, 20]]), ("a",)), scene)
    torch.testing.assert_close(point.points, torch.tensor([[0.1, 0.5]]))


@pytest.mark.parametrize(("data", "names"), [
    ({"1": "duck", "07": "bowl"}, {1: "duck", 7: "bowl"}), ({"2": {"name": "duck", "x": 1}}, {2: "duck"}),
    (["duck", "bowl"], {1: "duck", 2: "bowl"}), ({}, {}), ({"a": "duck"}, None), ({"1": 3}, None), ([{"x": 1}], None),
    ({"1": "a", "01": "b"}, None), ("duck", None), (3, None),
])  # fmt: skip
def test_names_of_labels(tmp_path, data, names):
    assert read_names(tmp_path) == {}
    (tmp_path / "names.json").write_text(json.dumps(data))
    if names is not None:
        assert read_names(tmp_path) == names
    else:
        with pytest.raises(InputError, match="names.json: is not readable"):
            read_names(tmp_path)


def test_numbers_of_labels_have_columns_in_the_order_in_which_they_appear(monkeypatch):
    columns = {0: 0}
    assert masks._columns(torch.tensor([[7, 0], [3, 7]]), columns).tolist() == [[2, 0], [1, 2]]
    assert masks._columns(torch.tensor([[9, 3]]), columns).tolist() == [[3, 1]] and columns == {0: 0, 3: 1, 7: 2, 9: 3}
    monkeypatch.setattr(masks, "MAX_LABELS", 5)
    masks._columns(torch.tensor([[4]]), columns)
    with pytest.raises(InputError, match="more than 5 different numbers"):
        masks._columns(torch.tensor([[5]]), columns)


def test_images_belong_to_photos_by_their_names_without_suffix(tmp_path, caplog):
    caplog.set_level("INFO")
    with pytest.raises(InputError, match="contains no mask named like a photo of the scene, such as a.png"):
        match_files(tmp_path, ("x/a.jpg", "b.jpg"), "mask", "--masks")
    with pytest.raises(InputError, match="absent: is not a folder; --masks takes a folder of masks"):
        match_files(tmp_path / "absent", ("a.jpg",), "mask", "--masks")
    with pytest.raises(InputError, match="the scene does not state the names of its photos"):
        match_files(tmp_path, (), "mask", "--masks")
    for name in ("b.PNG", "c.jpg", "a.txt"):
        (tmp_path / name).touch()
    assert match_files(tmp_path, ("a.jpg", "b.jpg"), "mask", "--masks") == {1: tmp_path / "b.PNG"}
    assert "masks for 1 of 2 photos" in caplog.text
    caplog.clear()
    assert match_files(tmp_path, ("b.jpg",), "mask", "--masks") and not caplog.text


def test_views_are_rendered_at_limited_size(two_balls, monkeypatch):
    full = render_view(two_balls, 0)
    assert full.shape == (64, 64, 3) and full.min() >= 0 and full.max() <= 1
    monkeypatch.setattr(view_images, "MAX_RENDER_SIDE", 32)
    half = render_view(two_balls, 0)
    means = full.reshape(32, 2, 32, 2, 3).mean((1, 3))
    assert half.shape == (32, 32, 3) and float((half - means).abs().mean()) < 0.03


def test_the_first_view_comes_first_and_of_many_some_are_taken(two_balls):
    order = nearest_first(two_balls)
    # the order around a ring of six
    assert [min(i, 6 - i) for i in order] == [0, 1, 1, 2, 2, 3] and len(set(order)) == 6
    many = replace(two_balls, cameras=ring(count=100))
    views = nearest_first(many)
    assert len(set(views)) == MAX_VIEWS == len(views) and views[0] == 0 and abs(views[-1] - 50) <= 1


def test_each_pixel_is_of_the_largest_positive_logit():
    logits = torch.tensor([[[1.0, -1], [2, -3]], [[-1, 0], [3, -2]]])
    assert label_image(logits, 2, 2).tolist() == [[1, 0], [2, 0]]
    assert label_image(logits, 4, 2).shape == (2, 4)


@pytest.mark.parametrize(("text", "result"), [
    ("", None), ("object=1 height=0.12", ObjectScaleReference(1, "height", 0.12)),
    (" object=12  length=2e1 ", ObjectScaleReference(12, "length", 20.0)), ("object=1 height=0", "more than 0"),
    ("object=1 length=99999", ObjectScaleReference(1, "length", 99999.0)), ("object=1 length=1e5", "more than 0"),
    ("object=1 height=-1", "more than 0"), ("object=1 width=1", "write"), ("object=1 height=1.2.3", "write"),
    ("height=1", "write"),
])  # fmt: skip
def test_measured_lengths(text, result):
    if isinstance(result, str):
        with pytest.raises(InputError, match=f"--scale-reference .*{result}"):
            parse_object_scale(text)
    else:
        assert parse_object_scale(text) == result


@pytest.mark.parametrize(("side", "units"), [("height", 0.3), ("length", 0.6)])
def test_a_measured_length_gives_the_scale(two_balls, side, units):
    """The object has the size 0.6 x 0.2 x 0.3, without two outliers among 1000 points."""
    x = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.6, 0.2, 0.3])
    x[:2] = 50.0
    g = two_balls.gaussians
    mine = torch.zeros_like(g.object_id)
    mine[:1000] = 3
    means = g.means.clone()
    means[:1000] = x
    scene = replace(two_balls, gaussians=replace(g, means=means, object_id=mine))
    scaled = ObjectScaleReference(3, side, 1.5).applied(scene)
    assert scaled.metres_per_unit == pytest.approx(1.5 / units, rel=0.03)
    assert scaled.scale["source"] == f"--scale-reference object=3 {side}=1.5"
    with pytest.raises(InputError, match="there is no object 2 in the scene; objects found: 1 .red ball., 2"):
        ObjectScaleReference(2, side, 1.0).applied(scene)
    flat = replace(scene, gaussians=replace(scene.gaussians, means=torch.zeros_like(means)))
    with pytest.raises(InputError, match=f"object 3 has no measurable {side} in the scene"):
        ObjectScaleReference(3, side, 1.0).applied(flat)
