"""scene.ply to traj.h5: what moves, what stays, and what goes wrong."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from stages.core.errors import InputError
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.materials import DEFAULT_MATERIAL
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.trajectory import Trajectory, read_trajectory
from stages.simulate import mpm as engine
from stages.simulate.options import QUALITIES, MpmQuality, SimulateOptions
from stages.simulate.setup import set_up_scene
from stages.simulate.stage import run, with_objects
from tests.conftest import ball

# The ball weighs about 9 kg and touches in one point: by Hertz it gives way by 5 mm, twice that where it swings, and by
# a few tenths of a cell (here 5 cm) until enough particles carry it.
SAG = 0.025


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setitem(QUALITIES, "draft", MpmQuality(particles=1200, substep=8e-4))


@pytest.fixture
def balls(tmp_path) -> Path:
    """A ball standing on the floor and one in the air, and a patch of floor."""
    patch = ball((0.0, 0.0, -0.3), 0.05, 50, (0.5, 0.5, 0.5), 0)
    low = ball((-0.3, 0.0, 0.15), 0.15, 600, (0.9, 0.1, 0.1), 1)
    high = ball((0.3, 0.0, 0.50), 0.12, 600, (0.1, 0.8, 0.1), 2, seed=1)
    objects = (SceneObject(1, "red ball"), SceneObject(2, "thing"))
    path = tmp_path / "scene.ply"
    write_scene(path, Scene(concatenate([patch, low, high]), objects, None, 0.0))
    return path


def roll(scene: Path, **options) -> Trajectory:
    out = scene.with_name("traj.h5")
    chosen = {"engine": "mpm", "quality": "draft", "steps": 6, "keypoints": 64, "device": "cpu"}
    run(scene, out, SimulateOptions(**{**chosen, **options}))
    return read_trajectory(out)


def shift(t: Trajectory, id: int, frame: int = -1) -> torch.Tensor:
    mine = t.keypoints.object_id == id
    return (t.positions[frame, mine] - t.keypoints.rest[mine]).mean(0)


def test_the_first_frame_is_the_scene_and_falling_is_a_parabola(balls, caplog):
    caplog.set_level(logging.INFO)
    t = roll(balls)
    assert len(t) == 6 and t.info.gravity == (0.0, 0.0, pytest.approx(-9.81))
    assert torch.equal(t.positions[0], t.keypoints.rest)
    assert torch.allclose(t.rotation[0], torch.tensor([1.0, 0, 0, 0]), atol=1e-5)
    assert float(shift(t, 2)[2]) == pytest.approx(-9.81 * 0.1**2 / 2, rel=0.02)
    assert float(t.com[-1, 1, 2] - t.com[0, 1, 2]) == pytest.approx(-9.81 * 0.1**2 / 2, rel=0.02)
    assert shift(t, 1).norm() < SAG  # stands
    assert (t.binding.index[t.scene.gaussians.object_id == 0] == -1).all()
    assert f"material not known, taking {DEFAULT_MATERIAL}" in caplog.text and "substep" in caplog.text
    assert t.scene.provenance["command"] == "simulate"


def test_same_seed_same_bytes(balls):
    assert torch.equal(roll(balls, steps=4).positions, roll(balls, steps=4).positions)


def test_scene_units_that_are_not_metres(balls):
    scene = read_scene(balls)
    write_scene(balls, replace(scene, scale={"metres_per_unit": 0.5, "source": "test"}))
    t = roll(balls)
    assert t.info.gravity[2] == pytest.approx(-2 * 9.81)
    assert float(shift(t, 2)[2]) == pytest.approx(-2 * 9.81 * 0.1**2 / 2, rel=0.02)


def test_lift_velocity_and_pin(balls):
    t = roll(balls, lift=("0.2",), velocity=("object=thing 1,0,0",), pin=("1",))
    assert torch.allclose(shift(t, 1, 0), torch.tensor([0, 0, 0.2]), atol=1e-6)
    assert torch.equal(t.positions[0][t.keypoints.object_id == 1], t.positions[-1][t.keypoints.object_id == 1])
    assert float(shift(t, 2)[0]) == pytest.approx(0.1, rel=0.01)
    assert {f["kind"] for f in t.info.forces} == {"lift", "velocity", "pin"}


def test_a_push_of_known_impulse(balls):
    # F t = m v: a push of 2 m newtons for 0.05 s (ending inside a frame) gives 0.1 m/s
    masses = {}
    handler = logging.Handler()
    handler.emit = lambda record: masses.update({record.getMessage().split()[1]: record.getMessage()})
    logging.getLogger("stages.simulate.mpm").addHandler(handler)
    logging.getLogger("stages.simulate.mpm").setLevel(logging.INFO)
    roll(balls, steps=1)
    logging.getLogger("stages.simulate.mpm").removeHandler(handler)
    mass = float(masses["2"].split(", ")[1].split()[0])
    t = roll(balls, gravity=0.0, force=(f"object=2 force={2 * mass},0,0 from=0.01 to=0.06",))
    assert float((t.com[-1, 1] - t.com[-2, 1])[0] / 0.02) == pytest.approx(0.1, rel=0.02)


def test_a_torque_turns_and_a_push_off_centre_too(balls):
    spun = roll(balls, gravity=0.0, force=("object=2 torque=0,0,0.5 to=0.04",))
    assert float(spun.rotation[-1, 1, 3]) > 0.02 and (spun.com[-1, 1] - spun.com[0, 1]).norm() < 1e-3
    hit = roll(balls, gravity=0.0, force=("object=2 force=5,0,0 at=0.3,-0.12,0.5 to=0.04",))
    assert float(hit.rotation[-1, 1, 3]) > 0.005 and float(hit.com[-1, 1, 0] - hit.com[0, 1, 0]) > 0


def test_stiff_materials_are_softened_by_name(balls, caplog):
    caplog.set_level(logging.INFO)
    roll(balls, steps=2, material=("thing=steel",))
    assert "object 2 (thing): steel" in caplog.text and "2.1e+11 softened to" in caplog.text


@pytest.mark.parametrize(("gap", "told"), [(0.0, True), (0.3, False)])
def test_a_push_on_what_leans_on_another_is_told_to_be_held(tmp_path, caplog, gap, told):
    """Two boards back to back touch with half of their matter; a hand's breadth apart they do not."""
    u = torch.cartesian_prod(torch.linspace(-0.15, 0.15, 25), torch.linspace(0.02, 0.32, 25))
    low, high = (ball((x, 0.0, 0.2), 0.1, len(u), (0.5, 0.5, 0.5), i) for i, x in ((1, 0.0), (2, 0.0)))
    low.means[:] = torch.cat([torch.zeros(len(u), 1), u], 1)
    high.means[:] = low.means + torch.tensor([0.05 + gap, 0.0, 0.0])
    path = tmp_path / "boards.ply"
    write_scene(path, Scene(concatenate([low, high]), (SceneObject(1, "a"), SceneObject(2, "b")), None, 0.0))
    roll(path, steps=1, force=("object=2 force=1,0,0",))
    assert ("object 2 (b) touches 1" in caplog.text) == told and "object 1 (a) touches" not in caplog.text


def test_nothing_moves_gives_a_hint(balls, caplog):
    caplog.set_level(logging.INFO)
    roll(balls, steps=3, gravity=0.0)
    assert "everything is at rest" in caplog.text and "--lift 0.3" in caplog.text


def test_a_scene_without_floor_gets_one(balls, caplog):
    caplog.set_level(logging.INFO)
    write_scene(balls, replace(read_scene(balls), floor=None))
    assert shift(roll(balls, steps=4), 1).norm() < SAG
    assert "no floor" in caplog.text


def test_a_little_above_or_in_the_floor_is_settled_without_a_jump(balls):
    for floor in (-0.015, 0.03):
        t = roll(balls, floor=floor, steps=10)
        assert shift(t, 1).norm() < SAG and torch.equal(t.positions[0], t.keypoints.rest)


def test_objects_that_overlap_do_not_explode(tmp_path):
    a, b = ball((0, 0, 0.15), 0.15, 600, (1, 0, 0), 1), ball((0.1, 0, 0.15), 0.15, 600, (0, 1, 0), 2, seed=1)
    path = tmp_path / "overlap.ply"
    write_scene(path, Scene(concatenate([a, b]), (SceneObject(1, "duck"), SceneObject(2, "phone")), None, 0.0))
    t = roll(path, steps=15)
    speed = (t.positions[1:] - t.positions[:-1]).norm(dim=2) / 0.02
    assert float(speed.max()) < 1.5  # they slump under gravity (less than 2 g x 0.15 m), nothing is thrown


def test_a_run_that_goes_wrong_names_object_time_and_remedy_and_keeps_its_frames(balls, monkeypatch):
    advance = engine.mpm.Solver.advance

    def fails_later(self, duration, push):
        self.calls = getattr(self, "calls", 0) + 1
        if self.calls == 3:
            raise engine.mpm.Diverged(len(push) - 1)
        return advance(self, duration, push)

    monkeypatch.setattr(engine.mpm.Solver, "advance", fails_later)
    with pytest.raises(InputError, match=r"object 2 \(thing\).* at 0.04 s.*--quality"):
        roll(balls)
    assert not balls.with_name("traj.h5").exists()
    assert len(read_trajectory(balls.with_name("traj.partial.h5"))) == 3


@pytest.mark.parametrize("box, message", [
    ("1,2,3", "x0,y0,z0,x1,y1,z1"), ("0,0,0,1,1,x", "three numbers"), ("1,0,0,0,1,1", "first corner"),
    ("0,-1,0,1,1,1", r"object 1 \(red ball\) is not inside"),
])  # fmt: skip
def test_wrong_boxes(balls, box, message):
    with pytest.raises(InputError, match=message):
        roll(balls, box=box)


def test_the_box_holds(balls):
    t = roll(balls, steps=20, box="-0.6,-0.4,0,0.6,0.4,1", velocity=("object=2 2,0,0",), material=("thing=rubber",))
    mine = t.keypoints.object_id == 2
    assert float(t.positions[:, mine, 0].max()) < 0.6 + 2 * 0.065  # walls are good to two cells


@pytest.mark.parametrize("options, message", [
    ({"quality": "best"}, "draft, normal, high"), ({"steps": 0}, "at least 1"), ({"dt": 0.0}, "--dt"),
    ({"gravity": float("nan")}, "--gravity"), ({"friction": -1.0}, "--friction"), ({"keypoints": 2}, "--keypoints"),
    ({"floor": float("inf")}, "--floor"),
])  # fmt: skip
def test_wrong_options(options, message):
    with pytest.raises(InputError, match=message):
        SimulateOptions(**options)


def test_an_unknown_engine(balls):
    with pytest.raises(InputError, match="no backend called 'magic'; choose from ngff, mpm"):
        roll(balls, engine="magic")


def test_at_twice_the_resolution_bodies_stand_where_they_did(balls):
    scene, options = with_objects(read_scene(balls), balls), SimulateOptions(quality="draft")
    stage = set_up_scene(scene, ForcePrompts(), options)
    fine = set_up_scene(scene, ForcePrompts(), options, True)
    assert fine.bodies.spacing == stage.bodies.spacing / 2 and len(fine.start) > 6 * len(stage.start)
    # both stand on the floor, as seen
    for s in (stage, fine):
        assert float(s.start[s.bodies.body == 0, 2].quantile(0.01)) == pytest.approx(1.5 * s.bodies.spacing, rel=0.3)


@pytest.mark.gpu
def test_on_a_gpu_bodies_fall_and_stand_as_on_a_cpu(balls):
    if not torch.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU")
    cpu, gpu = roll(balls), roll(balls, device="cuda", quality="normal")
    assert shift(gpu, 1).norm() < SAG
    assert float(shift(gpu, 2)[2]) == pytest.approx(float(shift(cpu, 2)[2]), rel=0.02)


@pytest.mark.parametrize("material", ["sand", "snow", "plasticine", "dough"])
def test_what_yields_falls_like_anything_else_and_sand_slumps(balls, material):
    t = roll(balls, material=(f"thing={material}", "1=sand"), steps=15)
    assert float(shift(t, 2, 5)[2]) == pytest.approx(-9.81 * 0.1**2 / 2, rel=0.03)
    assert float(t.com[-1, 0, 2]) < 0.8 * float(t.com[0, 0, 2])  # a ball of sand does not stay a ball
