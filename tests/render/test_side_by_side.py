"""Several files rendered side by side."""

import json
import re
from dataclasses import replace

import h5py
import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.similarity import Similarity
from stages.core.scene.images import read_image, read_video
from stages.core.scene.scene_ply import write_scene
from stages.render.stage import _captions, run
from tests.evaluate.motions import transformed_scene
from tests.render.conftest import render_options
from tests.render.motions import rising

GREEN = torch.tensor([0.1, 0.8, 0.1])


def options(**choices):
    return render_options(**{"side_by_side": True, **choices})


def height(image):
    """Mean row of the green ball in an image [px]."""
    return float(((image - GREEN).abs().amax(-1) < 0.2).nonzero()[:, 0].float().mean())


@pytest.fixture
def pair(tmp_path, two_balls):
    """Two trajectories of one scene; the balls rise twice as fast in the second one."""
    steps = {"a": 0.02, "b": 0.04}
    return [rising(tmp_path / f"{name}.h5", two_balls, frames=5, step=step) for name, step in steps.items()]


def test_each_half_is_the_video_of_its_file(pair, capsys):
    both = run(pair, None, options(view="input:0"))
    assert both.name == "a_b_input_0.mp4" and capsys.readouterr().out.strip() == str(both)
    frames = list(read_video(both))
    assert len(frames) == 5 and frames[0].shape == (96, 192, 3)
    for half, source in enumerate(pair):
        alone = list(read_video(run(source, None, options(view="input:0", side_by_side=False))))
        for mine, theirs in zip(frames, alone, strict=True):
            # above the captions; the videos are compressed independently
            assert (mine[:75, 96 * half : 96 * (half + 1)] - theirs[:75]).abs().mean() < 0.02
    facts = json.loads(both.with_name(both.name + ".json").read_text())
    assert [f["name"] for f in facts["inputs"]] == ["a.h5", "b.h5"] and len(facts["scene"]) == 2


def test_shared_camera_frames_both_motions(tmp_path, two_balls):
    """In a moving view, both halves are initially equal except for the captions."""
    calm = rising(tmp_path / "calm.h5", two_balls, frames=5, step=0.0)
    wild = rising(tmp_path / "wild.h5", two_balls, frames=5, step=0.07)
    frames = list(read_video(run([calm, wild], None, options(view="novel"))))
    left, right = frames[0].chunk(2, 1)
    assert (left[:60] - right[:60]).abs().mean() < 0.01
    left, right = frames[-1].chunk(2, 1)
    assert height(right) < height(left) - 8  # it has risen and is still in the image


def test_captions_are_at_the_bottom(pair, tmp_path):
    sheet = read_image(run(pair, tmp_path / "s.png", options(view="input:0", frame=0)))
    plain = read_image(run(pair[0], tmp_path / "p.png", options(view="input:0", frame=0, side_by_side=False)))
    left, right = sheet.chunk(2, 1)
    assert torch.equal(left[:70], plain[:70]) and torch.equal(right[:70], plain[:70])
    dark = [((half - 30 / 255).abs().amax(-1) < 0.01)[-12:, :20].float().mean() for half in (left, right)]
    assert min(dark) > 0.3 and not torch.equal(left[-20:], right[-20:])  # the captions are a and b


def test_shorter_trajectory_holds_its_last_frame(tmp_path, two_balls):
    long = rising(tmp_path / "long.h5", two_balls, frames=6, step=0.02)
    short = rising(tmp_path / "short.h5", two_balls, frames=3, step=0.02)
    frames = list(read_video(run([short, long], None, options(view="input:0", resolution=128))))
    assert len(frames) == 6
    heights = [[height(half) for half in frame.chunk(2, 1)] for frame in frames]
    for t, (left, right) in enumerate(heights):
        assert left == pytest.approx(heights[min(t, 2)][1], abs=0.5) and right == pytest.approx(right)
    assert heights[5][1] < heights[2][1] - 1


def test_different_frame_rates_are_synchronised(tmp_path, two_balls):
    fast = rising(tmp_path / "fast.h5", two_balls, frames=9, step=0.01)  # 50 frames per second, 0.5 units/s
    slow = rising(tmp_path / "slow.h5", two_balls, frames=5, step=0.02)  # the same motion at 25 frames per second
    with h5py.File(slow, "a") as file:
        file.attrs["dt"], file.attrs["fps"] = 0.04, 25.0
    frames = list(read_video(run([slow, fast], None, options(view="input:0", resolution=128))))
    assert len(frames) == 9  # the higher frame rate is used
    for frame in frames:
        left, right = frame.chunk(2, 1)
        assert height(left) == pytest.approx(height(right), abs=0.4)


def test_scene_beside_trajectory_and_contact_sheet(tmp_path, two_balls, pair):
    write_scene(tmp_path / "scene.ply", two_balls)
    frames = list(read_video(run([tmp_path / "scene.ply", pair[1]], None, options(view="input:0"))))
    assert height(frames[0].chunk(2, 1)[0]) == pytest.approx(height(frames[-1].chunk(2, 1)[0]), abs=0.3)
    sheet = read_image(run(pair, tmp_path / "sheet.png", options(view="input:0")))
    assert sheet.shape == (3 * 48, 2 * 96, 3)  # five frames, two pairs per row
    depth = read_image(run(pair, tmp_path / "depth.png", options(view="input:0", frame=2, depth=True)))
    assert depth.shape == (96, 192, 3)


def test_files_with_different_cameras_get_a_camera_each(tmp_path, two_balls, caplog):
    """A scene and its copy under a similarity transform look the same from their own cameras."""
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = transformed_scene(two_balls, Similarity(2.0, turn, torch.tensor([3.0, 1, 0])))
    g = moved.gaussians
    quarter = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5]).expand_as(g.quats)
    moved = replace(moved, gaussians=replace(g, quats=quarter))  # a rotation about z is sufficient for discs and balls
    files = [tmp_path / "here.ply", tmp_path / "there.ply"]
    for file, scene in zip(files, (two_balls, moved), strict=True):
        write_scene(file, scene)
    left, right = read_image(run(files, tmp_path / "p.png", options(view="input:2"))).chunk(2, 1)
    assert (left[:70] - right[:70]).abs().mean() < 0.01 and "its own camera path" in caplog.text


def test_captions_of_files_with_equal_names(tmp_path, two_balls):
    files = []
    for name in ("mpm", "ngff"):
        (tmp_path / name).mkdir()
        files.append(rising(tmp_path / name / "traj.h5", two_balls, frames=2))
    assert _captions(files) == ["mpm/traj", "ngff/traj"] and _captions(files[:1] * 2) == ["traj 1", "traj 2"]


@pytest.mark.parametrize(
    ("count", "choices", "message"),
    [(2, {"side_by_side": False}, "2 files: add --side-by-side"), (1, {}, "a.h5 is the only file"),
     (9, {}, "at most 8"), (2, {"view": "input:77"}, "number from 0 to 5")],
)  # fmt: skip
def test_wrong_options_give_one_line(pair, count, choices, message):
    with pytest.raises(InputError, match=message) as caught:
        run((pair * 5)[:count], None, options(**choices))
    assert not re.search("\n", str(caught.value))
