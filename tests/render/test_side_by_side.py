"""Several films in one picture."""

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
from stages.render.stage import _names, run
from tests.evaluate.motions import elsewhere
from tests.render.conftest import render_options
from tests.render.motions import rising

GREEN = torch.tensor([0.1, 0.8, 0.1])


def options(**choices):
    return render_options(**{"side_by_side": True, **choices})


def height(image):
    """Of the green ball in a picture, from above [px]."""
    return float(((image - GREEN).abs().amax(-1) < 0.2).nonzero()[:, 0].float().mean())


@pytest.fixture
def pair(tmp_path, two_balls):
    """The same scene; the second rises twice as fast."""
    steps = {"a": 0.02, "b": 0.04}
    return [rising(tmp_path / f"{name}.h5", two_balls, frames=5, step=step) for name, step in steps.items()]


def test_each_half_is_the_film_of_its_file(pair, capsys):
    both = run(pair, None, options(view="input:0"))
    assert both.name == "a_b_input_0.mp4" and capsys.readouterr().out.strip() == str(both)
    frames = list(read_video(both))
    assert len(frames) == 5 and frames[0].shape == (96, 192, 3)
    for half, source in enumerate(pair):
        alone = list(read_video(run(source, None, options(view="input:0", side_by_side=False))))
        for mine, theirs in zip(frames, alone, strict=True):
            # above the names; both films are compressed, each in its own way
            assert (mine[:75, 96 * half : 96 * (half + 1)] - theirs[:75]).abs().mean() < 0.02
    facts = json.loads(both.with_name(both.name + ".json").read_text())
    assert [f["name"] for f in facts["inputs"]] == ["a.h5", "b.h5"] and len(facts["scene"]) == 2


def test_the_camera_is_the_same_and_frames_both_motions(tmp_path, two_balls):
    """In a moving view too: where nothing differs yet, the halves are equal but for the names."""
    calm = rising(tmp_path / "calm.h5", two_balls, frames=5, step=0.0)
    wild = rising(tmp_path / "wild.h5", two_balls, frames=5, step=0.07)
    frames = list(read_video(run([calm, wild], None, options(view="novel"))))
    left, right = frames[0].chunk(2, 1)
    assert (left[:60] - right[:60]).abs().mean() < 0.01
    left, right = frames[-1].chunk(2, 1)
    assert height(right) < height(left) - 8  # it rose, and is still in the picture


def test_names_are_written_below(pair, tmp_path):
    sheet = read_image(run(pair, tmp_path / "s.png", options(view="input:0", frame=0)))
    plain = read_image(run(pair[0], tmp_path / "p.png", options(view="input:0", frame=0, side_by_side=False)))
    left, right = sheet.chunk(2, 1)
    assert torch.equal(left[:70], plain[:70]) and torch.equal(right[:70], plain[:70])
    dark = [((half - 30 / 255).abs().amax(-1) < 0.01)[-12:, :20].float().mean() for half in (left, right)]
    assert min(dark) > 0.3 and not torch.equal(left[-20:], right[-20:])  # a and b


def test_a_shorter_film_stands_still_when_it_has_ended(tmp_path, two_balls):
    long = rising(tmp_path / "long.h5", two_balls, frames=6, step=0.02)
    short = rising(tmp_path / "short.h5", two_balls, frames=3, step=0.02)
    frames = list(read_video(run([short, long], None, options(view="input:0", resolution=128))))
    assert len(frames) == 6
    heights = [[height(half) for half in frame.chunk(2, 1)] for frame in frames]
    for t, (left, right) in enumerate(heights):
        assert left == pytest.approx(heights[min(t, 2)][1], abs=0.5) and right == pytest.approx(right)
    assert heights[5][1] < heights[2][1] - 1


def test_different_rates_are_shown_at_the_same_time(tmp_path, two_balls):
    fast = rising(tmp_path / "fast.h5", two_balls, frames=9, step=0.01)  # 50 a second, 0.5 units/s
    slow = rising(tmp_path / "slow.h5", two_balls, frames=5, step=0.02)  # the same motion at 25 a second
    with h5py.File(slow, "a") as file:
        file.attrs["dt"], file.attrs["fps"] = 0.04, 25.0
    frames = list(read_video(run([slow, fast], None, options(view="input:0", resolution=128))))
    assert len(frames) == 9  # at the higher rate
    for frame in frames:
        left, right = frame.chunk(2, 1)
        assert height(left) == pytest.approx(height(right), abs=0.4)


def test_a_scene_at_rest_beside_what_becomes_of_it_and_a_sheet_of_moments(tmp_path, two_balls, pair):
    write_scene(tmp_path / "scene.ply", two_balls)
    frames = list(read_video(run([tmp_path / "scene.ply", pair[1]], None, options(view="input:0"))))
    assert height(frames[0].chunk(2, 1)[0]) == pytest.approx(height(frames[-1].chunk(2, 1)[0]), abs=0.3)
    sheet = read_image(run(pair, tmp_path / "sheet.png", options(view="input:0")))
    assert sheet.shape == (3 * 48, 2 * 96, 3)  # five moments, two pairs a row
    depth = read_image(run(pair, tmp_path / "depth.png", options(view="input:0", frame=2, depth=True)))
    assert depth.shape == (96, 192, 3)


def test_another_world_is_filmed_by_its_own_camera(tmp_path, two_balls, caplog):
    """The same scene, turned, moved and grown: from its own photo's place it looks the same."""
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = elsewhere(two_balls, Similarity(2.0, turn, torch.tensor([3.0, 1, 0])))
    g = moved.gaussians
    quarter = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5]).expand_as(g.quats)
    moved = replace(moved, gaussians=replace(g, quats=quarter))  # discs and balls: a turn about z is enough
    files = [tmp_path / "here.ply", tmp_path / "there.ply"]
    for file, scene in zip(files, (two_balls, moved), strict=True):
        write_scene(file, scene)
    left, right = read_image(run(files, tmp_path / "p.png", options(view="input:2"))).chunk(2, 1)
    assert (left[:70] - right[:70]).abs().mean() < 0.01 and "camera of its own" in caplog.text


def test_files_of_one_name_are_told_apart_by_their_folders(tmp_path, two_balls):
    files = []
    for name in ("mpm", "ngff"):
        (tmp_path / name).mkdir()
        files.append(rising(tmp_path / name / "traj.h5", two_balls, frames=2))
    assert _names(files) == ["mpm/traj", "ngff/traj"] and _names(files[:1] * 2) == ["traj 1", "traj 2"]


@pytest.mark.parametrize(
    ("count", "choices", "says"),
    [(2, {"side_by_side": False}, "2 files: give --side-by-side"), (1, {}, "a.h5 is alone"),
     (9, {}, "at most 8"), (2, {"view": "input:77"}, "cameras 0 to 5")],
)  # fmt: skip
def test_a_mistake_is_told_in_one_sentence(pair, count, choices, says):
    with pytest.raises(InputError, match=says) as caught:
        run((pair * 5)[:count], None, options(**choices))
    assert not re.search("\n", str(caught.value))
