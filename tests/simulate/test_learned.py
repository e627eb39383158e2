"""The learned engine: scaling to the training data, force prompts and warnings."""

import json
import logging
import math
import re
from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.models.checkpoints import SHIPPED, build, find, save
from stages.core.models.dynamics import FRAME
from stages.core.models.field.solidity import box_sides
from stages.core.models.initial_conditions import FLOOR, InitialConditions
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.trajectory import read_trajectory
from stages.simulate.learned import MAX_SPEED, _model_stiffness, _warn_extrapolation
from stages.simulate.model_units import TYPICAL_MASS, TYPICAL_SIZE, ModelUnits
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run
from tests.conftest import ball, two_balls_scene
from tests.simulate.motion import roll_out

pytestmark = pytest.mark.usefixtures("device")


@pytest.fixture(scope="module")
def untrained(tmp_path_factory):
    """Weights of a small untrained force field; free fall, forces and pins must not depend on training."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    save(path, "ngff", build("ngff", hidden=8), {"warning": "untrained"})
    return path


@pytest.fixture(scope="module")
def two_balls():
    return two_balls_scene()


def options_with(weights, **options):
    chosen = {"steps": 6, "engine": "ngff", "weights": weights, "keypoints": 40, "quality": "draft"}
    return SimulateOptions(**{**chosen, **options})


def roll(scene, weights, **options):
    return roll_out(scene, options_with(weights, **options))


def com_shift(t, row, frame=-1):
    return t.com[frame, row] - t.com[0, row]


@pytest.mark.parametrize("unit", [pytest.param(1.0, marks=pytest.mark.slow), 0.1])
def test_free_fall_at_any_scale(two_balls, tmp_path, untrained, unit):
    """Run as a stage, from file to file."""
    write_scene(tmp_path / "scene.ply", replace(two_balls, scale={"metres_per_unit": unit, "source": "test"}))
    run(tmp_path / "scene.ply", tmp_path / "t.h5", options_with(untrained, lift=("2=2",)))
    t = read_trajectory(tmp_path / "t.h5")
    assert torch.equal(t.positions[0, t.keypoints.object_id == 1], t.keypoints.rest[t.keypoints.object_id == 1])
    assert com_shift(t, 1).tolist() == pytest.approx([0, 0, -9.81 / unit * 0.1**2 / 2], rel=1e-3, abs=1e-4)
    assert t.info.engine == "ngff" and t.info.gravity == (0, 0, pytest.approx(-9.81 / unit))
    assert math.isclose(t.info.dt, 0.02)


def test_velocity_and_force_in_flight(two_balls, untrained, caplog):
    caplog.set_level(logging.INFO)
    t = roll(two_balls, untrained, lift=("3",), velocity=("object=1 1,0,0",), gravity=0.0,
             force=("object=2 force=0,0,6",))  # fmt: skip
    assert com_shift(t, 0).tolist() == pytest.approx([0.1, 0, 0], abs=1e-3)
    double = roll(two_balls, untrained, lift=("3",), gravity=0.0, force=("object=2 force=0,0,12",))
    assert float(com_shift(t, 1)[2]) > 1e-4
    assert float(com_shift(double, 1)[2]) == pytest.approx(2 * float(com_shift(t, 1)[2]), rel=0.02)
    assert "untrained" in caplog.text and " kg if one unit is 1 m" in caplog.text


@pytest.mark.parametrize("unit", [pytest.param(1.0, marks=pytest.mark.slow), 0.1])
def test_newtons_kilograms_and_velocities_at_any_scale(untrained, caplog, unit):
    """F t^2 / 2 m for a ball of 540 kg/m^3, and a velocity in scene units per second, without gravity."""
    caplog.set_level(logging.INFO)
    parts = [ball((x, 0, 1.0), 0.15, 1500, (1, 0, 0), i, seed=i) for i, x in ((1, -1.0), (2, 1.0))]
    objects = (SceneObject(1, "thing", "common"), SceneObject(2, "thing", "common"))
    scene = Scene(concatenate(parts), objects, None, 0.0, {"metres_per_unit": unit, "source": "test"})
    newton = 20 * unit**4  # a force that causes comparable motion at both scales
    t = roll(scene, untrained, gravity=0.0, velocity=("object=1 1,2,0",),
             force=(f"object=2 force=0,0,{newton}",))  # fmt: skip
    assert com_shift(t, 0).tolist() == pytest.approx([0.1, 0.2, 0], abs=1e-3)
    volume = 4 / 3 * math.pi * (0.15 * unit) ** 3
    assert t.field.volume.tolist() == pytest.approx([volume] * 2, rel=0.08)  # the tolerance is for 1,500 points
    mass = 540 * float(t.field.volume[1])
    assert float(t.field.mass[1]) == pytest.approx(mass * t.field.units.mass, rel=1e-5)
    assert com_shift(t, 1).tolist() == pytest.approx([0, 0, newton * 0.1**2 / (2 * mass) / unit], rel=0.02, abs=1e-5)
    logged = float(re.search(r"object 2 \(thing\): common, ([\d.e-]+) (kg|g)", caplog.text)[1])
    logged /= 1000 if re.search(r"object 2 \(thing\): common, [\d.e-]+ g", caplog.text) else 1
    assert logged == pytest.approx(mass, rel=0.06)
    assert t.field.awake.tolist() == [1, 1]  # nothing holds them down


def test_pinned_objects_stay_and_frame_rate_does_not_matter(two_balls, untrained):
    t = roll(two_balls, untrained, lift=("2=2",), pin=("1",))
    assert com_shift(t, 0).norm() < 1e-5
    coarse = roll(two_balls, untrained, lift=("2=2",), pin=("1",), dt=0.05, steps=3)
    assert float(com_shift(coarse, 1)[2]) == pytest.approx(float(com_shift(t, 1)[2]), rel=0.01)
    fine = roll(two_balls, untrained, lift=("2=2",), dt=0.002, steps=1)
    # the smallest number for which no step exceeds FRAME
    for motion, dt in ((t, SimulateOptions().dt), (coarse, 0.05), (fine, 0.002)):
        frame, steps = dt * motion.field.units.time, motion.field.units.steps
        assert steps - 1 < frame / FRAME <= steps * (1 + 1e-5)


def test_an_object_far_below_the_floor_is_named(untrained, caplog):
    sunk = Scene(ball((0, 0, -0.5), 0.15, 600, (1, 0, 0), 1), (SceneObject(1, "ball"),), None, 0.0)
    roll(sunk, untrained, steps=1)
    raised = float(re.search(r"object 1 \(ball\) extends ([\d.]+) below the floor; it is placed on", caplog.text)[1])
    assert raised == pytest.approx(0.65, abs=0.05)


def test_objects_below_the_floor_are_not_lifted_into_others():
    """A ball is 12 cm below the plane (as on a soft seat), beside and under a larger one; small forces wake both."""
    high, low = ball((0, 0, 0.15), 0.15, 600, (1, 0, 0), 1), ball((0.2, 0, -0.02), 0.1, 600, (0, 1, 0), 2, seed=1)
    scene = Scene(concatenate([high, low]), (SceneObject(1, "ball"), SceneObject(2, "ball")), None, 0.0)
    small = tuple(f"object={i} force=0,0,0.01 to=0.02" for i in (1, 2))
    t = roll(scene, None, keypoints=128, steps=15, force=small)
    assert torch.equal(t.positions[0], t.keypoints.rest)
    assert float((t.com - t.com[0]).norm(dim=-1).max()) < 0.02


def transformed(scene, unit, floor):
    """The scene in units of `unit` [m], on a floor at a different height."""
    g = scene.gaussians
    up = torch.tensor([0.0, 0.0, floor])
    g = replace(g, means=g.means / unit + up, scales=g.scales / unit)
    return replace(scene, gaussians=g, cameras=None, floor=floor, scale={"metres_per_unit": unit, "source": "test"})


def test_units_and_floor_height_do_not_matter(two_balls):
    """With the shipped weights. The floor height shifts the voxels of 2 cm that define contact with the floor."""

    def motion(scene, unit=1.0):
        t = roll(scene, find("ngff", SHIPPED), steps=8, lift=(f"2={-0.23 / unit}",))  # down to 5 cm above the floor
        return unit * (t.positions - t.positions[0])

    here = motion(two_balls)
    assert here.norm(dim=-1).max() > 0.02  # the green ball lands, the red one is at rest
    for unit, floor, tolerance in ((0.1, 0.0, 1e-4), (1.0, 7.0, 0.02)):
        torch.testing.assert_close(motion(transformed(two_balls, unit, floor), unit), here, rtol=0, atol=tolerance)


@pytest.mark.parametrize("size", [0.005, 0.3, 50.0])
def test_scenes_are_brought_to_the_size_mass_and_gravity_of_training(size):
    cube = size * torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    units = ModelUnits.for_objects([cube, 4 * cube], torch.tensor([2.0, 8.0]), 2.0, 1.0, 10.0)
    assert units.length == pytest.approx(TYPICAL_SIZE / (2 * size)) and units.mass == pytest.approx(TYPICAL_MASS / 4)
    assert units.time == pytest.approx((2 * units.length) ** 0.5)  # follows from lengths and gravity
    # converts weight to weight
    assert units.force * 10 * 4 == pytest.approx(TYPICAL_MASS * 5 * units.mass * 4 / TYPICAL_MASS)
    middle = 1.25 * size  # the mean of all corners
    here = units.to_model(torch.tensor([middle, middle + 1, 3.0]))
    torch.testing.assert_close(here, torch.tensor([0.0, units.length, units.length + FLOOR]), atol=1e-4, rtol=1e-4)


def resized(scene, factor):
    g = scene.gaussians
    return replace(scene, gaussians=replace(g, means=factor * g.means, scales=factor * g.scales), cameras=None)


def test_size_and_unit_of_mass_do_not_matter(two_balls, tmp_path):
    """Exact symmetries: lengths and gravity times c with moduli times c^2, and masses with moduli times c.

    The motion, with the shipped weights, includes a collision with the floor. The remaining differences are from
    rounding, which contact amplifies, and from voxels with different origins.
    """
    scenes = {size: resized(two_balls, size) for size in (1.0, 0.01, 128.0)}

    def motion(size, mass):
        material = {"E": 2e6 * size**2 * mass, "density": 500.0 * mass, "loss": 0.1}
        (tmp_path / "m.json").write_text(json.dumps({"1": material, "2": material}))
        t = roll(scenes[size], find("ngff", SHIPPED), steps=12, gravity=9.81 * size, materials=tmp_path / "m.json",
                 lift=(f"{0.05 * size}",))  # fmt: skip
        return (t.positions - t.positions[0]) / size

    here = motion(1.0, 1.0)
    assert here.norm(dim=-1).max() > 0.1
    for size, mass in ((0.01, 1.0), (128.0, 16.0)):
        torch.testing.assert_close(motion(size, mass), here, rtol=0, atol=2e-3)


@pytest.mark.parametrize("shape", ["ball", "box"])
def test_solid_bodies_turn_as_solid_bodies(untrained, shape):
    """The angle is t^2 torque / (2 I) with the inertia of a filled body, to 8 % because of 1,500 points."""
    side, torque = 0.3, 0.02
    rng = torch.Generator().manual_seed(0)
    x = torch.randn(1500, 3, generator=rng)
    x = x / (2 * (x.norm(dim=1) if shape == "ball" else x.abs().amax(1))[:, None])
    if shape == "box":  # uniform on the faces
        x = torch.where(x.abs() == 0.5, x, torch.rand(1500, 3, generator=rng) - 0.5)
    g = replace(ball((0, 0, 0), side / 2, 1500, (1, 0, 0), 1), means=side * x + torch.tensor([0.0, 0, 1.0]))
    t = roll(Scene(g, (SceneObject(1, "thing", "common"),), None, 0.0), untrained, steps=7, gravity=0.0,
             force=(f"object=1 torque=0,0,{torque}",))  # fmt: skip
    start, end = (t.positions[i] - t.positions[i].mean(0) for i in (0, -1))
    u, _, v = torch.linalg.svd(end.T @ start)
    R = u @ v
    angle = math.atan2(float(R[1, 0] - R[0, 1]), float(R[0, 0] + R[1, 1]))
    # volume relative to the cube of the side, and I / (m side^2)
    volume, ratio = (math.pi / 6, 0.1) if shape == "ball" else (1.0, 1 / 6)
    inertia = ratio * side**2 * 540 * volume * side**3
    assert angle == pytest.approx(0.12**2 / 2 * torque / inertia, rel=0.08)


class WithoutGravity:
    inputs = frozenset({"mass", "E", "friction"})


@pytest.mark.parametrize(("change", "message"), [
    ({"count": 7}, "7 objects, but the model was tested with up to 6"),
    ({"speed": 9.0}, "a higher initial speed than any in training"),
    ({"speed": 0.7 * MAX_SPEED, "along": (1.0, 1.0, -1.0)}, "a higher initial speed than any in training"),
    ({"flat": 0.05}, "thinner than any in training"), ({"grow": 8.0}, "times as long as the smallest"),
    ({}, "does not take the gravity"),
])  # fmt: skip
def test_extrapolation_is_warned_of(caplog, change, message):
    count = change.get("count", 3)
    points = 0.3 * torch.rand(1, count, 50, 3, generator=torch.Generator().manual_seed(0))
    points[:, 0, :2] = torch.tensor([[0.0, 0, 0], [0.3, 0.3, 0.3]])
    points[:, 1, :2] = points[:, 0, :2]
    points[:, 0] *= change.get("grow", 1.0)
    points[:, 1, :, 2] *= change.get("flat", 1.0)
    velocity = torch.tensor(change.get("along", (1.0, 0, 0))) * change.get("speed", 0.0)
    _warn_extrapolation(InitialConditions.of(points, velocity=velocity), WithoutGravity())
    assert len(caplog.records) == (1 if not change else 2)
    assert message in caplog.text


def test_stiffness_is_bounded_by_the_softest_in_training(caplog):
    o = SceneObject(1, "thing")
    assert [_model_stiffness(o, E, 1.0) for E in (2e3, 1e5, 7e10)] == [3e3, 1e5, 7e10]
    assert _model_stiffness(o, 500.0, 8.0) == 500 and not caplog.records  # solid bodies are stiffer
    assert _model_stiffness(o, 50.0, 8.0) == 3e3 / 8
    assert len(caplog.records) == 1


def test_plastic_materials_are_warned_of(two_balls, untrained, caplog):
    roll(two_balls, untrained, material=("1=sand",), steps=2)
    assert "object 1 (red ball): sand yields or flows" in caplog.text and "--engine mpm" in caplog.text


@pytest.mark.parametrize(("first", "second"), [
    ("rubber", "soft"), pytest.param("soft", "rubber", marks=pytest.mark.slow),
])  # fmt: skip
def test_a_solid_ball_lands_and_keeps_its_shape(two_balls, first, second):
    """With the shipped weights, balls are dropped from 0.3 m and 0.6 m."""
    t = roll(two_balls, find("ngff", SHIPPED), lift=("0.3",), material=(f"1={first}", f"2={second}"), steps=50)
    for i in (1, 2):
        points = t.positions[:, t.keypoints.object_id == i]
        spread = torch.stack([box_sides(points[frame]) for frame in (0, -1)])
        assert (spread[1] / spread[0] - 1).abs().max() < 0.05
        assert points[-1, :, 2].min() > -0.03


def test_missing_weights(two_balls, tmp_path):
    with pytest.raises(InputError, match="nowhere.safetensors"):
        roll(two_balls, tmp_path / "nowhere.safetensors")


def test_an_ode_solver_can_replace_the_step_of_the_model(two_balls, tmp_path):
    torch.manual_seed(0)
    path = tmp_path / "gcn.safetensors"
    save(path, "gcn", build("gcn", hidden=8, layers=2))
    options = {"steps": 4, "velocity": ("object=1 0.1,0,0",), "lift": ("2",)}
    own = roll(two_balls, path, **options)
    moved = float((own.positions[-1] - own.positions[0]).norm(dim=1).max())
    assert moved > 1e-3
    for method in ("euler", "rk4", "dopri5"):
        solved = roll(two_balls, path, integrator=method, **options)
        difference = float((own.positions - solved.positions).abs().max())
        assert difference < 1e-5 if method == "euler" else 1e-7 < difference < 0.2 * moved, method


def test_mpm_takes_no_ode_solver():
    with pytest.raises(InputError, match="only works with learned engines"):
        SimulateOptions(engine="mpm", integrator="rk4")
    with pytest.raises(InputError, match="choose from step, euler"):
        SimulateOptions(integrator="midpoint")
