import math
from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.models.checkpoints import SHIPPED, build, find, save
from stages.core.models.field.solidity import box_sides
from stages.core.models.initial_conditions import FLOOR, InitialConditions
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.trajectory import read_trajectory
from stages.simulate.learned import ModelUnits, _known_stiffness, _warn
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run
from tests.conftest import ball


@pytest.fixture(scope="module")
def untrained(tmp_path_factory):
    """Weights of a tiny force field: whatever it has learned, free fall and pins are built in."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    save(path, "ngff", build("ngff", hidden=8), {"warning": "knows nothing"})
    return path


def roll(scene, tmp_path, untrained, **options):
    write_scene(tmp_path / "scene.ply", scene)
    chosen = {"steps": 6, "engine": "ngff", "weights": untrained, "keypoints": 40, "quality": "draft", "device": "cpu"}
    run(tmp_path / "scene.ply", tmp_path / "t.h5", SimulateOptions(**{**chosen, **options}))
    return read_trajectory(tmp_path / "t.h5")


def shift(t, row, frame=-1):
    return t.com[frame, row] - t.com[0, row]


@pytest.mark.parametrize("unit", [1.0, 0.1])
def test_free_fall_is_right_at_any_scale(two_balls, tmp_path, untrained, unit):
    scene = replace(two_balls, scale={"metres_per_unit": unit, "source": "test"})
    t = roll(scene, tmp_path, untrained, lift=("2=2",))
    assert torch.equal(t.positions[0, t.keypoints.object_id == 1], t.keypoints.rest[t.keypoints.object_id == 1])
    assert shift(t, 1).tolist() == pytest.approx([0, 0, -9.81 / unit * 0.1**2 / 2], rel=1e-3, abs=1e-4)
    assert t.info.engine == "ngff"


def test_a_throw_and_a_push_in_flight(two_balls, tmp_path, untrained, caplog):
    t = roll(two_balls, tmp_path, untrained, lift=("3",), velocity=("object=1 1,0,0",), gravity=0.0,
             force=("object=2 force=0,0,6",))  # fmt: skip
    assert shift(t, 0).tolist() == pytest.approx([0.1, 0, 0], abs=1e-3)
    fall = roll(two_balls, tmp_path, untrained, lift=("3",), gravity=0.0, force=("object=2 force=0,0,12",))
    assert float(shift(t, 1)[2]) > 1e-4
    assert float(shift(fall, 1)[2]) == pytest.approx(2 * float(shift(t, 1)[2]), rel=0.02)
    assert "knows nothing" in caplog.text


def test_pinned_objects_stay_and_fewer_frames_a_second_are_the_same_motion(two_balls, tmp_path, untrained):
    t = roll(two_balls, tmp_path, untrained, lift=("2=2",), pin=("1",))
    assert shift(t, 0).norm() < 1e-5
    coarse = roll(two_balls, tmp_path, untrained, lift=("2=2",), pin=("1",), dt=0.05, steps=3)
    assert float(shift(coarse, 1)[2]) == pytest.approx(float(shift(t, 1)[2]), rel=0.01)
    assert math.isclose(coarse.info.dt, 0.05)


def test_what_stands_deeper_is_not_lifted_into_what_stands_beside_it(tmp_path):
    """A seat sags: a ball 12 cm below the plane, under the belly of a larger one. A breath of force wakes both."""
    high, low = ball((0, 0, 0.15), 0.15, 600, (1, 0, 0), 1), ball((0.2, 0, -0.02), 0.1, 600, (0, 1, 0), 2, seed=1)
    scene = Scene(concatenate([high, low]), (SceneObject(1, "ball"), SceneObject(2, "ball")), None, 0.0)
    wake = tuple(f"object={i} force=0,0,0.01 to=0.02" for i in (1, 2))
    t = roll(scene, tmp_path, None, keypoints=128, steps=15, force=wake)
    assert torch.equal(t.positions[0], t.keypoints.rest)
    assert float((t.com - t.com[0]).norm(dim=-1).max()) < 0.02


def elsewhere(scene, unit, floor):
    """The same things in units of `unit` metres, on a floor at another height."""
    g = scene.gaussians
    up = torch.tensor([0.0, 0.0, floor])
    g = replace(g, means=g.means / unit + up, scales=g.scales / unit)
    return replace(scene, gaussians=g, cameras=None, floor=floor, scale={"metres_per_unit": unit, "source": "test"})


@pytest.mark.parametrize(("unit", "floor", "apart"), [(0.1, 0.0, 1e-4), (1.0, 7.0, 0.02)])
def test_units_and_the_height_of_the_floor_do_not_matter(two_balls, tmp_path, unit, floor, apart):
    """With the weights that ship. Where the floor cuts the voxels (of 2 cm) that decide on what lies on it moves."""
    shipped = find("ngff", SHIPPED)
    here = roll(two_balls, tmp_path, shipped, steps=8)
    there = roll(elsewhere(two_balls, unit, floor), tmp_path, shipped, steps=8)
    moved = here.positions - here.positions[0]
    assert moved.norm(dim=-1).max() > 0.02  # the green ball falls, the red one lies
    torch.testing.assert_close(unit * (there.positions - there.positions[0]), moved, rtol=0, atol=apart)


@pytest.mark.parametrize(("size", "scale"), [(0.5, 1.0), (0.26, 1.0), (0.05, 11.0), (5.5, 0.1)])
def test_things_of_sizes_known_from_training_keep_their_size(size, scale):
    cube = size * torch.tensor([[0.0, 0, 0], [1, 1, 1]])
    frame = ModelUnits.for_objects([cube, cube], 2.0, 1.0, 5.0)
    assert frame.length == pytest.approx(scale, rel=1e-4) and frame.mass == pytest.approx(scale**3, rel=1e-3)
    assert frame.time == pytest.approx(scale**0.5, rel=1e-3) and frame.stress == pytest.approx(scale, rel=1e-3)
    assert float(frame.to_model(torch.tensor([0.0, 0, 2.0]))[2]) == pytest.approx(FLOOR)


class Deaf:
    inputs = frozenset({"mass", "E", "friction"})


@pytest.mark.parametrize(("change", "says"), [
    ({"count": 7}, "7 objects; the model was tested with up to 6"), ({"speed": 9.0}, "faster than any in training"),
    ({"flat": 0.05}, "thinner than any in training"), ({"grow": 8.0}, "times as long as the smallest"),
    ({}, "not told the gravity"),
])  # fmt: skip
def test_what_was_not_seen_in_training_is_warned_of(caplog, change, says):
    count = change.get("count", 3)
    points = 0.3 * torch.rand(1, count, 50, 3, generator=torch.Generator().manual_seed(0))
    points[:, 0, :2] = torch.tensor([[0.0, 0, 0], [0.3, 0.3, 0.3]])
    points[:, 1, :2] = points[:, 0, :2]
    points[:, 0] *= change.get("grow", 1.0)
    points[:, 1, :, 2] *= change.get("flat", 1.0)
    velocity = torch.tensor([change.get("speed", 0.0), 0, 0])
    _warn(InitialConditions.of(points, velocity=velocity), Deaf())
    assert len(caplog.records) == (1 if not change else 2)
    assert says in caplog.text


def test_what_is_softer_than_in_training_is_the_softest_there_and_said(caplog):
    o = SceneObject(1, "thing")
    assert [_known_stiffness(o, E, 1.0) for E in (2e3, 1e5, 7e10)] == [3e3, 1e5, 7e10]
    assert _known_stiffness(o, 500.0, 8.0) == 500 and not caplog.records  # solid bodies bend less
    assert _known_stiffness(o, 50.0, 8.0) == 3e3 / 8
    assert len(caplog.records) == 1


def test_what_flows_is_for_mpm(two_balls, tmp_path, untrained, caplog):
    roll(two_balls, tmp_path, untrained, material=("1=sand",), steps=2)
    assert "object 1 (red ball): sand yields or flows" in caplog.text and "--engine mpm" in caplog.text


@pytest.mark.parametrize("name", ["rubber", "soft"])
def test_a_solid_ball_lands_and_keeps_its_shape(two_balls, tmp_path, name):
    """With the weights that ship, from 0.3 m; hollow bodies as soft as that stay crumpled."""
    t = roll(two_balls, tmp_path, find("ngff", SHIPPED), lift=("0.3",), material=(f"1={name}", f"2={name}"), steps=50)
    for i in (1, 2):
        points = t.positions[:, t.keypoints.object_id == i]
        spread = torch.stack([box_sides(points[frame]) for frame in (0, -1)])
        assert (spread[1] / spread[0] - 1).abs().max() < 0.05
        assert points[-1, :, 2].min() > -0.03


def test_missing_weights_are_said(two_balls, tmp_path):
    with pytest.raises(InputError, match="nowhere.safetensors"):
        roll(two_balls, tmp_path, tmp_path / "nowhere.safetensors")


@pytest.mark.parametrize("method", ["euler", "rk4", "dopri5"])
def test_an_ode_solver_can_replace_the_step_of_the_model(two_balls, tmp_path, method):
    torch.manual_seed(0)
    path = tmp_path / "gcn.safetensors"
    save(path, "gcn", build("gcn", hidden=8, layers=2))
    options = {"steps": 4, "velocity": ("object=1 0.1,0,0",), "lift": ("2",)}
    own, solved = (roll(two_balls, tmp_path, path, integrator=m, **options) for m in ("step", method))
    difference = float((own.positions - solved.positions).abs().max())
    moved = float((own.positions[-1] - own.positions[0]).norm(dim=1).max())
    assert moved > 1e-3
    assert difference < 1e-5 if method == "euler" else 1e-7 < difference < 0.2 * moved


def test_mpm_takes_no_ode_solver():
    with pytest.raises(InputError, match="only for learned engines"):
        SimulateOptions(engine="mpm", integrator="rk4")
    with pytest.raises(InputError, match="choose from step, euler"):
        SimulateOptions(integrator="midpoint")
