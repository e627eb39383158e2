"""The engine that `--engine auto` stands for."""

from dataclasses import replace

import pytest

from stages.core.physics.forces import Force, ForcePrompts
from stages.core.physics.keypoints import choose_keypoints
from stages.core.physics.materials import Material
from stages.simulate.engine_choice import impact, sag, with_engine
from stages.simulate.options import SimulateOptions
from tests.conftest import two_balls_scene


def chosen(**options):
    scene = two_balls_scene()
    return with_engine(SimulateOptions(**options), scene, choose_keypoints(scene, 32)).engine


@pytest.mark.parametrize(("options", "engine"), [
    ({}, "rigid"), ({"material": ("1=pillow",)}, "ngff"), ({"material": ("1=pillow", "2=sand")}, "mpm"),
    ({"material": ("1=pillow",), "gravity": 0.0}, "rigid"), ({"integrator": "rk4"}, "ngff"),
    ({"engine": "mpm", "material": ("1=steel",)}, "mpm"),
])  # fmt: skip
def test_the_softest_object_decides(options, engine):
    assert chosen(**options) == engine


def test_what_is_a_hundred_times_larger_is_softer():
    scene = two_balls_scene()
    large = replace(scene, scale={"metres_per_unit": 100.0})
    assert with_engine(SimulateOptions(), large, choose_keypoints(large, 32)).engine == "ngff"


@pytest.mark.parametrize(("speed", "lift", "engine"), [(-1.0, 0.0, "rigid"), (-4.0, 0.0, "mpm"), (0.0, 0.7, "mpm")])
def test_what_an_impact_compresses_is_soft(speed, lift, engine):
    """Of E 8e5 and 600 kg/m^3: 3.65 m/s, or a fall of .68 m, compress it by a tenth. Its name does not matter."""
    scene = two_balls_scene()
    prompts = ForcePrompts(velocity={1: (0.0, 0.0, speed)}, lift={1: lift})
    options = SimulateOptions(material=("1=ball",))
    assert with_engine(options, scene, choose_keypoints(scene, 32), prompts).engine == engine
    assert impact(Material(E=8e5, density=600.0), 3.651) == pytest.approx(0.1, rel=1e-3)


@pytest.mark.parametrize(("material", "prompts", "engine"), [
    ("pillow", ForcePrompts(velocity={2: (0.0, 0.5, 0.0)}), "mpm"),
    ("pillow", ForcePrompts((Force(2, force=(0.1, 0.0, 0.0)),)), "mpm"),
    ("pillow", ForcePrompts((Force(2, force=(0.0, 0.0, 5.0)),), lift={1: 0.1}), "ngff"),
    ("wood", ForcePrompts(velocity={2: (0.0, 0.5, 0.0)}), "rigid"),
])  # fmt: skip
def test_soft_bodies_slide_by_the_engine_that_has_friction(material, prompts, engine):
    """A slide of any object, beside a soft one; the learned field stops all of them after the same distance."""
    scene = two_balls_scene()
    options = SimulateOptions(material=(f"1={material}",))
    assert with_engine(options, scene, choose_keypoints(scene, 32), prompts).engine == engine


def test_sag_of_a_column():
    """A column of height h is compressed by rho g h / 2 E on average and rho g h / E at its base."""
    assert sag(Material(E=1e5, density=1000.0), 0.5, 10.0) == pytest.approx(0.05)
