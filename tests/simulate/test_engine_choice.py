"""The engine that `--engine auto` selects."""

import json
import logging
import math
from dataclasses import replace

import pytest
import torch

from stages.core.physics.forces import Force, ForcePrompts
from stages.core.physics.keypoints import choose_keypoints
from stages.core.physics.materials import Material
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.shapes import Surface, box, to_gaussians
from stages.simulate import engine_choice
from stages.simulate.engine_choice import droop, for_engine, impact, sag, with_engine
from stages.simulate.options import SimulateOptions
from tests.conftest import two_balls_scene


def chosen(**options):
    scene = two_balls_scene()
    return with_engine(SimulateOptions(**options), scene, choose_keypoints(scene, 32)).engine


@pytest.mark.parametrize(("options", "engine"), [
    ({}, "rigid"), ({"material": ("1=pillow",)}, "mpm"), ({"material": ("1=pillow", "2=sand")}, "mpm"),
    ({"material": ("1=pillow",), "gravity": 0.0}, "rigid"), ({"integrator": "rk4"}, "ngff"),
    ({"engine": "mpm", "material": ("1=steel",)}, "mpm"),
])  # fmt: skip
def test_the_softest_object_decides(options, engine):
    assert chosen(**options) == engine


def test_what_is_a_hundred_times_larger_is_softer():
    scene = two_balls_scene()
    large = replace(scene, scale={"metres_per_unit": 100.0})
    assert with_engine(SimulateOptions(), large, choose_keypoints(large, 32)).engine == "mpm"


@pytest.mark.parametrize(("speed", "lift", "engine"), [(-1.0, 0.0, "rigid"), (-4.0, 0.0, "mpm"), (0.0, 0.7, "mpm")])
def test_what_an_impact_compresses_is_soft(speed, lift, engine):
    """With E = 8e5 and 600 kg/m^3, 3.65 m/s or a fall of 0.68 m compresses by 10 %. The name has no influence."""
    scene = two_balls_scene()
    prompts = ForcePrompts(velocity={1: (0.0, 0.0, speed)}, lift={1: lift})
    options = SimulateOptions(material=("1=ball",))
    assert with_engine(options, scene, choose_keypoints(scene, 32), prompts).engine == engine
    assert impact(Material(E=8e5, density=600.0), 3.651) == pytest.approx(0.1, rel=1e-3)


@pytest.mark.parametrize("why", ["photos", "live"])
def test_impacts_alone_do_not_take_mpm_where_it_is_not_suitable(why):
    scene = two_balls_scene()
    scene = replace(scene, provenance={"command": "reconstruct"}) if why == "photos" else scene
    options, prompts = SimulateOptions(material=("1=ball",), live=why == "live"), ForcePrompts(lift={1: 0.7})
    assert with_engine(options, scene, choose_keypoints(scene, 32), prompts).engine == "rigid"


@pytest.mark.parametrize(("named", "engine"), [("rubber", "mpm"), ("", "rigid")])
def test_what_is_not_known_is_rigid(named, engine):
    """At 100 m/s rubber and the default material are both compressed by more than 10 %."""
    scene = two_balls_scene()
    scene = replace(scene, objects=tuple(replace(o, name=f"object {o.id}", material=named) for o in scene.objects))
    prompts = ForcePrompts(velocity={1: (0.0, 0.0, -100.0)})
    assert with_engine(SimulateOptions(), scene, choose_keypoints(scene, 32), prompts).engine == engine


@pytest.mark.parametrize(("material", "prompts", "engine"), [
    ("pillow", ForcePrompts(velocity={2: (0.0, 0.5, 0.0)}), "mpm"),
    ("pillow", ForcePrompts((Force(2, force=(0.1, 0.0, 0.0)),)), "mpm"),
    ("pillow", ForcePrompts((Force(2, force=(0.0, 0.0, 5.0)),), lift={1: 0.1}), "ngff"),
    ("wood", ForcePrompts(velocity={2: (0.0, 0.5, 0.0)}), "rigid"),
])  # fmt: skip
@pytest.mark.parametrize("why", ["photos", "live"])
def test_soft_bodies_slide_by_the_engine_that_has_friction(why, material, prompts, engine):
    """Any object slides beside a soft one; the learned field would stop all of them after the same distance."""
    scene = two_balls_scene()
    scene = replace(scene, provenance={"command": "reconstruct"}) if why == "photos" else scene
    options = SimulateOptions(material=(f"1={material}",), live=why == "live")
    assert with_engine(options, scene, choose_keypoints(scene, 32), prompts).engine == engine


def block(sides: tuple, bottom: float) -> Surface:
    return box(sides, max(sides) / 20).moved((0.0, 0.0, bottom + sides[2] / 2))


def of_two(lower: Surface, upper: Surface) -> Scene:
    parts = [to_gaussians(s, torch.full((len(s.points), 3), 0.5), i + 1, widest=math.inf)
             for i, s in enumerate((lower, upper))]  # fmt: skip
    return Scene(concatenate(parts), (SceneObject(1, "lower"), SceneObject(2, "upper")), None, 0.0)


@pytest.mark.parametrize(("density", "lift", "engine"), [(20, 0.0, "rigid"), (800, 0.0, "mpm"), (100, 0.5, "mpm")])
def test_what_is_above_a_soft_body_compresses_it(tmp_path, density, lift, engine):
    """A cube of foam with E = 1e4 Pa under a cube with half its side.

    Its own weight compresses it by 0.015, that of the other cube by density g 0.15 / E = 0.003 or 0.118. A cube of
    100 kg/m^3 that falls 0.5 m has the speed 3.1 m/s and compresses it by 3.1 sqrt(100 / 2 / E) = 0.22.
    """
    scene = of_two(block((0.3,) * 3, 0.0), block((0.15,) * 3, 0.3))
    (tmp_path / "m.json").write_text(json.dumps({"1": {"E": 1e4, "density": 50}, "2": {"E": 1e9, "density": density}}))
    options = SimulateOptions(materials=tmp_path / "m.json")
    keypoints, prompts = choose_keypoints(scene, 256), ForcePrompts(lift={2: lift})
    assert with_engine(options, scene, keypoints, prompts).engine == engine
    beside = replace(keypoints, rest=keypoints.rest + (keypoints.object_id == 2)[:, None] * torch.tensor([0.3, 0, 0]))
    assert with_engine(options, scene, beside, prompts).engine == "rigid"


@pytest.mark.parametrize(("force", "engine"), [(0.9, "rigid"), (1.1, "mpm")])
def test_a_force_compresses_a_soft_body(tmp_path, force, engine):
    """On a face of 0.1 x 0.1 m and with E = 1e4 Pa, 1 N compresses by 0.01, 2 N by 0.02."""
    scene = of_two(block((0.1,) * 3, 0.0), block((0.1,) * 3, 0.3))
    (tmp_path / "m.json").write_text(json.dumps({"1": {"E": 1e4, "density": 20}, "2": {"E": 1e9, "density": 1}}))
    options = SimulateOptions(materials=tmp_path / "m.json")
    prompts = ForcePrompts((Force(1, force=(0.0, 2 * force, 0.0)), Force(2, force=(0.0, 9.0, 0.0))))
    assert with_engine(options, scene, choose_keypoints(scene, 256), prompts).engine == engine


@pytest.mark.parametrize(("bottom", "engine"), [(0.25, "mpm"), (0.0, "rigid")])
def test_a_cloth_that_is_off_the_floor_bends(bottom, engine):
    scene = of_two(block((0.2,) * 3, 0.0), block((0.5, 0.5, 0.02), bottom))
    keypoints = choose_keypoints(scene, 256)
    assert with_engine(SimulateOptions(material=("2=cloth",)), scene, keypoints).engine == engine
    assert with_engine(SimulateOptions(material=("2=wood",)), scene, keypoints).engine == "rigid"


def test_droop_of_a_cantilever():
    """w L^4 / (8 E I), divided by L, with w = rho g b t and I = b t^3 / 12."""
    assert droop(Material(E=1e6, density=1000.0), [0.01, 0.1, 0.4], 10.0) == pytest.approx(
        1000 * 10 * 0.1 * 0.01 * 0.2**4 / (8 * 1e6 * 0.1 * 0.01**3 / 12) / 0.2)  # fmt: skip


def test_sag_of_a_column():
    """A column of height h is compressed by rho g h / 2 E on average and rho g h / E at its base."""
    assert sag(Material(E=1e5, density=1000.0), 0.5, 10.0) == pytest.approx(0.05)


def test_a_part_that_is_pinned_holds_the_whole_of_an_object_but_in_mpm(tmp_path, caplog):
    caplog.set_level(logging.WARNING, logger="stages")  # earlier commands may have set it to INFO
    file = tmp_path / "m.json"
    parts = [{"below": 0.1, "material": "steel", "pinned": True}, {"material": "soft"}]
    file.write_text(json.dumps({"1": {"parts": parts}, "2": {"parts": [{"below": 1, "material": "wood"}, parts[1]]}}))
    scene, prompts = two_balls_scene(), ForcePrompts(pinned=frozenset({7}))
    options = SimulateOptions(materials=file)
    assert with_engine(options, scene, choose_keypoints(scene, 32)).engine == "mpm"  # because of its parts
    assert for_engine(prompts, scene, replace(options, engine="mpm")) == prompts and not caplog.text
    assert for_engine(prompts, scene, replace(options, engine="rigid")).pinned == {1, 7}
    first, second = caplog.messages
    assert "object 1 (red ball): --engine rigid supports one material" in first
    assert "and holds the whole object fixed" in first
    assert "object 2" in second and "pins" not in second
    assert for_engine(prompts, scene, SimulateOptions(engine="rigid")) == prompts


@pytest.mark.parametrize(("lift", "velocity", "unit", "speed"), [
    (0.5, (0.0, 0.0, 0.0), 1.0, (2 * 9.81 * 0.5) ** 0.5), (-0.5, (3.0, 0.0, 4.0), 1.0, 5.0),
    (0.5, (0.0, 3.0, 4.0), 2.0, (100 + 2 * 9.81) ** 0.5),
])  # fmt: skip
def test_speed_after_a_fall_in_metres(lift, velocity, unit, speed):
    scene = replace(two_balls_scene(), scale={"metres_per_unit": unit})
    prompts = ForcePrompts(lift={1: lift}, velocity={1: velocity})
    assert engine_choice._speed(scene, 1, prompts, SimulateOptions()) == pytest.approx(speed)
    assert engine_choice._speed(scene, 2, prompts, SimulateOptions()) == 0
