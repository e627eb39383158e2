"""Comparison of trajectories: matching, alignment and resampling."""

import json
from contextlib import nullcontext
from dataclasses import replace

import h5py
import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.similarity import Similarity
from stages.core.scene.scene import SceneObject
from stages.evaluate.align import ReferenceFrame, check_same_reference_frame, find_alignment
from stages.evaluate.label_pictures import draw_objects, found_objects
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Result
from stages.evaluate.stage import run
from stages.evaluate.trajectories import compare, transfer_motion
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import with_recorded
from tests.conftest import ring
from tests.evaluate.motions import renamed, rotation, transformed_scene, write_motion


def evaluate(tmp_path, **options):
    return run(tmp_path / "mine.h5", tmp_path / "true.h5", tmp_path / "metrics.json", EvaluateOptions(**options))


def test_identical_trajectories(tmp_path, two_balls, capsys):
    write_motion(tmp_path / "mine.h5", two_balls)
    write_motion(tmp_path / "true.h5", two_balls)
    facts = evaluate(tmp_path)
    assert facts == json.loads((tmp_path / "metrics.json").read_text())
    assert list(facts["objects"]) == ["red ball", "green ball"]
    for row in (facts["overall"], *facts["objects"].values()):
        assert (row["MSE"], row["RMSE"], row["PCE"], row["FPE"]) == (0, 0, 0, 0)
        assert row["R"] == pytest.approx(1) and row["R_pooled"] == pytest.approx(1)
    assert facts["per_frame"]["red ball"] == [0] * 12
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split()[:4] == ["MSE", "RMSE", "PCE", "FPE"] and printed[-1].startswith("all")


def test_offset_of_one_object_affects_its_row_only(tmp_path, two_balls):
    write_motion(tmp_path / "true.h5", two_balls)
    shift = torch.zeros(200, 3)
    shift[100:, 2] = 0.3  # shifts the green ball up
    write_motion(tmp_path / "mine.h5", two_balls, change=lambda positions: positions + shift)
    facts = evaluate(tmp_path)
    assert facts["objects"]["red ball"]["FPE"] == 0
    assert facts["objects"]["green ball"]["FPE"] == pytest.approx(0.3, abs=1e-6)
    assert facts["objects"]["green ball"]["RMSE"] == pytest.approx(0.3 / 3**0.5, abs=1e-6)
    assert facts["overall"]["FPE"] == pytest.approx(0.15, abs=1e-6)
    assert facts["overall"]["MSE"] == pytest.approx(0.3**2 / 6, abs=1e-6)


def test_frames_that_the_truth_has_lost_do_not_count(tmp_path, two_balls):
    wrong = iter(range(12))
    write_motion(tmp_path / "mine.h5", two_balls)
    write_motion(tmp_path / "true.h5", two_balls, change=lambda x: x + (0.5 if next(wrong) > 8 else 0.0))
    with h5py.File(tmp_path / "true.h5", "r+") as file:
        confidence = torch.ones(12, 2)
        confidence[9:, 1] = 0
        file["objects/confidence"] = confidence.numpy()
    facts = evaluate(tmp_path)
    assert facts["objects"]["green ball"]["RMSE"] == facts["objects"]["green ball"]["FPE"] == 0
    assert facts["objects"]["red ball"]["FPE"] == pytest.approx(0.5 * 3**0.5, abs=1e-5)
    assert "the truth lost green ball in 3 of 12 frames, which do not count" in facts["notes"]


def test_different_keypoints_with_the_same_motion_agree(tmp_path, two_balls):
    # skinning reproduces rigid motion exactly for any keypoints, so only rounding errors remain
    write_motion(tmp_path / "true.h5", two_balls, seed=0, count=100)
    write_motion(tmp_path / "mine.h5", two_balls, seed=1, count=60)
    facts = evaluate(tmp_path)
    assert facts["overall"]["FPE"] < 1e-4 and facts["overall"]["R"] > 0.9999
    assert any("different keypoints for red ball, green ball" in note for note in facts["notes"])


def test_transferred_points_keep_their_offset():
    rest = torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    points = rest[:20] + 0.05
    R, shift = rotation(0.8), torch.tensor([1.0, 2.0, 3.0])
    frames = transfer_motion(points, rest, torch.stack([rest, rest @ R.mT + shift]))
    assert torch.equal(frames[0], points)
    torch.testing.assert_close(frames[1], points @ R.mT + shift, atol=1e-4, rtol=0)


def test_objects_are_matched_by_id_or_by_centre(tmp_path, two_balls):
    write_motion(tmp_path / "true.h5", two_balls)
    write_motion(tmp_path / "mine.h5", renamed(two_balls, ["a", "b"]))
    facts = evaluate(tmp_path)
    assert facts["overall"]["FPE"] == 0 and any("by id" in note for note in facts["notes"])
    g = two_balls.gaussians
    swapped = replace(g, object_id=torch.tensor([0, 2, 1])[g.object_id])
    other = renamed(replace(two_balls, gaussians=swapped), ["a", "b"])
    write_motion(tmp_path / "mine.h5", other, count=400, spin=0.0, speed=0.0)
    facts = evaluate(tmp_path)
    assert any("nearest centre" in note and "b = red ball" in note for note in facts["notes"])


def test_objects_are_matched_by_their_centres_after_the_alignment(tmp_path, two_balls):
    """The prediction is rotated by 180 degrees and has different names and numbers."""
    half = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    g, still = two_balls.gaussians, {"frames": 2, "spin": 0.0, "speed": 0.0}
    other = renamed(replace(two_balls, gaussians=replace(g, object_id=torch.tensor([0, 2, 1])[g.object_id])), "ab")
    write_motion(tmp_path / "true.h5", two_balls, **still)
    write_motion(tmp_path / "mine.h5", transformed_scene(other, Similarity(2.0, half, torch.zeros(3))), **still)
    facts = evaluate(tmp_path, align=True)
    assert any("nearest centre" in note and "b = red ball" in note for note in facts["notes"])
    assert facts["overall"]["FPE"] < 0.05


@pytest.mark.parametrize("cameras", [True, False], ids=["cameras", "objects"])
def test_align_inverts_a_similarity(tmp_path, two_balls, cameras):
    # a rotation about the vertical, the only one that two objects determine; cameras would determine any
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    away = Similarity(2.5, quarter, torch.tensor([3.0, -1.0, 0.5]))
    scene = two_balls if cameras else replace(two_balls, cameras=None)
    write_motion(tmp_path / "true.h5", scene)
    far = transformed_scene(two_balls, away)
    far = far if cameras else replace(far, cameras=None)
    mine = write_motion(tmp_path / "mine.h5", far)  # its motion is replaced by the transformed true motion
    with h5py.File(tmp_path / "true.h5") as true, h5py.File(mine, "a") as file:
        file["keypoints/positions"][...] = away(torch.from_numpy(true["keypoints/positions"][()])).numpy()
    with pytest.raises(InputError, match="--align"):
        evaluate(tmp_path)
    facts = evaluate(tmp_path, align=True)
    assert facts["overall"]["RMSE"] < 1e-5
    assert any(("cameras" if cameras else "centres") in note for note in facts["notes"])


def test_collinear_cameras_determine_the_rotation_about_their_line(two_balls):
    line = two_balls.cameras[[0, 0, 0]]
    viewmats = line.viewmats.clone()
    viewmats[:, 0, 3] += torch.tensor([0.0, 0.5, 1.0])
    line = replace(line, viewmats=viewmats, names=("a.jpg", "b.jpg", "c.jpg"))
    away = Similarity(0.4, rotation(2.0), torch.tensor([1.0, 2.0, 3.0]))
    found, _ = find_alignment(ReferenceFrame("a", line.transformed(away), (), {}), ReferenceFrame("b", line, (), {}))
    points = torch.randn(10, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(found(away(points)), points, atol=1e-4, rtol=0)


def test_different_lengths_and_rates_need_an_option(tmp_path, two_balls):
    write_motion(tmp_path / "true.h5", two_balls, frames=12)
    write_motion(tmp_path / "mine.h5", two_balls, frames=9)
    with pytest.raises(InputError, match="9 frames, but .* has 12; give --frames 9"):
        evaluate(tmp_path)
    facts = evaluate(tmp_path, frames=9)
    assert facts["overall"]["frames"] == 9 and facts["overall"]["MSE"] == 0
    with pytest.raises(InputError, match="--frames 10: .* give 9 or fewer"):
        evaluate(tmp_path, frames=10)
    write_motion(tmp_path / "mine.h5", two_balls, frames=23, dt=0.01, spin=0.0, speed=0.015)
    write_motion(tmp_path / "true.h5", two_balls, frames=12, dt=0.02, spin=0.0, speed=0.03)
    with pytest.raises(InputError, match="100 frames per second, but .* has 50; give --resample"):
        evaluate(tmp_path)
    facts = evaluate(tmp_path, resample=True)
    assert facts["overall"]["frames"] == 12
    assert facts["overall"]["FPE"] == pytest.approx(0.11, abs=1e-6)  # both fall by 0.01 per frame, in 22 and 11 frames


@pytest.mark.parametrize(("dt", "same"), [(0.0200019, True), (0.020003, False), (0.019997, False)])
def test_rates_that_differ_by_a_ten_thousandth_are_the_same(tmp_path, two_balls, dt, same):
    write_motion(tmp_path / "true.h5", two_balls, frames=3)
    write_motion(tmp_path / "mine.h5", two_balls, frames=3, dt=dt)
    if same:
        assert evaluate(tmp_path)["overall"]["MSE"] == 0
    else:
        with pytest.raises(InputError, match="give --resample"):
            evaluate(tmp_path)


def test_resampling_takes_the_nearest_frames_before_and_after(tmp_path, two_balls):
    """For accelerated motion, the prediction is exact where its frames have the time, and else a mean of two frames."""

    def accelerated(dt: float, count: int):
        frames = iter(range(count))
        return lambda x: x + (next(frames) * dt) ** 2

    still = {"spin": 0.0, "speed": 0.0}
    write_motion(tmp_path / "mine.h5", two_balls, frames=7, dt=0.02, change=accelerated(0.02, 7), **still)
    write_motion(tmp_path / "true.h5", two_balls, frames=5, dt=0.03, change=accelerated(0.03, 5), **still)
    facts = evaluate(tmp_path, resample=True)
    # the fall of 0.01 per frame by `write_motion` differs too, by half a frame in frame 1 and so on
    expected = []
    for n in range(5):
        before, after = (n * 3 // 2) * 0.02, -(-n * 3 // 2) * 0.02
        side, fall = (before**2 + after**2) / 2 - (n * 0.03) ** 2, 0.01 * n - 0.015 * n
        expected.append((2 * side**2 + (side + fall) ** 2) ** 0.5)
    assert facts["per_frame"]["red ball"] == pytest.approx(expected, abs=1e-6)


def test_missing_objects_are_named_in_the_error(tmp_path, two_balls):
    write_motion(tmp_path / "true.h5", two_balls)
    fewer = replace(two_balls, objects=two_balls.objects[:1])
    write_motion(tmp_path / "mine.h5", fewer)
    with pytest.raises(InputError, match="has 1 objects .*--objects 'red ball'"):
        evaluate(tmp_path)
    assert list(evaluate(tmp_path, objects="red ball")["objects"]) == ["red ball"]
    with pytest.raises(InputError, match="--objects blue: .* has red ball, green ball"):
        evaluate(tmp_path, objects="blue")


@pytest.mark.parametrize(("shift", "same"), [(0.0, True), (1.9, True), (2.1, False)])
def test_objects_far_apart_are_in_another_frame_of_reference(shift, same):
    """Without cameras, the limit is two root mean square radii; the points are at distance 1 from their mean."""
    points = torch.tensor([[1.0, 0, 0], [-1, 0, 0]]) + torch.tensor([50.0, 0, 0])
    ball = SceneObject(1, "ball")
    truth = ReferenceFrame("true.h5", None, (ball,), {1: points})
    moved = replace(truth, file="mine.h5", points={1: points + torch.tensor([0, shift, 0])})
    with nullcontext() if same else pytest.raises(InputError, match="matching objects are 2.1 units apart"):
        check_same_reference_frame(moved, truth, [(ball, ball)])


def test_report_draws_the_first_the_middle_and_the_last_view(two_balls):
    scene = replace(two_balls, cameras=ring(count=5, size=16))
    drawn = draw_objects(Result("trajectories", {}, {}, []), scene, EvaluateOptions())
    assert [p.caption for p in drawn.pictures] == [scene.cameras.names[i] for i in (0, 2, 4)]
    assert drawn.legend.keys() == {"red ball", "green ball"}


def test_scenes_without_cameras_or_objects_are_drawn_as_they_are(two_balls):
    result = Result("trajectories", {}, {}, [])
    for cameras in (None, ring(count=2)[[]]):
        assert draw_objects(result, replace(two_balls, cameras=cameras), EvaluateOptions()) is result
    blank = replace(two_balls.gaussians, object_id=torch.zeros_like(two_balls.gaussians.object_id))
    cameras = ring(count=1, size=16)
    assert not found_objects(replace(two_balls, gaussians=blank, cameras=cameras), 0).any()
    assert set(found_objects(replace(two_balls, cameras=cameras), 0).unique().tolist()) == {0, 1, 2}


def test_suffixes_may_be_in_capitals(tmp_path, two_balls):
    for name in ("MINE.H5", "TRUE.H5"):
        write_motion(tmp_path / name, two_balls)
    facts = run(tmp_path / "MINE.H5", tmp_path / "TRUE.H5", None, EvaluateOptions())
    assert facts["kind"] == "trajectories" and facts["overall"]["FPE"] == 0
    options = SimulateOptions(forces=tmp_path / "MINE.H5")
    assert with_recorded(options).steps == 12 and with_recorded(SimulateOptions()).steps == SimulateOptions().steps


@pytest.mark.parametrize(("frames", "compared"), [(1, 1), (5, 3), (7, 5), (9, 5)])
def test_resampling_ends_with_the_prediction_or_the_truth(tmp_path, two_balls, frames, compared):
    """The truth has 5 frames at 0, 0.03, ... s; those within the prediction's frames at 0, 0.02, ... s are compared."""
    two_balls = replace(two_balls, gaussians=two_balls.gaussians[::50], cameras=None)
    still = {"spin": 0.0, "speed": 0.0, "count": 4}
    write_motion(tmp_path / "true.h5", two_balls, frames=5, dt=0.03, **still)
    write_motion(tmp_path / "mine.h5", two_balls, frames=frames, dt=0.02, **still)
    if compared < 5:
        with pytest.raises(InputError, match=f"{compared} frames, but .* has 5; give --frames {compared}"):
            evaluate(tmp_path, resample=True)
    facts = evaluate(tmp_path, resample=True, frames=compared)
    # the prediction falls by 0.01 per own frame, thus 0.015 per frame of the truth, which falls by 0.01
    assert facts["per_frame"]["red ball"] == pytest.approx([0.005 * t for t in range(compared)], abs=1e-6)


def test_curves_have_the_rate_of_the_truth_and_equal_keypoints_are_compared_as_they_are(tmp_path, two_balls):
    small = replace(two_balls, gaussians=two_balls.gaussians[::20], cameras=None)
    for name in ("mine.h5", "true.h5"):
        write_motion(tmp_path / name, small, frames=3, dt=0.04)
    result = compare(tmp_path / "mine.h5", tmp_path / "true.h5", EvaluateOptions())
    assert result.fps == pytest.approx(25) and result.notes == ["objects were matched by name"]
    assert result.overall["frames"] == 3 and len(result.curves[0].values) == 3
