"""Comparison of scenes: Chamfer distance, colour error and IoU of labels."""

from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.similarity import Similarity
from stages.core.scene.scene import SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.scenes import chamfer, label_iou, nearest_neighbours, scene_reference_frame
from stages.evaluate.stage import run
from tests.evaluate.motions import rotation, transformed_scene


def test_chamfer_by_hand():
    mine = torch.tensor([[0.0, 0, 0], [1, 0, 0]])
    true = torch.tensor([[0.0, 0, 3]])
    # distances are 3 and sqrt(10) from prediction to truth, and 3 from truth to prediction
    found = chamfer(nearest_neighbours(mine, true), nearest_neighbours(true, mine))
    there = (3 + 10**0.5) / 2
    assert found == pytest.approx({"chamfer": (there + 3) / 2, "to_truth": there, "to_prediction": 3})


def test_label_iou_by_hand():
    true = torch.tensor([1, 1, 1, 1, 2, 2, 0, 0, 3])
    found = torch.tensor([7, 7, 7, 0, 5, 5, 5, 0, 0])
    # IoU of object 1 is 3/4, of object 2 is 2/3; object 3 is not found
    assert label_iou(found, true) == {1: (7, 0.75), 2: (5, pytest.approx(2 / 3)), 3: (0, 0.0)}


def evaluate(tmp_path, mine, true, **options):
    write_scene(tmp_path / "mine.ply", mine)
    write_scene(tmp_path / "true.ply", true)
    return run(tmp_path / "mine.ply", tmp_path / "true.ply", tmp_path / "m.json", EvaluateOptions(**options))


def test_identical_scenes(tmp_path, two_balls):
    overall = evaluate(tmp_path, two_balls, two_balls)["overall"]
    assert overall == pytest.approx({"chamfer": 0, "to_truth": 0, "to_prediction": 0, "colour": 0, "IoU": 1,
                                     "Gaussians": 1700})  # fmt: skip


def test_transparent_gaussians_are_ignored_and_colour_is_compared(tmp_path, two_balls):
    g = two_balls.gaussians
    opacities, means, sh = g.opacities.clone(), g.means.clone(), g.sh.clone()
    opacities[:100], means[:100] = 0.099, means[:100] + 5.0  # transparent and far away
    opacities[100:200] = 0.101
    sh += 0.1 / 0.28209479177387814  # brighter by 0.1 everywhere
    mine = replace(two_balls, gaussians=replace(g, opacities=opacities, means=means, sh=sh))
    true = replace(two_balls, gaussians=g)
    overall = evaluate(tmp_path, mine, true)["overall"]
    assert overall["Gaussians"] == 1600
    assert overall["to_truth"] == 0 and 0 < overall["to_prediction"] < 0.1
    assert overall["colour"] == pytest.approx(0.1, abs=1e-4)


def test_another_reference_frame_needs_align(tmp_path, two_balls):
    similarity = Similarity(0.3, rotation(1.0), torch.tensor([4.0, 5.0, 6.0]))
    predicted = transformed_scene(two_balls, similarity)
    with pytest.raises(InputError, match="a different frame of reference.*--align"):
        evaluate(tmp_path, predicted, two_balls)
    assert evaluate(tmp_path, predicted, two_balls, align=True)["overall"]["chamfer"] < 1e-5


def test_scenes_without_objects_have_no_overlap_and_alignment_is_noted(tmp_path, two_balls):
    blank = replace(two_balls.gaussians, object_id=torch.zeros_like(two_balls.gaussians.object_id))
    facts = evaluate(tmp_path, replace(two_balls, gaussians=blank, objects=()), two_balls, align=True)
    assert "IoU" not in facts["overall"] and not facts["objects"]
    assert any("aligned by" in note for note in facts["notes"])


def test_scenes_without_a_surface_are_refused(tmp_path, two_balls):
    g = two_balls.gaussians
    faint = replace(two_balls, gaussians=replace(g, opacities=g.opacities * 0 + 0.01))
    with pytest.raises(InputError, match="no Gaussian has an opacity above .* so there is no surface to compare"):
        evaluate(tmp_path, faint, two_balls)


def test_scenes_without_cameras_are_aligned_by_their_objects(tmp_path, two_balls):
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    alone = replace(two_balls, cameras=None, objects=(*two_balls.objects, SceneObject(9, "ghost")))
    moved = replace(transformed_scene(two_balls, Similarity(2.0, quarter, torch.tensor([1.0, 2.0, 0.5]))), cameras=None)
    facts = evaluate(tmp_path, moved, alone, align=True)
    assert facts["overall"]["chamfer"] < 1e-5
    assert "aligned by the centres of red ball, green ball, keeping the vertical" in facts["notes"]
    frame = scene_reference_frame(tmp_path / "s.ply", alone)
    assert [o.id for o in frame.objects] == [1, 2] and frame.cameras is None
    assert torch.equal(frame.points[2], two_balls.gaussians.means[two_balls.gaussians.object_id == 2])


def test_overlap_of_a_single_object(tmp_path, two_balls):
    g = two_balls.gaussians
    one = replace(two_balls, gaussians=replace(g, object_id=g.object_id.clamp(max=1)), objects=two_balls.objects[:1])
    facts = evaluate(tmp_path, one, one)
    assert facts["overall"]["IoU"] == 1 and list(facts["objects"]) == ["red ball"]
