"""The segment stage: geometric and masks backends, voting, and messages."""

import json
import logging
from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import project
from stages.core.perception.voting import ViewFootprint, damp_votes, majority_labels, pool_votes, remove_outliers
from stages.core.raster.rasterise import visibility
from stages.core.scene.images import write_labels
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.segment import masks
from stages.segment.masks import read_names
from stages.segment.options import SegmentOptions
from stages.segment.stage import log_objects, run
from stages.segment.view_images import MAX_RENDER_SIDE, render_view
from tests.conftest import random_gaussians
from tests.segment.tabletop import best_overlap

pytestmark = pytest.mark.usefixtures("device")


def true_masks(scene):
    """A label image for each camera, with the object that each pixel shows."""
    masks = []
    for viewmat, K, size in zip(scene.cameras.viewmats, scene.cameras.Ks, scene.cameras.sizes, strict=True):
        index = visibility(scene.gaussians, viewmat, K, *size.tolist()).index
        masks.append(torch.where(index >= 0, scene.gaussians.object_id[index.clamp_min(0)], 0))
    return masks


def write_masks(folder, scene, masks):
    folder.mkdir()
    for name, mask in zip(scene.cameras.names, masks, strict=True):
        write_labels(folder / name.replace(".jpg", ".png"), mask)
    return folder


def test_geometric_writes_labels_names_cameras_and_provenance(scene_file, truth, tmp_path, caplog):
    out = tmp_path / "labelled.ply"
    with caplog.at_level(logging.INFO):
        run(scene_file, out, SegmentOptions(backend="geometric", names="1=tower of jelly"))
    labelled = read_scene(out)
    assert min(best_overlap(labelled.gaussians.object_id, truth.gaussians.object_id).values()) >= 0.9
    assert labelled.objects[0].name == "tower of jelly"
    assert len(labelled.cameras) == len(truth.cameras)
    assert labelled.provenance["command"] == "segment"
    counts = labelled.gaussians.object_id.bincount().tolist()
    assert all(f"{o.id}  {o.name}: {counts[o.id]} Gaussians, " in caplog.text for o in labelled.objects)


@pytest.mark.parametrize(("source", "size"), [
    ("--scale-reference distance=0.5", "6.0 x 8.0 x 10.0 cm"),
    ("assumed: cameras about 1 m away", "0.12 x 0.16 x 0.2 scene units"),
    ("not stated in the file", "0.12 x 0.16 x 0.2 scene units"),
])  # fmt: skip
def test_sizes_are_in_cm_only_where_the_scale_is_known(source, size, caplog):
    sides = torch.tensor([0.12, 0.16, 0.2]) / 0.98  # sizes are between the 1 % and the 99 % quantile
    means = torch.linspace(0, 1, 101)[:, None] * sides
    g = replace(random_gaussians(101), means=means, object_id=torch.ones(101, dtype=torch.int64))
    with caplog.at_level(logging.INFO):
        log_objects(Scene(g, (SceneObject(1, "cup"),), scale={"metres_per_unit": 0.5, "source": source}))
    assert caplog.messages == [f"  1  cup: 101 Gaussians, {size}"]


@pytest.mark.parametrize(("side", "axes"), [("height", [2]), ("length", [0, 1, 2])])
def test_scale_reference_sets_metres_per_unit(scene_file, truth, tmp_path, side, axes):
    masks = write_masks(tmp_path / "masks", truth, true_masks(truth))
    run(scene_file, tmp_path / "out.ply", SegmentOptions(masks=masks, scale_reference=f"object=2 {side}=0.6"))
    means = truth.gaussians.means[truth.gaussians.object_id == 2][:, axes]
    units = float((means.amax(0) - means.amin(0)).max())
    assert read_scene(tmp_path / "out.ply").metres_per_unit == pytest.approx(0.6 / units, rel=0.05)


def test_wrong_pixels_of_masks_are_outvoted(scene_file, truth, tmp_path):
    rng = torch.Generator().manual_seed(0)
    masks = true_masks(truth)
    for mask in masks:  # 10 % of the pixels are random
        wrong = torch.rand(mask.shape, generator=rng) < 0.1
        mask[wrong] = torch.randint(0, 4, (int(wrong.sum()),), generator=rng)
    masks[2] = masks[2].roll(25, 1)  # and one image is shifted
    folder = write_masks(tmp_path / "masks", truth, masks)
    (folder / "names.json").write_text(json.dumps({"1": "duck", "3": "tower"}))
    run(scene_file, tmp_path / "out.ply", SegmentOptions(masks=folder))
    labelled = read_scene(tmp_path / "out.ply")
    assert [o.name for o in labelled.objects] == ["duck", "object_2", "tower"]
    for i in (1, 2, 3):
        mine, theirs = labelled.gaussians.object_id == i, truth.gaussians.object_id == i
        assert float((mine & theirs).sum() / (mine | theirs).sum()) >= 0.9


def test_labels_may_be_any_numbers_but_not_more_than_a_thousand(scene_file, truth, tmp_path):
    folder = write_masks(tmp_path / "masks", truth, [torch.tensor([0, 900, 7, 65535])[m] for m in true_masks(truth)])
    (folder / "names.json").write_text(json.dumps({"7": "duck"}))
    run(scene_file, tmp_path / "out.ply", SegmentOptions(masks=folder))
    labelled = read_scene(tmp_path / "out.ply")
    assert {o.id: o.name for o in labelled.objects} == {7: "duck", 900: "object_900", 65535: "object_65535"}
    for i, number in enumerate((900, 7, 65535), start=1):
        mine, theirs = labelled.gaussians.object_id == number, truth.gaussians.object_id == i
        assert float((mine & theirs).sum() / (mine | theirs).sum()) >= 0.9
    noise = [torch.arange(m.numel()).reshape(m.shape) % 1500 for m in true_masks(truth)]
    folder = write_masks(tmp_path / "noise", truth, noise)
    with pytest.raises(InputError, match="more than 1000 different numbers"):
        run(scene_file, tmp_path / "out.ply", SegmentOptions(masks=folder))


@pytest.mark.parametrize(("names", "ids"), [({"1": "duck"}, [1, 3]), ({"255": "duck"}, [1, 3, 255]), ({}, [1, 3, 255])])
def test_255_is_ignored_where_names_do_not_have_it(scene_file, truth, tmp_path, caplog, names, ids):
    caplog.set_level(logging.INFO)
    folder = write_masks(tmp_path / "masks", truth, [torch.tensor([0, 1, 255, 3])[m] for m in true_masks(truth)])
    (folder / "names.json").write_text(json.dumps(names))
    run(scene_file, tmp_path / "out.ply", SegmentOptions(masks=folder))
    labelled = read_scene(tmp_path / "out.ply")
    assert f"out.ply: {len(ids)} objects" in caplog.text
    assert [o.id for o in labelled.objects] == ids == labelled.gaussians.object_id.unique().tolist()[1:]


@pytest.mark.parametrize("names", ['{"1": "a", "01": "b"}', '{"1_0": "a"}', '{"\u0661": "a"}', '{"-1": "a"}'])
def test_labels_of_names_are_plain_numbers_each_once(tmp_path, names):
    (tmp_path / "names.json").write_text(names)
    with pytest.raises(InputError, match="names.json: is not readable"):
        read_names(tmp_path)


def test_names_of_labelled_photos_are_read_too(tmp_path):
    """The names.json for `ngff evaluate --against LABELS/` contains further fields."""
    (tmp_path / "names.json").write_text(json.dumps({"1": {"name": "duck", "core": True}, "4": "tower"}))
    assert read_names(tmp_path) == {1: "duck", 4: "tower"}


def test_permuted_labels_of_one_mask_are_outvoted(scene_file, truth, tmp_path):
    masks = true_masks(truth)
    masks[3] = torch.tensor([0, 2, 3, 1])[masks[3]]  # one image is numbered in a different order
    some = [1, 3, 5, 6, 7]
    folder = write_masks(tmp_path / "masks", replace(truth, cameras=truth.cameras[some]), [masks[i] for i in some])
    run(scene_file, tmp_path / "out.ply", SegmentOptions(masks=folder))
    found = read_scene(tmp_path / "out.ply").gaussians.object_id
    for i in (1, 2, 3):
        mine, theirs = found == i, truth.gaussians.object_id == i
        assert float((mine & theirs).sum() / (mine | theirs).sum()) >= 0.9


def test_ties_take_the_label_of_neighbours(truth):
    votes = torch.nn.functional.one_hot(truth.gaussians.object_id, 4).float()
    tied = torch.nonzero(truth.gaussians.object_id == 2)[::7, 0]
    votes[tied] = 1.0
    unseen = torch.nonzero(truth.gaussians.object_id == 3)[::7, 0]
    votes[unseen] = 0.0
    ids = majority_labels(truth, votes)
    assert float((ids == truth.gaussians.object_id).float().mean()) > 0.995


def test_non_finite_gaussians_stay_background(truth):
    votes = torch.nn.functional.one_hot(truth.gaussians.object_id, 4).float()
    means = truth.gaussians.means.clone()
    lost = torch.nonzero(truth.gaussians.object_id == 2)[:3, 0]
    means[lost], votes[lost] = torch.nan, 0.0
    nowhere = replace(truth, gaussians=replace(truth.gaussians, means=means))
    ids = majority_labels(nowhere, pool_votes(means, votes))
    assert (ids[lost] == 0).all() and float((ids == truth.gaussians.object_id).float().mean()) > 0.99


def test_one_close_view_does_not_outvote_two_distant_ones():
    near, far = torch.tensor([[0.0, 90.0, 0.0]]), torch.tensor([[0.0, 0.0, 30.0]])
    assert int((near + 2 * far).argmax(1)) == 1  # the sums of pixels would give this label
    assert int((damp_votes(near) + 2 * damp_votes(far)).argmax(1)) == 2  # votes of 9.5 and 11.0
    torch.testing.assert_close(damp_votes(torch.tensor([[1.0, 3.0]])), torch.tensor([[0.5, 1.5]]))
    assert damp_votes(torch.zeros(1, 3)).tolist() == [[0.0, 0.0, 0.0]]


def test_votes_are_pooled_among_close_neighbours():
    x = torch.cat([torch.arange(9.0), 100 + torch.arange(9.0)])
    votes = torch.zeros(18, 2)
    votes[:9, 0], votes[9:, 1] = 1.0, 1.0
    votes[4] = torch.tensor([0.0, 3.0])  # noise
    out = pool_votes(torch.stack([x, torch.zeros(18), torch.zeros(18)], 1), votes)
    assert out[4].tolist() == [8.0, 3.0] and out[13].tolist() == [0.0, 9.0]
    alone = pool_votes(torch.stack([x, torch.zeros(18), torch.zeros(18)], 1)[:10], votes[:10])
    assert alone[9].tolist() == [0.0, 1.0]  # its nearest neighbours are too far away


def test_outliers_by_the_modified_z_score():
    # distances from the median are 1, 2, 3, 4, 100; median 3 and MAD 1, so 0.6745 * 97 > 3.5 but 0.6745 * 1 is not
    x = torch.tensor([0.0, -1, 1, -2, 2, -3, 3, -4, 4, 100])
    means = torch.stack([x, torch.zeros(10), torch.zeros(10)], 1)
    ids = remove_outliers(means, torch.ones(10, dtype=torch.int64))
    assert ids.tolist() == [1] * 9 + [0]


def test_boxes_give_named_objects(scene_file, truth, tmp_path):
    rows = []
    for i in (2, 1):
        pixel = project(truth.gaussians.means[truth.gaussians.object_id == i], truth.cameras.viewmats[0],
                        truth.cameras.Ks[0])  # fmt: skip
        rows.append([*pixel.amin(0).tolist(), *pixel.amax(0).tolist()])
    prompts = tmp_path / "prompts.json"
    prompts.write_text(json.dumps({"bbox": rows, "text": ["a blue egg", "a red block"], "center_point": []}))
    run(scene_file, tmp_path / "out.ply", SegmentOptions(boxes=prompts))
    labelled = read_scene(tmp_path / "out.ply")
    assert [(o.id, o.name) for o in labelled.objects] == [(1, "a blue egg"), (2, "a red block")]
    for found, true in ((1, 2), (2, 1)):
        mine, theirs = labelled.gaussians.object_id == found, truth.gaussians.object_id == true
        assert float((mine & theirs).sum() / (mine | theirs).sum()) >= 0.9


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (lambda p: {"masks": p / "nowhere"}, "is not a folder"),
        (lambda p: (p / "m").mkdir() or {"masks": p / "m"}, "contains no label image named like a photo"),
        (lambda p: {"boxes": p / "nowhere.json"}, "no such file"),
        (lambda p: (p / "b.json").write_text("{}") and {"boxes": p / "b.json"}, "is not a prompts file"),
        (lambda p: (p / "b.json").write_text('{"bbox": [[5, 5, 1, 1]], "text": ["x"]}') and {"boxes": p / "b.json"},
         "has no area"),
        (lambda p: {"names": "9=duck", "backend": "geometric"}, "there is no object 9"),
        (lambda p: {"scale_reference": "object=9 height=0.1", "backend": "geometric"}, "there is no object 9"),
    ],
)  # fmt: skip
def test_invalid_inputs_are_refused_and_nothing_is_written(scene_file, tmp_path, prepare, message):
    with pytest.raises(InputError, match=message):
        run(scene_file, tmp_path / "out.ply", SegmentOptions(**prepare(tmp_path)))
    assert not (tmp_path / "out.ply").exists()


def test_masks_of_another_aspect_ratio_are_refused(scene_file, truth, tmp_path):
    folder = write_masks(tmp_path / "masks", truth, [torch.ones(80, 160, dtype=torch.int64)] * len(truth.cameras))
    with pytest.raises(InputError, match="aspect ratio"):
        run(scene_file, tmp_path / "out.ply", SegmentOptions(masks=folder))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"names": "duck"}, "NUMBER=NAME"), ({"names": "1=duck,01=bowl"}, "object 1 occurs twice"),
     ({"scale_reference": "duck=0.1"}, "object=1 height=0.12"),
     ({"scale_reference": "object=1 height=0"}, "more than 0"), ({"max_objects": 0}, "max-objects"),
     ({"min_size": 2.0}, "min-size"), ({"detail": 0.0}, "detail"), ({"masks": "a", "boxes": "b"}, "one of them"),
     ({"backend": "sam2", "masks": "a"}, "generates masks itself"),
     ({"backend": "geometric", "weights": "a"}, "with --backend sam2")],
)  # fmt: skip
def test_invalid_options_are_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        SegmentOptions(**wrong)


def test_masks_need_cameras_and_objects_without_gaussians_are_logged(truth, tmp_path, caplog):
    with pytest.raises(InputError, match="--masks: the scene has no cameras; give a scene .* `ngff reconstruct`"):
        masks.segment(replace(truth, cameras=None), SegmentOptions(masks=tmp_path))
    caplog.set_level(logging.INFO)
    log_objects(replace(truth, objects=(*truth.objects, SceneObject(9, "ghost"))))
    assert "  9  ghost: no Gaussians" in caplog.text


def test_empty_table_has_no_objects(truth, tmp_path, caplog):
    bare = replace(truth, gaussians=truth.gaussians[truth.gaussians.object_id == 0])
    write_scene(tmp_path / "bare.ply", bare)
    run(tmp_path / "bare.ply", tmp_path / "out.ply", SegmentOptions(backend="geometric"))
    assert read_scene(tmp_path / "out.ply").objects == ()
    assert "no objects were found" in caplog.text


def test_votes_of_pixels_and_of_centres_on_the_surface():
    """Gaussian 0 is in front in one pixel; Gaussians 1 and 2 lie on the surface with weights of 2 and 0."""
    front = torch.tensor([[0, -1], [-1, -1]])
    on, pixels, weights = torch.tensor([1, 2]), torch.tensor([3, 3]), torch.tensor([2.0, 0.0])
    footprint = ViewFootprint(front, on, pixels, weights, 4, torch.zeros(2, 2, 3))
    votes = footprint.votes(torch.tensor([[1, 0], [0, 2]]).repeat_interleave(3, 0).repeat_interleave(3, 1))
    expected = torch.tensor([[0, 1, 0], [0, 0, 2.001], [0, 0, 0.001], [0, 0, 0]])
    torch.testing.assert_close(votes, expected)


def test_large_views_are_rendered_smaller(two_balls):
    side = 2 * MAX_RENDER_SIDE
    cameras = two_balls.cameras[[0]]
    wide = replace(two_balls, cameras=replace(cameras, sizes=torch.tensor([[side, 16]])))
    assert render_view(wide, 0).shape == (8, MAX_RENDER_SIDE, 3)
