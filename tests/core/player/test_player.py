"""The page's images equal those of our rasteriser, at rest and in motion, and its controls work."""

import base64
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.core.geometry.rotations import matrix
from stages.core.physics.keypoints import bind_gaussians, choose_keypoints
from stages.core.physics.occluders import make_occluders
from stages.core.physics.shadow_casting import ShadowCaster
from stages.core.player.film import Motion, film_page, pack_film
from stages.core.raster.rasterise import rasterise
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.trajectory import Keypoints
from tests.browser import until
from tests.conftest import deform, random_gaussians, two_balls_scene
from tests.core.raster.lit_world import LIGHT, MOVED, REST, lit_scene, moved_points

PIXELS = """async (view) => {
  const bytes = await player.pixels(view);
  let text = "";
  for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768));
  return btoa(text);
}"""
PIXEL_OF = """async (point) => {
  const { Camera } = await import("player/camera.js");
  return Camera.pixel(player.camera.view(overlay.clientWidth, overlay.clientHeight), point);
}"""
BACKGROUND = (0.2, 0.3, 0.4)


def world():
    """The two balls with harmonics of degree 3, additional thin Gaussians, and a background colour."""
    scene = two_balls_scene()
    needles = random_gaussians(300, seed=3, degree=3, size=0.02)
    scales = needles.scales * torch.tensor([4.0, 1.0, 0.2])
    needles = replace(needles, means=0.3 * needles.means + torch.tensor([0.3, 0, 0.4]), scales=scales,
                      object_id=torch.full((300,), 2))  # fmt: skip
    g = scene.gaussians
    sh = torch.cat([g.sh, 0.1 * torch.randn(len(g), 15, 3, generator=torch.Generator().manual_seed(0))], 1)
    return replace(scene, gaussians=concatenate([replace(g, sh=sh), needles]), background=BACKGROUND)


def motion_of(scene, frames=3):
    """The red ball rotates and rises; the green one is bent and stretched."""
    g = scene.gaussians
    rows = torch.cat([(g.object_id == o.id).nonzero()[:64, 0] for o in scene.objects])
    keypoints = Keypoints(g.means[rows], g.object_id[rows])
    red = (keypoints.object_id == 1)[:, None]
    positions = []
    for t in torch.linspace(0, 1, frames):
        turn = matrix(torch.tensor([math.cos(0.6 * t), 0.0, math.sin(0.6 * t), 0.0]))
        centre = torch.tensor([-0.3, 0.0, 0.15])
        turned = (keypoints.rest - centre) @ turn.T + centre + t * torch.tensor([0.05, 0.1, 0.2])
        x, y, z = keypoints.rest.unbind(1)
        bent = torch.stack([x + 0.4 * t * (z - 0.4), y, 0.4 + (1 + 0.5 * t) * (z - 0.4) - 0.2 * t], 1)
        positions.append(torch.where(red, turned, bent))
    positions = torch.stack(positions)
    com = torch.stack([positions[:, keypoints.object_id == o.id].mean(1) for o in scene.objects], 1)
    rotation = torch.tensor([1.0, 0, 0, 0]).expand(frames, len(scene.objects), 4)
    return Motion(keypoints, bind_gaussians(scene, keypoints), positions, com, rotation, 0.02)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    scene = world()
    motion = motion_of(scene)
    path = tmp_path_factory.mktemp("film") / "film.html"
    path.write_text(film_page(pack_film(scene, motion), "two <balls> & more"))
    return scene, motion, path


def picture_of_the_page(page, cameras, index):
    w, h = cameras.sizes[index].tolist()
    view = {"viewmat": cameras.viewmats[index].tolist(), "K": cameras.Ks[index].tolist(), "size": [w, h]}
    data = np.frombuffer(base64.b64decode(page.evaluate(PIXELS, view)), np.uint8)
    return torch.from_numpy(data.reshape(h, w, 4)[..., :3].copy()).float() / 255


def picture_of_the_rasteriser(g: Gaussians, cameras, index, background=torch.tensor(BACKGROUND)):  # noqa: B008
    w, h = cameras.sizes[index].tolist()
    drawn = rasterise(g, cameras.viewmats[[index]], cameras.Ks[[index]], w, h, background=background)
    return drawn.rgb[0].clamp(0, 1)


def psnr(a, b):
    return -10 * math.log10(float((a - b).square().mean()))


def larger(cameras, factor=4):
    """The same views with larger images."""
    scaling = torch.tensor([[factor], [factor], [1.0]])
    return replace(cameras, Ks=cameras.Ks * scaling, sizes=cameras.sizes * factor)


def check_pictures(film, page):
    scene, motion, _ = film
    cameras = larger(scene.cameras)
    page.evaluate("player.play(false)")
    for frame, index in ((0, 0), (2, 1), (2, 4)):
        page.evaluate("t => player.seek(t)", frame * motion.dt)
        truth = deform(scene.gaussians, motion.binding, motion.keypoints, motion.positions[frame])
        mine = picture_of_the_rasteriser(truth, cameras, index)
        assert psnr(picture_of_the_page(page, cameras, index), mine) >= 35
    still = picture_of_the_rasteriser(scene.gaussians, cameras, 4)
    assert psnr(still, mine) < 25  # the frames differ


def test_pictures_equal_those_of_the_rasteriser(film, open_page):
    check_pictures(film, open_page(film[2]))


@pytest.mark.slow  # Firefox takes seconds to start
def test_pictures_in_firefox_equal_those_of_the_rasteriser(film, open_firefox):
    page = open_firefox(film[2])
    until(page, "window.player !== undefined")
    check_pictures(film, page)


def test_shadows_equal_those_of_the_rasteriser(tmp_path, open_page):
    """Shadows contained in the colours are removed alike; key K switches shadows off."""
    scene = lit_scene(spacing=0.03)
    keypoints = choose_keypoints(scene, 48)
    positions = torch.stack([moved_points(keypoints.rest, keypoints.object_id, p) for p in (REST, MOVED)])
    com, turns = torch.zeros(2, 2, 3), torch.tensor([1.0, 0, 0, 0]).expand(2, 2, 4)
    motion = Motion(keypoints, bind_gaussians(scene, keypoints), positions, com, turns, 0.02)
    occluders, cameras = make_occluders(scene, keypoints), larger(scene.cameras, 2)
    truth = deform(scene.gaussians, motion.binding, keypoints, positions[1])
    background = torch.tensor(scene.background)
    for light in (replace(LIGHT, beneath=0.3), replace(LIGHT, in_colours=False)):
        caster = ShadowCaster(light, occluders)
        path = tmp_path / "film.html"
        path.write_text(film_page(pack_film(scene, motion, {}, caster), "shadows"))
        page = open_page(path)
        page.evaluate("player.play(false); player.seek(player.duration)")
        shaded = caster.shade(truth, positions[1], caster.rest_irradiance(scene.gaussians))
        with_shadows, without = (picture_of_the_rasteriser(g, cameras, 0, background) for g in (shaded, truth))
        assert psnr(picture_of_the_page(page, cameras, 0), with_shadows) >= 35 > 32 > psnr(with_shadows, without)
        page.keyboard.press("k")
        assert psnr(picture_of_the_page(page, cameras, 0), without) >= 35


def test_a_scene_at_rest_is_a_page_without_a_clock(tmp_path, open_page):
    scene = world()
    path = tmp_path / "still.html"
    path.write_text(film_page(pack_film(scene), "still"))
    page, cameras = open_page(path), larger(scene.cameras, 2)
    mine = picture_of_the_rasteriser(scene.gaussians, cameras, 2)
    assert psnr(picture_of_the_page(page, cameras, 2), mine) >= 35
    assert not page.is_visible("#time") and not page.is_visible("#arrows-row")


def test_keys_play_and_show_objects(film, open_page):
    scene, motion, path = film
    page = open_page(path)
    assert page.title() == page.inner_text("h1") == "two <balls> & more"
    assert page.locator("#objects li").all_inner_texts()[0].split("\n")[0] == "1 red ball"
    page.keyboard.press("Space")
    assert not page.evaluate("player.playing")
    page.keyboard.press("Home")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("player.time") == pytest.approx(motion.dt)
    cameras, red = scene.cameras, torch.tensor([0.9, 0.1, 0.1])

    def red_pixels():
        return int(((picture_of_the_page(page, cameras, 0) - red).abs().amax(-1) < 0.25).sum())

    everything = red_pixels()
    page.keyboard.press("2")  # selects the green ball alone
    assert everything > 20 and red_pixels() == 0
    page.keyboard.press("0")
    assert red_pixels() == everything
    page.locator("#objects input").first.uncheck()
    assert red_pixels() == 0 and page.evaluate("[...player.hidden]") == [1]


def eye_and_pivot(page):
    return (torch.tensor(page.evaluate(f"player.camera.{name}")) for name in ("eye", "pivot"))


def test_mouse_and_touch_move_the_camera(film, open_page):
    scene, _, path = film
    page = open_page(path)
    page.evaluate("player.play(false); player.seek(0)")
    page.select_option("#view", label="01.png")
    eye, pivot = eye_and_pivot(page)
    truth = -(scene.cameras.viewmats[1, :3, :3].T @ scene.cameras.viewmats[1, :3, 3])
    torch.testing.assert_close(eye, truth, rtol=0, atol=1e-4)

    page.mouse.move(300, 300)
    page.mouse.down()
    page.mouse.move(380, 280, steps=3)
    page.mouse.up()
    turned, same = eye_and_pivot(page)
    torch.testing.assert_close(same, pivot, rtol=0, atol=1e-4)
    distance = float((eye - pivot).norm())
    assert (turned - eye).norm() > 0.1 and float((turned - pivot).norm()) == pytest.approx(distance, rel=1e-4)

    page.mouse.wheel(0, -200)
    until(page, f"player.camera.distance < {0.9 * distance}")
    nearer = page.evaluate("player.camera.distance")
    session = page.context.new_cdp_session(page)
    for kind, spread in (("touchStart", 40), ("touchMove", 60), ("touchMove", 80), ("touchEnd", None)):
        fingers = [] if spread is None else [240 - spread, 240 + spread]
        points = [{"x": x, "y": 200, "id": i} for i, x in enumerate(fingers)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    until(page, f"player.camera.distance < {0.6 * nearer}")  # the fingers are twice as far apart


def test_double_click_turns_around_the_point_under_the_cursor(film, open_page):
    scene, _, path = film
    page = open_page(path)
    page.evaluate("player.play(false); player.seek(0)")
    page.select_option("#view", label="00.png")
    green = torch.tensor([0.3, 0.0, 0.4])
    x, y = page.evaluate(PIXEL_OF, green.tolist())
    until(page, "!player.changed && !player.busy")
    assert page.evaluate("([x, y]) => player.pick(x, y).object", [x, y]) == 2
    page.mouse.dblclick(x, y)
    until(page, "player.camera.transition === null")
    _, pivot = eye_and_pivot(page)
    assert float((pivot - green).norm()) < 0.15  # the point is on the ball of radius 0.12, in front of its centre


def test_arrows_of_forces_start_at_the_object_while_they_act(tmp_path, open_page):
    scene = two_balls_scene()
    push = {"kind": "force", "object_id": 2, "force": (0.0, 0.0, 8.0), "start": 0.0, "end": 0.03, "at": None}
    motion = replace(motion_of(scene), forces=(push,))
    path = tmp_path / "film.html"
    path.write_text(film_page(pack_film(scene, motion, {"arrows": True}), "arrows"))
    page = open_page(path)
    page.evaluate("player.play(false); player.seek(0)")
    page.select_option("#view", label="00.png")
    # the attribute is missing before the first image
    drawn = "(document.querySelector('#overlay path').getAttribute('d') ?? '')"
    until(page, f"!player.changed && !player.busy && {drawn}.length > 0")
    x, y = (float(v) for v in page.evaluate(drawn).split(" ")[0].removeprefix("M").split(","))
    centre = page.evaluate(PIXEL_OF, motion.com[0, 1].tolist())
    assert math.dist(centre, (x, y)) < 1
    page.evaluate(f"player.seek({2 * motion.dt})")
    until(page, f"{drawn} === ''")
