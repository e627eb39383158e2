"""Comparison of a scene's objects with label images: panoptic quality, ignored objects, malformed input, report."""

import json
import re
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import intrinsics
from stages.core.scene.cameras import Cameras, PhotoIntrinsics
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.images import read_labels, write_labels, write_png
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.evaluate.label_pictures import paint
from stages.evaluate.labels import LabelOverlap
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.stage import run


def overlap_of(truth: list, found: list, judged=None) -> LabelOverlap:
    truth, found = torch.tensor(truth)[None], torch.tensor(found)[None]
    overlap = LabelOverlap()
    overlap.add(truth, found, torch.ones_like(truth, dtype=torch.bool) if judged is None else judged)
    return overlap


def test_panoptic_quality_by_hand():
    # IoU of object 1 is 0.8 (80 of 100 pixels are found as 7, which has no others); 2 is missed; 9 is only background
    truth = [1] * 100 + [2] * 100 + [0] * 300
    found = [7] * 80 + [0] * 20 + [0] * 100 + [9] * 60 + [0] * 240
    scores = overlap_of(truth, found).scores()
    assert scores.iou == {1: 0.8, 2: 0.0} and scores.matched == {1: 7} and scores.false == [9]
    expected = {"IoU": 0.4, "pixels": 500, "recall": 0.5, "SQ": 0.8, "RQ": 0.5, "PQ": 0.4, "objects": 2, "found": 2,
                "false": 1, "false_share": 60 / 500}  # fmt: skip
    assert scores.summary() == pytest.approx(expected)


def test_half_an_object_is_a_match_without_being_a_hit():
    # the IoU of 0.5 is not above 0.5, so object 1 counts as missed and 4 as false
    scores = overlap_of([1] * 200 + [0] * 10, [4] * 100 + [0] * 110).scores()
    assert scores.iou == {1: 0.5} and scores.hits == {} and scores.false == [4]
    assert scores.summary()["PQ"] == 0 and scores.summary()["IoU"] == 0.5


def test_small_found_objects_are_left_out():
    assert overlap_of([0] * 200, [3] * 59 + [0] * 141).scores().found_pixels == {}
    assert overlap_of([0] * 200, [3] * 60 + [0] * 140).scores().false == [3]


def test_overlaps_are_summed_over_images():
    overlap = overlap_of([1] * 100, [5] * 100)
    overlap.add(torch.ones(1, 100, dtype=torch.int64), torch.zeros(1, 100, dtype=torch.int64), torch.ones(1, 100) > 0)
    assert overlap.scores().iou == {1: 0.5}


def test_nothing_labelled_and_nothing_found():
    assert overlap_of([0] * 50, [0] * 50).scores().summary()["PQ"] == 0
    assert overlap_of([], []).scores().summary()["pixels"] == 0


def billboards(pictures: list[np.ndarray], names: list[str], size: tuple[int, int]) -> Scene:
    """A scene whose cameras, of this size, each see a wall with a picture of object ids in opaque Gaussians.

    Gaussians are blurred by half a pixel, and of equally distant ones the first is in front, so the last row and column
    of an object may be missing.
    """
    (width, height), (h, w) = size, pictures[0].shape
    y, x = np.meshgrid((np.arange(h) + 0.5) / h - 0.5, (np.arange(w) + 0.5) / w - 0.5, indexing="ij")
    wall = np.stack([x, y * height / width, np.ones_like(x)], -1).reshape(-1, 3)
    viewmats = torch.eye(4).repeat(len(names), 1, 1)
    viewmats[:, 0, 3] = -100.0 * torch.arange(len(names))  # far apart from each other
    means = np.concatenate([wall + (100.0 * i, 0, 0) for i in range(len(names))])
    ids = torch.from_numpy(np.concatenate([p.ravel() for p in pictures]).astype(np.int64))
    n, K = len(means), intrinsics(width, height, float(width))
    g = Gaussians(
        torch.from_numpy(means).float(), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n, 3), 0.4 / w),
        torch.full((n,), 0.99), torch.zeros(n, 1, 3), ids,
    )  # fmt: skip
    cameras = Cameras(viewmats, K.expand(len(names), 3, 3).clone(), torch.tensor([size] * len(names)), tuple(names))
    return Scene(g, tuple(SceneObject(i, f"object_{i}") for i in ids.unique().tolist() if i), cameras, 0.0)


SIZE = (64, 48)
NAMES = {"1": {"name": "duck", "core": True}, "2": {"name": "mat", "core": False}, "3": {"name": "cup"}}


def picture(size: tuple[int, int] = SIZE, **boxes) -> np.ndarray:
    """Labels of a view; for example, a_5=(x0, y0, x1, y1) fills a rectangle with 5."""
    out = np.zeros(size[::-1], np.int64)
    for name, (x0, y0, x1, y1) in boxes.items():
        out[y0:y1, x0:x1] = int(name.split("_")[1])
    return out


@pytest.fixture
def labelled(tmp_path):
    """A scene of one view and the labels of its photo: duck completely found, mat found, cup missed, a false object."""
    scene = billboards([picture(a_5=(4, 4, 24, 24), b_6=(30, 4, 50, 24), c_7=(4, 30, 24, 40))], ["a.b.jpg"], SIZE)
    write_scene(tmp_path / "labelled.ply", scene)
    truth = picture(a_1=(4, 4, 24, 24), b_2=(30, 4, 50, 24), c_3=(40, 30, 60, 40), d_255=(0, 44, 64, 48))
    (tmp_path / "labels").mkdir()
    write_labels(tmp_path / "labels/a.b.png", torch.from_numpy(truth))
    (tmp_path / "labels/names.json").write_text(json.dumps(NAMES))
    return tmp_path


def evaluate(folder: Path, **options) -> dict:
    return run(folder / "labelled.ply", folder / "labels", None, EvaluateOptions(**options))


def test_objects_that_are_not_core_are_left_out(labelled, capsys):
    write_labels(labelled / "labels/c.png", torch.ones(5, 5, dtype=torch.int64))
    facts = evaluate(labelled)
    assert "label images of photos that the scene has no camera for: c.png" in facts["notes"]
    # all pixels are judged except the mat's 400 and the 4 rows of 255
    assert facts["kind"] == "labels" and facts["overall"]["pixels"] == 64 * 48 - 400 - 4 * 64
    assert facts["objects"]["duck"]["IoU"] > 0.94 and facts["objects"]["cup"] == {"IoU": 0.0, "pixels": 200}
    assert "mat" not in facts["objects"] and "neither asked for nor held against the result: mat" in facts["notes"]
    overall = facts["overall"]
    assert (overall["objects"], overall["found"], overall["false"], overall["photos"]) == (2, 2, 1, 1)
    assert overall["recall"] == overall["RQ"] == 0.5 and overall["PQ"] == pytest.approx(overall["SQ"] / 2)
    assert overall["false_share"] == pytest.approx(200 / overall["pixels"], rel=0.08)
    assert any("object_7" in note and note.startswith("false objects") for note in facts["notes"])
    assert json.loads((labelled / "metrics.json").read_text())["overall"] == overall
    assert capsys.readouterr().out.splitlines()[1].startswith("duck")


def test_objects_are_painted_over_the_photo_in_grey_with_white_borders():
    ids = torch.tensor([0] * 3 + [1] * 3 + [2] * 3 + [1] * 3).repeat(2, 1)
    judged = torch.ones(2, 12, dtype=torch.bool)
    judged[:, 9:] = False  # labels of 1 in this area must not count
    out = paint(torch.full((2, 12, 3), 0.5), ids, {1: (0.0, 1.0, 0.0)}, judged)
    # object 2 has no colour and is therefore red
    expected = torch.tensor([[0.3] * 3, [0.12, 0.72, 0.12], [0.66, 0.18, 0.18], [0.48] * 3])
    torch.testing.assert_close(out[0, [1, 5, 8, 10]], expected)
    assert (out[:, [3, 6, 9]] == 1).all() and (out == 1).all(-1).sum() == 6


def test_report_shows_photo_truth_and_found(labelled):
    (labelled / "photos").mkdir()
    write_png(labelled / "photos/a.b.png", torch.full((96, 128, 3), 0.5))
    evaluate(labelled, report=labelled / "r.html", photos=labelled / "photos")
    html = (labelled / "r.html").read_text()
    assert re.findall(r'<img alt="([^"]*)"', html) == ["photo", "truth", "found"] and "a.b.jpg" in html
    assert "&#9632;</span> duck" in html and "false object" in html and "http" not in html
    evaluate(labelled, report=labelled / "r.html")
    assert "rendered photo, truth, found; a.b.jpg" in (labelled / "r.html").read_text()


def test_label_image_through_a_lens(labelled):
    # with k1 = -0.25, a label image of the photo matches only after undistortion
    size, photo_size, focal = (256, 192), (320, 240), 275.0
    boxes = (8, 8, 48, 56), (200, 120, 248, 184)
    scene = billboards([picture(size, a_5=boxes[0], b_6=boxes[1])], ["a.b.jpg"], size)
    K = intrinsics(*photo_size, focal)
    photos = PhotoIntrinsics(K[None], torch.tensor([photo_size]), torch.tensor([[-0.25, 0, 0, 0, 0]]))
    at = np.stack(np.meshgrid(*(np.arange(side) + 0.5 for side in photo_size)), -1)
    taken = (at - K[:2, 2].numpy()) / focal
    x = taken
    for _ in range(60):
        x = taken / (1 - 0.25 * (x**2).sum(-1, keepdims=True))
    column, row = ((x * size[0] + np.array(size) / 2)[..., i] for i in (0, 1))  # position in the view [px]
    truth = np.zeros(photo_size[::-1], np.int64)
    for number, (x0, y0, x1, y1) in zip((1, 3), boxes, strict=True):
        truth[(column >= x0) & (column < x1) & (row >= y0) & (row < y1)] = number
    write_labels(labelled / "labels/a.b.png", torch.from_numpy(truth))
    write_scene(labelled / "labelled.ply", replace(scene, cameras=replace(scene.cameras, photos=photos)))
    assert evaluate(labelled)["overall"]["IoU"] > 0.94
    straight = replace(photos, distortion=torch.zeros(1, 5))
    write_scene(labelled / "labelled.ply", replace(scene, cameras=replace(scene.cameras, photos=straight)))
    assert evaluate(labelled)["overall"]["IoU"] < 0.8


def test_label_image_of_the_undistorted_view(labelled):
    scene = billboards([picture(a_5=(4, 4, 24, 24))], ["a.b.jpg"], SIZE)
    lens = torch.tensor([[0.3, 0, 0, 0, 0]])
    photos = PhotoIntrinsics(intrinsics(128, 90, 99.0)[None], torch.tensor([[128, 90]]), lens)
    write_scene(labelled / "labelled.ply", replace(scene, cameras=replace(scene.cameras, photos=photos)))
    with pytest.raises(InputError, match="a.b.png: has 64x48 .* but the photo a.b.jpg has 128x90; .* --undistorted"):
        evaluate(labelled)
    assert evaluate(labelled, undistorted=True)["objects"]["duck"]["IoU"] > 0.94


def test_suffixes_have_any_case_and_hidden_files_do_not_count(labelled):
    expected = evaluate(labelled)
    (labelled / "labels/a.b.png").rename(labelled / "labels/a.b.PNG")
    (labelled / "labels/._a.b.PNG").write_text("as macOS writes")
    facts = evaluate(labelled)
    assert facts["objects"] == expected["objects"] and facts["notes"] == expected["notes"]


def test_label_images_may_keep_the_suffix_of_their_photo(labelled):
    expected = evaluate(labelled)
    (labelled / "labels/a.b.png").rename(labelled / "labels/a.b.jpg.png")
    assert evaluate(labelled)["objects"] == expected["objects"]


def test_labels_without_a_name_are_told(labelled):
    (labelled / "labels/names.json").write_text('{"1": "duck"}')
    facts = evaluate(labelled)
    assert "labels that names.json does not name, counted as objects: 2, 3" in facts["notes"]
    assert facts["objects"]["object_2"]["IoU"] > 0.9


def write_colour(path: Path) -> None:
    cv2.imwrite(str(path), np.zeros((*SIZE[::-1], 3), np.uint8))


def write_16_bits(path: Path) -> None:
    cv2.imwrite(str(path), np.ones(SIZE[::-1], np.uint16))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "names.json").unlink(), "labels/names.json: no such file; the names of the labelled objects"),
        (lambda f: (f / "names.json").write_text('["duck"]'), "names.json: is not readable"),
        (lambda f: (f / "names.json").write_text('{"1": {"core": true}}'), "names.json: is not readable"),
        (lambda f: (f / "a.b.png").rename(f / "b.png"), "no label image named like a photo of .*, such as a.b.png"),
        (lambda f: write_colour(f / "a.b.png"), "a.b.png: has 3 channels; a label image has one"),
        (lambda f: write_16_bits(f / "a.b.png"), "a.b.png: has 16 bits per pixel; save the label image with 8"),
        (lambda f: (f / "a.b.png").write_bytes(b"hello"), "a.b.png: is not an image"),
        (lambda f: write_labels(f / "a.b.png", torch.from_numpy(picture(a_255=(0, 0, 64, 48)))),
         "labels: no pixel of the label images is compared: all are 255"),
        (lambda f: write_labels(f / "a.b.png", torch.ones(50, 50, dtype=torch.int64)),
         "a.b.png: has 50x50 pixels, but the view a.b.jpg has 64x48"),
    ],
)  # fmt: skip
def test_malformed_labels_give_one_line_and_write_nothing(labelled, damage, message):
    damage(labelled / "labels")
    with pytest.raises(InputError, match=message) as caught:
        evaluate(labelled)
    assert "\n" not in str(caught.value) and not (labelled / "metrics.json").exists()


def test_other_wrong_inputs(labelled):
    with pytest.raises(InputError, match="--photos x: photos are only shown in a report"):
        EvaluateOptions(photos=Path("x"))
    (labelled / "empty").mkdir()
    with pytest.raises(InputError, match="empty: contains no photo a.b.jpg"):
        evaluate(labelled, report=labelled / "r.html", photos=labelled / "empty")
    with pytest.raises(InputError, match="--align: does not apply to files of kind labels"):
        evaluate(labelled, align=True)
    scene = billboards([picture()], ["a.b.jpg"], SIZE)
    write_scene(labelled / "labelled.ply", replace(scene, cameras=None))
    with pytest.raises(InputError, match="labelled.ply: has no cameras"):
        evaluate(labelled)


def imperfect(labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Object ids of an imperfect scene for these labels: shifted, two merged, one split, one missed, one additional."""
    found = np.roll(np.where(labels == 255, 0, labels), rng.integers(-1, 2, 2), (0, 1)) + 20 * (labels > 0)
    present = [i for i in np.unique(found) if i]
    if len(present) > 3:
        found[found == present[0]] = present[1]
        found[found == present[2]] = 0
    middle = labels.shape[1] // 2
    if present:
        found[:, :middle][found[:, :middle] == present[-1]] = 90
    found[:6, :15] = 91
    return found


@pytest.mark.parametrize("name", [pytest.param("tum_fr2_desk", marks=pytest.mark.slow), "kitchen", "kermit", "banana"])
def test_figures_agree_with_an_independent_scorer(shared, tmp_path, name, capsys, monkeypatch):
    """The scorer is score.py in the folder of the label images; views have the default size of `ngff reconstruct`."""
    folder, rng = shared / "labels" / name, np.random.default_rng(0)
    files = sorted(folder.glob("*.png"))
    labels = [read_labels(file).numpy() for file in files]
    (height, width), shrink = labels[0].shape, 640 / max(labels[0].shape)
    size = (round(width * shrink), round(height * shrink))
    found = [imperfect(x[::8, ::8].copy(), rng) for x in labels]
    write_scene(tmp_path / "labelled.ply", billboards(found, [f"{file.stem}.jpg" for file in files], size))
    facts = run(tmp_path / "labelled.ply", folder, tmp_path / "m.json")
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["score.py", str(tmp_path / "labelled.ply"), str(folder)])
    runpy.run_path(str(shared / "labels/score.py"))
    *lines, last = capsys.readouterr().out.splitlines()
    theirs, ours = json.loads(last), facts["overall"]
    columns = {"photos": "photos", "objects": "objects", "found": "found", "recall50": "recall", "mIoU": "IoU",
               "SQ": "SQ", "PQ": "PQ", "false_objects": "false", "false_share": "false_share"}  # fmt: skip
    assert {k: ours[v] for k, v in columns.items()} == pytest.approx({k: theirs[k] for k in columns}, abs=0.01)
    assert theirs["found"] > 0 and 0.3 < theirs["mIoU"] < 0.95
    listed = {line[4:44].strip(): float(line.rpartition("IoU ")[2]) for line in lines}
    # Values are printed with two digits. If the view is smaller than the label image, score.py samples corners instead
    # of centres of pixels, which is relevant for a few objects of less than 1000 pixels.
    assert {key[:40]: row["IoU"] for key, row in facts["objects"].items()} == pytest.approx(listed, abs=0.02)
