"""A playable film: the page computes the same motion as the learned engine, and the mouse can drag its objects."""

import base64
import json
from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.player.film import Motion, film_page, pack_film
from stages.core.player.playable import playable_parts
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.trajectory import read_trajectory
from stages.render.options import RenderOptions
from stages.render.stage import run as render
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run as simulate
from tests.browser import drag_up, until
from tests.conftest import ball, ring, two_balls_scene

LIMIT = 1e-3  # maximum distance between the results of page and engine after 50 frames [m]
RUN = """async (films) => {
  const { unpack } = await import("player/container.js"), { engineInput } = await import("player/local.js");
  const { FieldEngine } = await import("player/engine.js"), out = [];
  for (const text of films) {
    const film = await unpack(text), rest = film.arrays.keypoints.subarray(0, 3 * film.arrays.keypoint_object.length);
    const engine = new FieldEngine(engineInput(film, rest));
    for (let n = 1; n < film.frames; n++) engine.advance();
    out.push(Array.from(engine.positions()));
  }
  return out;
}"""  # returns the last positions of the keypoints of each film
RISE = """() => {
  const ids = player.film.arrays.keypoint_object, own = [...ids.keys()].filter((k) => ids[k] === 1);
  return own.reduce((sum, k) => sum + player.positions[3 * k + 2] - player.rest[3 * k + 2], 0) / own.length;
}"""  # returns the mean rise of object 1 [m]


FIND = """() => {
  const hits = [];
  for (let y = 50; y < 350; y += 20) for (let x = 250; x < 780; x += 20)
    if (player.pick(x, y)?.object === 1) hits.push([x, y]);
  return hits[hits.length >> 1];
}"""  # returns a point of object 1 next to the panel [px]


def thing(centre, radii, id):
    """An ellipsoid of Gaussians."""
    g = ball((0.0, 0.0, 0.0), 1.0, 150, (0.5, 0.5, 0.5), id, seed=id)
    means = g.means * torch.tensor(radii) + torch.tensor(centre)
    return replace(g, means=means, scales=g.scales * min(radii))


def scene_of(*things):
    """A scene with ellipsoids (centre, radii) and its floor at 0."""
    gaussians = concatenate([thing(*t, id) for id, t in enumerate(things, start=1)])
    objects = tuple(SceneObject(id, f"thing {id}") for id in range(1, len(things) + 1))
    return Scene(gaussians, objects, ring(), 0.0)


BALL, FLAT, TALL = (0.1, 0.1, 0.1), (0.2, 0.15, 0.06), (0.06, 0.08, 0.2)
SCENES = {  # scene and options by name
    "a fall": (scene_of(((0, 0, 0.5), BALL)), {}),
    "two meet": (two_balls_scene(), {"velocity": ("object=2 -0.8,0,0",)}),
    "a push at a point": (two_balls_scene(), {"force": ("object=1 force=0,40,10 from=0.1 to=0.3 at=-0.3,0.1,0.2",)}),
    "a torque": (scene_of(((0, 0, 0.3), TALL)), {"force": ("object=1 torque=0.2,0.1,0.3 to=0.2",), "lift": ("0.1",)}),
    "three in a pile": (scene_of(((0, 0, 0.1), FLAT), ((0.05, 0, 0.32), BALL), ((0, 0.08, 0.7), TALL)), {}),
    "soft": (scene_of(((0, 0, 0.1), BALL), ((0.02, 0, 0.4), FLAT)), {"material": ("1=jelly", "2=cloth")}),
    "against walls": (scene_of(((0, 0, 0.2), BALL), ((0.3, 0, 0.2), FLAT)), {
        "box": "-0.6,-0.6,0,0.6,0.6,2", "velocity": ("object=1 -2,1,0", "object=2 2,0,1")}),
    "pinned": (scene_of(((0, 0, 0.3), FLAT), ((0.05, 0, 0.6), BALL)), {"pin": ("1",), "friction": 0.1}),
    "no gravity": (two_balls_scene(), {"gravity": 0.0, "velocity": ("object=2 -1,0,-0.4",)}),
    "asleep until hit": (scene_of(((0, 0, 0.1), BALL), ((0.18, 0, 0.1), BALL), ((-0.6, 0, 0.3), TALL)), {
        "velocity": ("object=3 3,0,0",), "material": ("3=wood",)}),
}  # fmt: skip


def simulated(folder, scene, frames=51, contact="learned", **options):
    """A trajectory of the learned engine, 32 keypoints for each object."""
    write_scene(folder / "scene.ply", scene)
    options = SimulateOptions(engine="ngff", contact=contact, keypoints=32, steps=frames, **options)
    simulate(folder / "scene.ply", folder / "traj.h5", options)
    return read_trajectory(folder / "traj.h5")


def playable(trajectory):
    return pack_film(trajectory.scene, replace(Motion.of(trajectory), field=playable_parts(trajectory)))


def page_and_engine(folder, open_page, names, device, frames=51):
    """Yield for each scene the largest distance between keypoints of page and engine in the last frame [m]."""
    trajectories = [simulated(folder, scene, frames, **options) for scene, options in map(SCENES.get, names)]
    films = [playable(t) for t in trajectories]
    (folder / "film.html").write_text(film_page(films[0], "parity"))
    ends = open_page(folder / "film.html").evaluate(RUN, [base64.b64encode(film).decode() for film in films])
    for t, end in zip(trajectories, ends, strict=True):
        assert (t.positions[-1] - t.positions[0]).norm(dim=1).max() > 0.02
        yield (t.positions[-1] - torch.tensor(end).view(-1, 3)).norm(dim=1).max()


def test_the_page_computes_the_motion_of_the_engine(tmp_path, open_page, device):
    names = ["two meet", "against walls"]
    assert max(page_and_engine(tmp_path, open_page, names, device, frames=16)) < LIMIT


@pytest.mark.slow  # Firefox takes seconds to start
def test_firefox_computes_the_motion_of_the_engine(tmp_path, open_firefox, device):
    """The engine is called directly, and by the page in its worker."""
    pages = []

    def open_once(path):
        pages.append(open_firefox(path))
        return pages[0]

    assert max(page_and_engine(tmp_path, open_once, ["two meet"], device, frames=16)) < LIMIT
    until(pages[0], "window.player !== undefined")
    pages[0].evaluate("player.live.act({ do: 'lift', object: 1, height: 0.2 })")
    until(pages[0], f"() => ({RISE})() > 0.05")


@pytest.mark.slow
def test_ten_motions_agree_after_fifty_frames(tmp_path, open_page, device):
    distances = dict(zip(SCENES, page_and_engine(tmp_path, open_page, SCENES, device), strict=True))
    assert max(distances.values()) < LIMIT, distances


@pytest.mark.usefixtures("device")
def test_the_mouse_takes_an_object_out_of_the_film(tmp_path, open_page):
    simulated(tmp_path, two_balls_scene(), frames=5, lift=("2=0.1",))
    page = open_page(render(tmp_path / "traj.h5", tmp_path / "film.html", RenderOptions(playable=True, view="input:0")))
    page.set_viewport_size({"width": 800, "height": 400})
    page.evaluate("player.play(false); player.seek(0)")
    until(page, "!player.changed && !player.busy && player.drawn()")
    drag_up(page, page.evaluate(FIND), 12, 8)
    until(page, f"player.live.state?.arrows.length === 1 && ({RISE})() > 0.05")
    page.mouse.up()
    assert not page.is_visible("#time")
    page.keyboard.press("b")  # returns to the film
    until(page, f"({RISE})() === 0")
    assert page.is_visible("#time") and page.evaluate("player.live.running") is False


@pytest.mark.usefixtures("device")
def test_only_motions_of_the_learned_field_are_playable(tmp_path):
    t = simulated(tmp_path, two_balls_scene(), frames=2)
    for wrong, message in (
        (replace(t, info=replace(t.info, engine="rigid")), "simulated by rigid"),
        (replace(t, field=None), "simulate again"),
        (simulated(tmp_path, two_balls_scene(), frames=2, contact="solved"), "simulate again"),
        (replace(t, field=replace(t.field, units=replace(t.field.units, weights="0" * 64))), "NGFF_WEIGHTS"),
    ):
        with pytest.raises(InputError, match=message):
            playable_parts(wrong)
    with pytest.raises(InputError, match="only works with a page"):
        render(tmp_path / "traj.h5", tmp_path / "film.mp4", RenderOptions(playable=True))
    with pytest.raises(InputError, match="no motion"):
        render(tmp_path / "scene.ply", tmp_path / "film.html", RenderOptions(playable=True))


GO_TO = """([frame]) => Promise.all(["local", "engine"].map((name) => import(`player/${name}.js`))).then(
  ([{ engineInput }, { FieldEngine }]) => {
    const engine = new FieldEngine(engineInput(player.film, player.rest));
    for (const n of [player.film.frames - 1, 0, frame]) engine.goTo(n);  // the last from a state that was kept
    engine.advance([], [{ what: "gravity", value: 0, object_id: null }]);
    engine.goTo(frame);
    while (engine.frame < player.film.frames - 1) engine.advance();
    return Array.from(engine.positions());
  })"""  # returns the last positions of a film after recomputing its last frames


@pytest.mark.usefixtures("device")
def test_motion_goes_on_from_within_a_film(tmp_path, open_page):
    """A change made at the first visit of the frame must be forgotten, and one of the film must be repeated."""
    (tmp_path / "given.json").write_text(json.dumps({"options": {}, "frames": 16, "prompts": [
        {"kind": "change", "what": "gravity", "value": 4.0, "start": 0.1, "object_id": None}]}))  # fmt: skip
    options = {"velocity": ("object=2 -0.8,0,0",), "forces": tmp_path / "given.json"}
    t = simulated(tmp_path, two_balls_scene(), frames=16, **options)
    page = open_page(render(tmp_path / "traj.h5", tmp_path / "film.html", RenderOptions(playable=True)))
    end = torch.tensor(page.evaluate(GO_TO, [12])).view(-1, 3)
    assert (t.positions[-1] - t.positions[12]).norm(dim=1).max() > 0.02
    assert (end - t.positions[-1]).norm(dim=1).max() < LIMIT


@pytest.mark.parametrize("first", [pytest.param(0, marks=pytest.mark.slow), 6])
@pytest.mark.usefixtures("device")
def test_what_was_done_in_a_page_is_saved_and_repeated_by_the_engine(tmp_path, open_page, first):
    """Starting from a frame of the film, frame by frame: a drag by the mouse, a push and a pin."""
    simulated(tmp_path, two_balls_scene(), frames=8, velocity=("object=2 -0.8,0,0",), box="-1,-1,0,1,1,1.5")
    page = open_page(render(tmp_path / "traj.h5", tmp_path / "film.html", RenderOptions(playable=True, view="input:0")))
    page.set_viewport_size({"width": 800, "height": 400})
    page.evaluate(f"player.play(false); player.seek({first} * player.film.dt)")
    still = "!player.changed && !player.busy && player.drawn()"
    until(page, still)
    x, y = page.evaluate(FIND)
    page.evaluate("player.live.act({ do: 'pause', value: true })")
    until(page, "player.live.state?.paused")
    page.mouse.move(x, y)
    page.mouse.down()
    frames = page.evaluate("player.live.state.frames") + 8
    for i in range(8):
        page.mouse.move(x, y - 16 * i)
        page.keyboard.press(".")
    page.mouse.up()
    until(page, f"player.live.state.frames === {frames} && {still}")
    assert page.evaluate(RISE) > 0.05
    page.mouse.move(*page.evaluate(FIND))
    for key in "p.n..":
        page.keyboard.press(key)
    until(page, f"player.live.state.frames === {frames + 3}")
    with page.expect_download() as download:
        page.keyboard.press("x")
    download.value.save_as(tmp_path / "done.json")
    assert download.value.suggested_filename == "traj-forces.json"
    shown = torch.tensor(page.evaluate("Array.from(player.positions)")).view(-1, 3)
    simulate(tmp_path / "scene.ply", tmp_path / "again.h5", SimulateOptions(forces=tmp_path / "done.json"))
    again = read_trajectory(tmp_path / "again.h5")
    forces = [f for f in again.info.forces if f["kind"] == "force"]
    assert len(again) == frames + 3 and len(forces) == 17  # the drag, the forces that balance the weight, and the push
    assert min(f["start"] for f in forces) > first * 0.02
    assert [f["what"] for f in again.info.forces if f["kind"] == "change"] == ["pinned"]
    assert (again.positions[-1] - shown).norm(dim=1).max() < LIMIT
