"""The boxes backend, and its prompts."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import project
from stages.core.perception.grabcut import clean_mask
from stages.core.perception.voting import ViewFootprint
from stages.core.scene.scene import Scene
from stages.segment import boxes, prompted
from stages.segment.boxes import MAX_VIEWS, nearest_first, segment, segment_prompted_view
from stages.segment.options import SegmentOptions
from stages.segment.prompts import read_prompts
from tests.conftest import random_gaussians
from tests.segment.tabletop import WOOD, block, egg, orbit_cameras, scene_of, table_gaussians, three_apart

NOTHING = np.zeros((8, 16), np.int64)  # empty labels of a view


def prompts_of(path, scene, numbers, grow=1.0):
    """Write a file with a box around each of these objects in the first view, and return options that use it."""
    rows = []
    for i in numbers:
        pixel = project(scene.gaussians.means[scene.gaussians.object_id == i], scene.cameras.viewmats[0],
                        scene.cameras.Ks[0])  # fmt: skip
        rows.append([*(pixel.amin(0) - grow).tolist(), *(pixel.amax(0) + grow).tolist()])
    path.write_text(json.dumps({"bbox": rows, "text": [f"thing {i}" for i in numbers]}))
    return SegmentOptions(boxes=path)


def blank(scene):
    return replace(scene, gaussians=replace(scene.gaussians, object_id=torch.zeros_like(scene.gaussians.object_id)))


def overlap(found, scene, mine, theirs):
    a, b = found.gaussians.object_id == mine, scene.gaussians.object_id == theirs
    return float((a & b).sum() / (a | b).sum())


def test_object_leaning_on_background_is_segmented(tmp_path):
    """A green doll of two eggs leans on a white cushion that has no box."""
    cushion = block((0.0, 0.16), (0.4, 0.12, 0.25), (0.85, 0.85, 0.8), 2)
    trunk = egg((0.0, 0.03, 0.08), (0.07, 0.07, 0.08), (0.15, 0.6, 0.1), 1)
    head = egg((0.0, 0.03, 0.2), (0.05, 0.05, 0.05), (0.15, 0.65, 0.15), 1)
    scene = scene_of(table_gaussians(), cushion, trunk, head, noise=0.001)
    scene = replace(scene, cameras=scene.cameras[[6, 7, 5, 4, 0]])  # the doll is visible in the first view
    found = segment(blank(scene), prompts_of(tmp_path / "p.json", scene, [1]))
    assert [(o.id, o.name) for o in found.objects] == [(1, "thing 1")]
    assert overlap(found, scene, 1, 1) > 0.85


def test_overlapping_boxes_are_separated(tmp_path):
    far = block((0.0, 0.05), (0.25, 0.05, 0.2), (0.8, 0.1, 0.1), 1)
    scene = scene_of(table_gaussians(), far, block((0.0, -0.08), (0.1, 0.05, 0.08), (0.1, 0.2, 0.8), 2))
    scene = replace(scene, cameras=scene.cameras[[6, 7, 5, 0, 4, 1, 3, 2]])
    found = segment(blank(scene), prompts_of(tmp_path / "p.json", scene, [1, 2]))
    assert overlap(found, scene, 1, 1) > 0.85 and overlap(found, scene, 2, 2) > 0.85


def test_object_of_the_background_colour_is_reported_as_missing(tmp_path, caplog):
    """A block with the colour of the table."""
    scene = scene_of(table_gaussians(), block((0.0, 0.0), (0.1, 0.1, 0.1), WOOD, 1))
    found = segment(blank(scene), prompts_of(tmp_path / "p.json", scene, [1]))
    assert found.objects == () and "no Gaussian was assigned" in caplog.text


def test_views_are_ordered_by_distance_and_limited():
    scene = three_apart()
    order = nearest_first(scene)
    assert order[0] == 0 and sorted(order) == list(range(8)) and {order[1], order[2]} == {1, 7} and order[-1] == 4
    many = nearest_first(replace(scene, cameras=orbit_cameras(100)))
    assert len(many) == len(set(many)) == MAX_VIEWS and many[0] == 0 and 50 in many


def test_box_of_the_whole_image_labels_all_of_it():
    picture = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    assert (segment_prompted_view(picture, torch.tensor([[0.0, 0.0, 1.0, 1.0]]), 0) == 1).all()


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_where_boxes_overlap_the_smaller_is_on_top(order, monkeypatch):
    """The replaced segmentation fills each box with its object."""
    monkeypatch.setattr(boxes, "grabcut", lambda image, unlikely, likely, sure, seed: unlikely | likely)
    picture = np.random.default_rng(0).integers(0, 255, (40, 40, 3), dtype=np.uint8)
    wide, tall = [0.0, 0.0, 1.0, 0.5], [0.6, 0.0, 1.0, 1.0]  # areas of 0.5 and 0.4
    labels = segment_prompted_view(picture, torch.tensor([[wide, tall][i] for i in order]), 0)
    assert (labels[:, 24:] == order.index(1) + 1).all() and (labels[:20, :24] == order.index(0) + 1).all()


@pytest.mark.parametrize("turns", range(4))
def test_what_continues_beside_a_box_on_any_side_is_not_likely(turns, monkeypatch):
    """A stripe of the background extends into the box from one side, beside an object of a different colour."""
    likely = []
    monkeypatch.setattr(boxes, "grabcut", lambda image, unlikely, mask, *_: likely.append(mask) or mask)
    picture = np.full((80, 80, 3), 40, np.uint8)
    picture[24:56, 24:56] = (200, 40, 40)
    picture[36:44, 50:] = (40, 40, 200)
    segment_prompted_view(np.rot90(picture, turns).copy(), torch.tensor([[0.3, 0.3, 0.7, 0.7]]), 0)
    found = np.rot90(likely[0], -turns)
    assert found[26:54, 26:48].all() and not found[37:43, 51:56].any()


def test_boxes_are_in_pixels_of_the_first_view(tmp_path, monkeypatch):
    """The other views have different sizes."""
    cameras = orbit_cameras(2)
    cameras = replace(cameras, sizes=torch.tensor([[160, 80], [40, 30]]))
    (tmp_path / "p.json").write_text('{"bbox": [[16, 8, 80, 40]]}')
    fractions = []
    monkeypatch.setattr(boxes, "segment_prompted_view", lambda image, box, seed: fractions.append(box) or NOTHING)
    monkeypatch.setattr(boxes, "segment_next_view", lambda image, footprint, votes, seed: NOTHING)
    segment(Scene(random_gaussians(5), cameras=cameras), SegmentOptions(boxes=tmp_path / "p.json"))
    torch.testing.assert_close(fractions, [torch.tensor([[0.1, 0.1, 0.5, 0.5]])])


@pytest.mark.parametrize("first", [0, 1])
def test_another_view_starts_from_the_labels_of_its_front_most_gaussians(first, monkeypatch):
    """One of the two Gaussians is of the object and one of the background; the sky has none."""
    monkeypatch.setattr(boxes, "grabcut", lambda image, unlikely, likely, sure, seed: sure)
    front = torch.full((30, 40), -1, dtype=torch.int32)
    front[10:, :20], front[10:, 20:] = first, 1 - first
    none = torch.zeros(0, dtype=torch.int64)
    footprint = ViewFootprint(front, none, none, torch.zeros(0), 2, torch.zeros(30, 40, 3))
    votes = torch.tensor([[5.0, 0.0], [5.0, 0.0]])
    votes[first] = torch.tensor([0.0, 3.0])
    labels = boxes.segment_next_view(np.zeros((30, 40, 3), np.uint8), footprint, votes, 0)
    assert (labels[12:, :18] == 1).all() and not labels[:10].any() and not labels[:, 20:].any()


def test_small_pieces_and_small_holes_are_removed():
    mask = np.zeros((40, 40), dtype=bool)
    mask[5:35, 5:35] = True
    mask[20, 20:22], mask[8:16, 8:16], mask[1, 1] = False, False, True
    clean = clean_mask(mask)
    assert clean[20, 20] and not clean[10, 10] and not clean[1, 1]


@pytest.mark.parametrize(
    ("text", "message"),
    [('{"bbox": [[200, 10, 300, 50]], "text": ["duck"]}', "of duck is outside the first view, which has 160x160"),
     ('{"center_point": [[5, 5]], "text": ["duck"]}', "points only work with --backend sam2"),
     ('{"bbox": [[20, 10, 20, 50]], "text": ["duck"]}', "a box has no area")],
)  # fmt: skip
def test_invalid_boxes_are_refused(tmp_path, text, message):
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(InputError, match=message):
        segment(three_apart(), SegmentOptions(boxes=tmp_path / "p.json"))


def test_box_coordinates_are_scaled_from_their_image_size(tmp_path):
    (tmp_path / "p.json").write_text('{"bbox": [[100, 50, 300, 200]], "center_point": [[40, 20]], "size": [1600, 800]}')
    cameras = replace(orbit_cameras(1), sizes=torch.tensor([[160, 80]]))
    prompts = read_prompts(tmp_path / "p.json", cameras)
    assert prompts.boxes.tolist() == [[10, 5, 30, 20]] and prompts.points.tolist() == [[4, 2]]
    (tmp_path / "p.json").write_text('{"bbox": [[100, 50, 300, 200]], "size": [1600]}')
    with pytest.raises(InputError, match="is not a prompts file"):
        read_prompts(tmp_path / "p.json", cameras)
    (tmp_path / "p.json").write_text('{"bbox": [[100, 50, 300, 200]], "size": [1600, 1600]}')
    with pytest.raises(InputError, match="p.json: size of 00.jpg is 1600x1600 pixels, but 160x80 in the scene"):
        read_prompts(tmp_path / "p.json", cameras)


@pytest.mark.parametrize("backend", ["boxes", "network"])
@pytest.mark.parametrize("cameras", [None, orbit_cameras(1)[[]]], ids=["none", "empty"])
def test_scene_without_cameras_is_refused(tmp_path, backend, cameras):
    (tmp_path / "p.json").write_text('{"bbox": [[1, 1, 5, 5]]}')
    options, scene = SegmentOptions(boxes=tmp_path / "p.json"), Scene(random_gaussians(5), cameras=cameras)
    with pytest.raises(InputError, match="has no cameras"):
        segment(scene, options) if backend == "boxes" else prompted.segment(scene, replace(options, backend="sam2"))


def test_ratio_of_colours_is_that_of_their_frequencies():
    """For a red and a blue half: frequencies of colours count, not numbers of pixels."""
    image = np.zeros((40, 80, 3), np.uint8)
    image[:, :40, 0], image[:, 40:, 2] = 255, 255
    inside, around = np.zeros((2, 40, 80), bool)
    inside[:, :30], around[:, 50:] = True, True
    ratio = boxes.colour_likelihood_ratio(image, inside, around)
    assert ratio[20, 10] > 100 and ratio[20, 70] < 0.01
    inside[:], around[:] = False, False
    inside[:30, :30] = inside[:30, 50:] = around[30:33, :30] = around[30:33, 50:] = True  # ten times as many pixels
    np.testing.assert_allclose(boxes.colour_likelihood_ratio(image, inside, around)[:, [10, 70]], 1, atol=0.01)
    around[30:33, 50:] = False
    ratio = boxes.colour_likelihood_ratio(image, inside, around)
    np.testing.assert_allclose(ratio[:, 10], 0.5, atol=0.01)
    assert (boxes.colour_likelihood_ratio(image, np.zeros_like(inside), around) == 0).all()
