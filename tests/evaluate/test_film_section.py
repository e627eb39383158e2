"""The report's section on a simulated motion: its objects, the sources of their properties, and suggestions."""

import html
import math
import re
from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.physics.materials import MATERIALS
from stages.core.physics.particles import Bodies
from stages.core.scene.scene import SceneObject
from stages.core.scene.trajectory import read_trajectory
from stages.evaluate import film_section
from tests.conftest import two_balls_scene
from tests.core.scene.test_h5_schema import UNITS, start_of
from tests.evaluate.motions import write_motion


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory):
    path = tmp_path_factory.mktemp("motion") / "t.h5"
    return read_trajectory(write_motion(path, two_balls_scene(), frames=2))


@pytest.fixture
def known_volumes(monkeypatch):
    """Replaces the volumes computed by sampling of the objects."""
    monkeypatch.setattr(film_section, "_volumes", lambda t: [0.5 * o.id for o in t.scene.objects])


def with_scene(trajectory, **more):
    return replace(trajectory, scene=replace(trajectory.scene, **more))


def cells(table: str) -> list[list[str]]:
    return [[html.unescape(c) for c in re.findall(r"<td>(.*?)</td>", row)] for row in table.split("<tr>")[2:]]


def test_sizes_and_masses_are_in_metres_where_the_scale_is_known(trajectory):
    known = with_scene(trajectory, scale={"metres_per_unit": 2.0, "source": "given"})
    shares = []  # relative to the volume of the ball
    for t, unit, factor in ((trajectory, "units", 1), (known, "m", 2)):
        red, green = cells(film_section._objects(t))
        assert red[0] == "1 red ball" and green[0] == "2 green ball" and red[3] == "rubber"
        sides, name = red[1].rsplit(" ", 1)
        assert name == unit
        assert [float(side) for side in sides.split(" × ")] == pytest.approx([0.3 * factor] * 3, rel=0.1)
        mass = float(red[2].split()[0])
        ball = 4 / 3 * math.pi * (0.15 * factor) ** 3
        shares.append(mass / (MATERIALS["rubber"].density * ball))
        assert red[2].endswith("kg if one unit is 1 m" if unit == "units" else "kg")
    assert 0.9 < shares[0] < 1.1 and shares[1] == pytest.approx(shares[0], rel=0.02)


def test_volumes_are_those_of_the_engine_or_of_what_it_would_sample(trajectory, monkeypatch):
    t = with_scene(trajectory, scale={"metres_per_unit": 2.0, "source": "given"})
    bodies = Bodies(torch.zeros(3, 3), torch.tensor([0, 0, 1]), torch.tensor([1.0, 2.0, 4.0]), 0.1)
    monkeypatch.setattr(film_section, "sample_bodies", lambda scene, count: bodies)
    assert film_section._volumes(t) == [24.0, 32.0]
    assert film_section._volumes(replace(t, field=start_of(UNITS))) == [2.0, 2.125]

    def unusable(scene, count):
        raise InputError("none of its Gaussians is usable")

    monkeypatch.setattr(film_section, "sample_bodies", unusable)
    assert [math.isnan(v) for v in film_section._volumes(t)] == [True, True]


def test_where_a_material_is_from(trajectory, known_volumes):
    objects = (SceneObject(1, "red ball"), SceneObject(2, "thing"))
    t = with_scene(trajectory, objects=objects, provenance={"options": {"material": ["2=steel"]}})
    assert [row[3:] for row in cells(film_section._objects(t))] == [
        ["ball", "inferred from the name"], ["steel", "given (--material)"],
    ]  # fmt: skip
    guess = with_scene(trajectory, objects=objects, provenance={"options": {"material": 3}})
    assert [row[4] for row in cells(film_section._objects(guess))] == [
        "inferred from the name",
        "a guess: nothing is known",
    ]
    stored = with_scene(trajectory, provenance={"options": {"material": ["red ball=wood"]}})
    assert [row[3:] for row in cells(film_section._objects(stored))] == [
        ["wood", "given (--material)"], ["rubber", "stored in the scene"],
    ]  # fmt: skip
    other = with_scene(trajectory, objects=(SceneObject(1, "red ball", "cheese"), SceneObject(2, "x", "cheese")))
    # materials stored by another tool
    assert [row[3] for row in cells(film_section._objects(other))] == ["ball", "common"]


@pytest.mark.parametrize("dense", [False, True])
def test_the_film_is_of_keypoints(trajectory, known_volumes, monkeypatch, dense):
    """A dense trajectory of another tool, with every Gaussian in every frame, has no film."""
    monkeypatch.setattr(film_section, "read_trajectory", lambda path: replace(trajectory, dense=dense))
    monkeypatch.setattr(film_section, "_player", lambda trajectory, title: f"<iframe>{title}</iframe>")
    html = film_section.film_section(trajectory.path)
    assert ("<iframe>t</iframe>" in html) == (not dense) and "--lift 1=0.3" in html


def test_a_motion_of_the_learned_engine_can_be_played_on(trajectory, monkeypatch):
    """The page contains the force field, unless its weights are different; then it contains only the film."""
    shown = []
    monkeypatch.setattr(film_section, "find_shadows", lambda scene, keypoints: None)
    monkeypatch.setattr(film_section, "pack_film", lambda scene, motion, settings, shadows: shown.append(motion.field))
    monkeypatch.setattr(film_section, "film_page", lambda film, title: "")
    monkeypatch.setattr(film_section, "playable_parts", lambda t: {"of": t.field})
    start = start_of(UNITS)
    for field in (None, start):
        film_section._player(replace(trajectory, field=field), "t")

    def of_other_weights(trajectory):
        raise InputError("its weights are others")

    monkeypatch.setattr(film_section, "playable_parts", of_other_weights)
    film_section._player(replace(trajectory, field=start), "t")
    assert shown == [None, {"of": start}, None]


def test_names_are_escaped(trajectory, known_volumes):
    t = with_scene(trajectory, objects=(SceneObject(1, "<script>"), SceneObject(2, "b")))
    assert "<script>" not in film_section._objects(t) + film_section._next_steps(t, trajectory.path)


CHAIN = {"command": "simulate", "seconds": 2.25, "inputs": [{"name": "toys.ply"}], "scene": {
    "command": "segment", "options": {"boxes": "p.json"}, "seconds": 1.0, "scene": {"command": "reconstruct"},
}}  # fmt: skip


def test_times_of_the_stages(trajectory):
    assert film_section._times(trajectory) == ""
    rows = cells(film_section._times(with_scene(trajectory, provenance=CHAIN)))
    assert rows == [["segment", "1.0 s"], ["simulate", "2.2 s"], ["all", "3.2 s"]]


@pytest.mark.parametrize(("options", "text"), [
    ({"boxes": "p.json"}, "The objects were given (--boxes)."), ({"masks": "m"}, "The objects were given (--masks)."),
    ({"points": ["xy=1,2"]}, "given (--points)"), ({}, "found by the segmenter, which may cut or merge things"),
])  # fmt: skip
def test_where_the_objects_are_from(trajectory, options, text):
    chain = {**CHAIN, "scene": {"command": "segment", "options": options}}
    t = with_scene(trajectory, provenance=chain, scale={"metres_per_unit": 0.25, "source": "assumed"})
    found = html.unescape(film_section._certainty(t))
    assert text in found and "One unit is 0.25 m: assumed; sizes and masses are relative to it." in found
    known = with_scene(trajectory, scale={"metres_per_unit": 0.25, "source": "given"})
    found = film_section._certainty(known)
    assert "0.25 m: given." in found and "The objects were" not in found


def test_commands_to_try_next(trajectory, known_volumes):
    text = html.unescape(film_section._next_steps(with_scene(trajectory, provenance=CHAIN), trajectory.path))
    assert "ngff simulate toys.ply --lift 1=0.3" in text and '--velocity "object=2 1,0,1"' in text
    assert "ngff render t.h5 -o film.html" in text
    x, y, z = map(float, re.search(r'--force "object=1 force=(\S+),(\S+),(\S+) to=0.2"', text).groups())
    assert (x, y) == (pytest.approx(2 * z, rel=0.01), 0)  # the object's weight upwards, and twice that sideways
    assert z == pytest.approx(9.81 * 0.5 * MATERIALS["rubber"].density, rel=0.01)
