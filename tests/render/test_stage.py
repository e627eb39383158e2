"""Stage render: videos, images and options."""

import json
import re
from dataclasses import replace

import cv2
import pytest
import torch

from stages.core.errors import InputError
from stages.core.scene.images import read_image, read_labels, read_video, write_png
from stages.core.scene.scene_ply import write_scene
from stages.render.draw import colour_depth, depth_range, object_colours
from stages.render.options import RenderOptions
from stages.render.overlay import tile_images
from stages.render.stage import run
from tests.render.conftest import render_options
from tests.render.motions import rising

RED, GREEN = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.8, 0.1])


@pytest.fixture
def scene(tmp_path, two_balls):
    write_scene(tmp_path / "scene.ply", two_balls)
    return tmp_path / "scene.ply"


@pytest.fixture
def trajectory(tmp_path, two_balls):
    push = {"kind": "force", "object_id": 1, "force": [0, 0, 8.0], "start": 0.0, "end": 0.05, "at": None}
    return rising(tmp_path / "traj.h5", two_balls, frames=6, forces=(push,))


def render_image(source, out, **choices):
    return read_image(run(source, out, render_options(**choices)))


def colour_fraction(image, colour, within=0.15):
    """Fraction of the pixels whose colour is within a distance of a given one."""
    return float(((image - torch.as_tensor(colour)).abs().amax(-1) < within).float().mean())


def rows_of(image, colour):
    return ((image - colour).abs().amax(-1) < 0.2).nonzero()[:, 0].float().mean()


def test_video_has_the_rate_of_the_trajectory_and_records_its_inputs(trajectory, capsys):
    out = run(trajectory, None, render_options())
    assert out == trajectory.with_name("traj_novel.mp4") and capsys.readouterr().out.strip() == str(out)
    with pytest.importorskip("av").open(str(out)) as file:
        stream = file.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate, stream.frames) == \
            ("h264", "yuv420p", 50, 6)  # fmt: skip
        assert max(stream.width, stream.height) == 96
    facts = json.loads(out.with_name("traj_novel.mp4.json").read_text())
    assert facts["command"] == "render" and facts["inputs"][0]["name"] == "traj.h5" and facts["frames"] == 6


def test_moving_objects_move_and_the_floor_does_not(tmp_path, two_balls):
    source = rising(tmp_path / "traj.h5", two_balls, frames=6, step=0.04)
    frames = list(read_video(run(source, None, render_options(view="input:0", resolution=128))))
    heights = [float(rows_of(frame, GREEN)) for frame in frames]
    assert all(b < a - 0.5 for a, b in zip(heights, heights[1:], strict=False))
    assert (frames[0] - frames[5])[-20:].abs().mean() < 0.02  # the floor in the foreground does not move


def test_first_frame_equals_the_scene_at_rest(scene, trajectory, tmp_path):
    still = render_image(scene, tmp_path / "a.png", view="input:1")
    first = render_image(trajectory, tmp_path / "b.png", view="input:1", frame=0)
    assert torch.equal(still, first) and colour_fraction(still, RED) > 0.005 and colour_fraction(still, GREEN) > 0.005


def test_shadows_are_drawn_once_an_object_moved_and_can_be_switched_off(two_balls, tmp_path):
    """The red ball rises from the floor and shades it; only the grey floor becomes darker."""
    source = rising(tmp_path / "traj.h5", two_balls, frames=6, step=0.04)
    view = {"view": "input:0", "resolution": 128}
    for frame in (0, 5):
        on, off = (render_image(source, tmp_path / f"{s}.png", frame=frame, shadows=s, **view) for s in ("on", "off"))
        floor = (off - 0.5).abs().amax(-1) < 0.03
        darker = (off - on).amax(-1)[floor]
        assert float(darker.min()) >= 0
        assert (float(darker.max()) > 0.05) == (frame > 0)
    facts = [json.loads((tmp_path / f"{s}.png.json").read_text()) for s in ("on", "off")]
    assert facts[0]["light"]["in_colours"] is False and "light" not in facts[1]
    with pytest.raises(InputError, match="--shadows maybe: choose from on | off"):
        render_options(shadows="maybe")


def test_no_light_is_estimated_where_nothing_moves(two_balls, tmp_path):
    out = tmp_path / "still.png"
    render_image(rising(tmp_path / "still.h5", two_balls, frames=3, step=0.0), out, resolution=32)
    assert "light" not in json.loads(out.with_name("still.png.json").read_text())


def test_image_of_a_trajectory_is_a_contact_sheet(trajectory, tmp_path):
    sheet = render_image(trajectory, tmp_path / "sheet.png", view="input:0")
    assert sheet.shape == (2 * 48, 4 * 48, 3)  # six frames in two rows of four
    assert colour_fraction(sheet[48:, 96:], (1.0, 1.0, 1.0), 0.01) == 1  # two empty cells


def test_all_views_in_one_image(scene, tmp_path):
    sheet = render_image(scene, tmp_path / "all.png", view="all")
    assert sheet.shape == (2 * 64, 3 * 64, 3)
    small = render_image(scene, tmp_path / "all.jpg", view="all")
    assert small.shape == sheet.shape and (small - sheet).abs().mean() < 0.02
    one = render_image(scene, tmp_path / "one.png", view="input:4", resolution=64)
    assert torch.equal(sheet[64:, 64:128], one)
    assert run(scene, None, render_options(view="all")).name == "scene_all.png"


def test_video_of_all_views_and_along_a_path(trajectory, tmp_path, two_balls):
    frames = list(read_video(run(trajectory, None, render_options(view="all"))))
    assert len(frames) == 6 and frames[0].shape == (2 * 64, 3 * 64, 3)
    K = [[90.0, 0, 32], [0, 90, 24], [0, 0, 1]]
    rows = [{"viewmat": v.tolist(), "K": K, "size": [64, 48]} for v in two_balls.cameras.viewmats[:3]]
    (tmp_path / "walk.json").write_text(json.dumps(rows))
    out = run(trajectory, None, render_options(view=str(tmp_path / "walk.json")))
    frames = list(read_video(out))
    assert out.name == "traj_walk.mp4" and frames[0].shape == (72, 96, 3)
    assert (frames[0] - frames[5]).abs().mean() > 0.02  # they have different viewpoints


@pytest.mark.parametrize("view", ["novel", "orbit"])
def test_scene_without_cameras_or_objects(tmp_path, two_balls, view):
    g = two_balls.gaussians
    plain = replace(two_balls, gaussians=replace(g, object_id=g.object_id * 0), objects=(), cameras=None, floor=None)
    write_scene(tmp_path / "plain.ply", plain)
    image = render_image(tmp_path / "plain.ply", tmp_path / "p.png", view=view)
    assert colour_fraction(image, RED) > 0.002 and colour_fraction(image, GREEN) > 0.002


def test_background_option_replaces_the_background(scene, tmp_path, two_balls):
    blue = (0.2, 0.4, 0.6)
    own = render_image(scene, tmp_path / "own.png", view="input:0")
    plain = render_image(scene, tmp_path / "plain.png", view="input:0", background="#336699")
    assert colour_fraction(plain, blue, 0.01) > 0.6 and colour_fraction(own, blue) == 0
    assert colour_fraction(plain, RED) > 0.03 and colour_fraction(own, RED) > 0.03
    photo = torch.zeros(40, 80, 3)
    photo[:, 40:] = 1.0
    write_png(tmp_path / "photo.png", photo)
    behind = render_image(scene, tmp_path / "c.png", view="input:0", background=str(tmp_path / "photo.png"))
    assert colour_fraction(behind[:, :20], (0.0, 0.0, 0.0), 0.01) > 0.9
    assert colour_fraction(behind[:, -20:], (1.0, 1.0, 1.0), 0.01) > 0.9
    g = two_balls.gaussians
    floor = replace(g, sh=torch.full_like(g.sh, 10.0))[g.object_id == 0]  # the floor becomes white
    write_scene(tmp_path / "floor.ply", replace(two_balls, gaussians=floor, objects=()))
    other = render_image(scene, tmp_path / "o.png", view="input:0", background=str(tmp_path / "floor.ply"))
    assert colour_fraction(other, (1.0, 1.0, 1.0), 0.1) > 0.6 and colour_fraction(other, RED) > 0.005


def test_empty_pixels_have_the_background_colour_of_the_scene(tmp_path, two_balls):
    blue, alone = (0.2, 0.4, 0.6), two_balls.gaussians[two_balls.gaussians.object_id > 0]
    for background, colour in ((blue, blue), (None, (1.0, 1.0, 1.0))):
        write_scene(tmp_path / "s.ply", replace(two_balls, gaussians=alone, background=background))
        assert colour_fraction(render_image(tmp_path / "s.ply", tmp_path / "s.png", view="input:0"), colour, 0.01) > 0.6


def test_ids_have_flat_and_constant_colours(scene, tmp_path):
    image = render_image(scene, tmp_path / "ids.png", view="input:0", ids=True)
    first, second = object_colours(torch.tensor([1, 2]))
    assert colour_fraction(image, first, 0.05) > 0.005 and colour_fraction(image, second, 0.05) > 0.005
    many = object_colours(torch.arange(1, 13))
    assert (torch.cdist(many, many) + torch.eye(12)).min() > 0.12
    assert torch.equal(object_colours(torch.tensor([9, 2]))[1], second)


def test_depth_is_in_units_in_a_png_and_colour_coded_in_a_video(scene, trajectory, tmp_path):
    run(scene, tmp_path / "d.png", render_options(view="input:0", depth=True))
    depth = read_labels(tmp_path / "d.png").float() / 1000
    assert cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED).dtype == "uint16"
    assert float(depth[48, 48]) == pytest.approx(2.0, abs=0.25)  # the distance of the camera from its target
    assert json.loads((tmp_path / "d.png.json").read_text())["depth_unit"] == 1e-3
    out = run(trajectory, None, render_options(depth=True))
    facts = json.loads(out.with_name(out.name + ".json").read_text())
    assert out.name == "traj_novel_depth.mp4" and 0.5 < facts["depth_near"] < facts["depth_far"] < 5


def test_depth_colours_darken_with_distance():
    image = colour_depth(torch.tensor([[1.0, 2.0, 3.0, 0.0]]), depth_range([torch.tensor([[1.0, 3.0]])]))
    light = image.sum(-1)[0]
    assert light[0] > light[1] > light[2] > light[3] == 0


def test_arrows_are_drawn_while_a_force_is_active(trajectory, tmp_path):
    orange = torch.tensor([1.0, 122 / 255, 20 / 255])
    for frame, there in ((0, True), (5, False)):
        plain = render_image(trajectory, tmp_path / "a.png", view="input:0", frame=frame)
        drawn = render_image(trajectory, tmp_path / "b.png", view="input:0", frame=frame, show_forces=True)
        assert (colour_fraction(drawn, orange, 0.1) > 0.001) == there and torch.equal(plain, drawn) != there


def test_smaller_tiles_are_centred():
    sheet = tile_images([torch.zeros(4, 4, 3), torch.zeros(2, 4, 3)], 2)
    assert sheet.shape == (4, 8, 3)
    assert sheet[:, 4:, 0].tolist() == [[1] * 4, [0] * 4, [0] * 4, [1] * 4]


def test_fps_option_keeps_the_speed_of_motion(trajectory, tmp_path):
    out = run(trajectory, tmp_path / "slow.mp4", render_options(fps=25.0))
    with pytest.importorskip("av").open(str(out)) as file:
        assert (file.streams.video[0].frames, file.streams.video[0].average_rate) == (3, 25)


@pytest.mark.parametrize(
    ("choices", "message"),
    [({"view": "sideways"}, "choose from novel"), ({"view": "input:"}, "is missing"), ({"resolution": 4}, "16 to"),
     ({"fps": 0.0}, "--fps"), ({"depth": True, "ids": True}, "only one"), ({"background": "#12"}, "#rrggbb")],
)  # fmt: skip
def test_invalid_options(choices, message):
    with pytest.raises(InputError, match=message):
        RenderOptions(**choices)


@pytest.mark.parametrize(
    ("out", "choices", "message"),
    [("a.gif", {}, r"use \.mp4, \.jpg, \.png"), ("a.png", {"view": "input:99"}, "number from 0 to 5"),
     ("a.png", {"view": "nowhere.json"}, "no such file"), ("a.png", {"frame": 1}, "has no frames"),
     ("a.png", {"background": "x.txt"}, "give a scene.ply, a colour"), ("no/a.png", {}, "there is no folder"),
     ("no/a.mp4", {}, "there is no folder")],
)  # fmt: skip
def test_wrong_inputs_give_one_line_and_write_nothing(scene, tmp_path, out, choices, message):
    with pytest.raises(InputError, match=message) as caught:
        run(scene, tmp_path / out, render_options(**choices))
    assert not re.search("\n", str(caught.value)) and [p.name for p in tmp_path.iterdir()] == ["scene.ply"]


def test_page_is_one_file_and_says_what_it_cannot_show(trajectory, scene, tmp_path):
    out = run(trajectory, tmp_path / "film.html", render_options(show_forces=True))
    text = out.read_text()
    assert text.startswith("<!doctype html>") and "http" not in text.split('id="film"')[0].replace("http-equiv", "")
    facts = json.loads(out.with_name("film.html.json").read_text())
    assert facts["frames"] == 6 and facts["bytes"] == len(out.read_bytes())
    run(scene, tmp_path / "still.html", render_options(background=str(scene)))
    write_png(tmp_path / "photo.png", torch.zeros(8, 8, 3))
    for wrong, said in (({"view": "all"}, "--view all"), ({"background": str(tmp_path / "photo.png")}, "photo")):
        with pytest.raises(InputError, match=said):
            run(trajectory, tmp_path / "no.html", render_options(**wrong))
    with pytest.raises(InputError, match="one file"):
        run([trajectory, scene], tmp_path / "no.html", render_options(side_by_side=True))
    assert not (tmp_path / "no.html").exists()
