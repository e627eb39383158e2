"""ngff simulate: motion, force prompts, materials, reproducibility and errors."""

import json
import logging
import math
from dataclasses import fields, replace
from pathlib import Path

import h5py
import pytest
import torch

from stages.core.errors import InputError
from stages.core.kernels.mpm.constitutive import maxwell_branches
from stages.core.models.segmenter import segment as network_segmenter
from stages.core.models.segmenter.voxels import SCALES
from stages.core.physics import solid_surface
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.materials import DEFAULT_MATERIAL, Material
from stages.core.physics.mpm.domain import MAX_NODES
from stages.core.physics.recording import OPTIONS
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.trajectory import Trajectory, read_trajectory
from stages.segment.stage import run as segment
from stages.simulate import moving_grid
from stages.simulate import mpm as engine
from stages.simulate.mpm import _stable_material
from stages.simulate.options import QUALITIES, MpmQuality, SimulateOptions
from stages.simulate.setup import MIN_ROOM, _default_box, set_up_scene, tell_of_unseen_sides
from stages.simulate.stage import run, with_objects, with_recorded
from tests.conftest import ball
from tests.segment.tabletop import three_apart
from tests.simulate.motion import Motion, roll_out

# Sag of a resting ball: in point contact, a ball of 9 kg has an indentation of 5 mm (Hertz), twice as much if released
# suddenly, and sinks by a few tenths of a cell (here 5 cm) until enough particles carry it.
SAG = 0.025
pytestmark = pytest.mark.usefixtures("device")


@pytest.fixture(autouse=True)
def small_draft(monkeypatch):
    """Use few particles, and bodies of half the resolution."""
    monkeypatch.setitem(QUALITIES, "draft", MpmQuality(particles=1200, step=0.015))
    monkeypatch.setattr(solid_surface, "VOXELS_ALONG", 24)


@pytest.fixture(scope="module")
def balls() -> Scene:
    """A ball on the floor, a ball in the air, and background Gaussians."""
    patch = ball((0.0, 0.0, -0.3), 0.05, 50, (0.5, 0.5, 0.5), 0)
    low = ball((-0.3, 0.0, 0.15), 0.15, 600, (0.9, 0.1, 0.1), 1)
    high = ball((0.3, 0.0, 0.50), 0.12, 600, (0.1, 0.8, 0.1), 2, seed=1)
    return Scene(concatenate([patch, low, high]), (SceneObject(1, "red ball"), SceneObject(2, "thing")), None, 0.0)


@pytest.fixture
def file(balls, tmp_path) -> Path:
    write_scene(tmp_path / "scene.ply", balls)
    return tmp_path / "scene.ply"


def options_with(**options) -> SimulateOptions:
    chosen = {"engine": "mpm", "quality": "draft", "steps": 6, "keypoints": 64}
    return SimulateOptions(**{**chosen, **options})


def command(file: Path, **options) -> Trajectory:
    """Run the stage from file to file."""
    out = file.with_name("traj.h5")
    run(file, out, options_with(**options))
    return read_trajectory(out)


def roll(scene: Scene, **options) -> Motion:
    return roll_out(scene, options_with(**options))


def mean_shift(t: Motion | Trajectory, id: int, frame: int = -1) -> torch.Tensor:
    mine = t.keypoints.object_id == id
    return (t.positions[frame, mine] - t.keypoints.rest[mine]).mean(0)


def test_first_frame_is_the_scene_and_free_fall_is_a_parabola(file, caplog):
    caplog.set_level(logging.INFO)
    t = command(file)
    assert len(t) == 6 and t.info.gravity == (0.0, 0.0, pytest.approx(-9.81))
    assert torch.equal(t.positions[0], t.keypoints.rest)
    assert torch.allclose(t.rotation[0], torch.tensor([1.0, 0, 0, 0]), atol=1e-5)
    assert float(mean_shift(t, 2)[2]) == pytest.approx(-9.81 * 0.1**2 / 2, rel=0.02)
    assert float(t.com[-1, 1, 2] - t.com[0, 1, 2]) == pytest.approx(-9.81 * 0.1**2 / 2, rel=0.02)
    assert mean_shift(t, 1).norm() < SAG  # it stands
    assert (t.binding.index[t.scene.gaussians.object_id == 0] == -1).all()
    assert f"material not known, taking {DEFAULT_MATERIAL}" in caplog.text and "substep" in caplog.text
    assert " kg if one unit is 1 m" in caplog.text
    assert t.scene.provenance["command"] == "simulate"


def test_same_seed_gives_the_same_bytes(file, device):
    first, second = (command(file, steps=4, device=device).positions for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.parametrize(("commands", "told"), [
    (("reconstruct",), True), (("segment", "reconstruct"), True), (("refine", "segment", "reconstruct"), False),
    ((), False), (("segment",), False),
])  # fmt: skip
def test_scenes_of_photos_that_were_not_refined_are_told_of(balls, tmp_path, caplog, commands, told):
    caplog.set_level(logging.INFO)
    made: dict = {}
    for command_name in reversed(commands):
        made = {"command": command_name, "scene": made}
    tell_of_unseen_sides(replace(balls, provenance=made), tmp_path / "scene.ply")
    assert ("`ngff refine` adds them" in caplog.text) == told


def test_scene_units_other_than_metres(balls, caplog):
    caplog.set_level(logging.INFO)
    t = roll(replace(balls, scale={"metres_per_unit": 0.5, "source": "test"}))
    assert " kg" in caplog.text and "one unit is 1 m" not in caplog.text
    assert float(mean_shift(t, 2)[2]) == pytest.approx(-2 * 9.81 * 0.1**2 / 2, rel=0.02)


def test_lift_velocity_and_pin(file):
    t = command(file, lift=("0.2",), velocity=("object=thing 1,0,0",), pin=("1",))
    assert torch.allclose(mean_shift(t, 1, 0), torch.tensor([0, 0, 0.2]), atol=1e-6)
    assert torch.equal(t.positions[0][t.keypoints.object_id == 1], t.positions[-1][t.keypoints.object_id == 1])
    assert float(mean_shift(t, 2)[0]) == pytest.approx(0.1, rel=0.01)
    assert {f["kind"] for f in t.info.forces} == {"lift", "velocity", "pin"}


def test_impulse_of_a_force_equals_change_of_momentum(balls):
    # F t = m v: a force of 2 m newtons for 0.05 s, ending within a frame, gives 0.1 m/s
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


def test_torques_and_off_centre_forces_rotate(balls):
    spun = roll(balls, gravity=0.0, force=("object=2 torque=0,0,0.5 to=0.04",))
    assert float(spun.rotation[-1, 1, 3]) > 0.02 and (spun.com[-1, 1] - spun.com[0, 1]).norm() < 1e-3
    hit = roll(balls, gravity=0.0, force=("object=2 force=5,0,0 at=0.3,-0.12,0.5 to=0.04",))
    assert float(hit.rotation[-1, 1, 3]) > 0.005 and float(hit.com[-1, 1, 0] - hit.com[0, 1, 0]) > 0


def test_stiff_materials_are_softened_and_logged(balls, caplog):
    caplog.set_level(logging.INFO)
    roll(balls, steps=2, material=("thing=steel",))
    assert "object 2 (thing): steel" in caplog.text and "reduced from 2.1e+11 to" in caplog.text


def test_a_scene_at_rest_gives_a_hint(balls, file, caplog):
    """Independent of its position, and if keypoints fall by 0.5 % of the extent."""
    g = balls.gaussians
    write_scene(file, replace(balls, gaussians=replace(g, means=g.means + torch.tensor([20.0, 0.0, 0.0]))))
    caplog.set_level(logging.INFO)
    command(file, steps=3, gravity=5.0)
    assert "all objects stay at rest" in caplog.text and "--lift 0.3" in caplog.text
    caplog.clear()
    command(file, steps=5)  # a ball falls by 3 cm, which is 3.5 % of the extent of the objects
    assert "all objects stay at rest" not in caplog.text


def test_a_scene_without_floor_gets_one_under_the_lowest_object(balls, caplog):
    caplog.set_level(logging.INFO)
    assert mean_shift(roll(replace(balls, floor=None), steps=4), 1).norm() < SAG
    assert "no floor" in caplog.text


def test_objects_near_the_floor_are_placed_on_it_without_a_jump(balls):
    for floor in (-0.015, 0.03):
        t = roll(balls, floor=floor, steps=10)
        assert mean_shift(t, 1).norm() < SAG and torch.equal(t.positions[0], t.keypoints.rest)


def test_overlapping_objects_do_not_explode():
    a, b = ball((0, 0, 0.15), 0.15, 600, (1, 0, 0), 1), ball((0.1, 0, 0.15), 0.15, 600, (0, 1, 0), 2, seed=1)
    scene = Scene(concatenate([a, b]), (SceneObject(1, "duck"), SceneObject(2, "phone")), None, 0.0)
    t = roll(scene, steps=15)
    speed = (t.positions[1:] - t.positions[:-1]).norm(dim=2) / 0.02
    assert float(speed.max()) < 1.5  # they collapse under gravity (v^2 < 2 g x 0.15 m)


def test_divergence_names_object_time_and_remedy_and_keeps_the_frames(file, monkeypatch):
    advance = engine.mpm.Solver.advance

    def fails_later(self, duration, acceleration, substeps):
        self.calls = getattr(self, "calls", 0) + 1
        if self.calls == 3:
            raise engine.mpm.Diverged(len(acceleration) - 1)
        return advance(self, duration, acceleration, substeps)

    monkeypatch.setattr(engine.mpm.Solver, "advance", fails_later)
    with pytest.raises(InputError, match=r"object 2 \(thing\).* at 0.04 s.*--quality"):
        command(file)
    assert not file.with_name("traj.h5").exists()
    assert len(read_trajectory(file.with_name("traj.partial.h5"))) == 3


@pytest.mark.parametrize("box, message", [
    ("1,2,3", "x0,y0,z0,x1,y1,z1"), ("0,0,0,1,1,x", "three numbers"), ("1,0,0,0,1,1", "first corner"),
    ("0,-1,0,1,1,1", r"object 1 \(red ball\) is not inside"),
])  # fmt: skip
def test_invalid_boxes(balls, box, message):
    with pytest.raises(InputError, match=message):
        roll(balls, box=box)


def test_walls_hold(balls):
    t = roll(balls, steps=20, box="-0.6,-0.4,0,0.6,0.4,1", velocity=("object=2 2,0,0",), material=("thing=rubber",))
    mine = t.keypoints.object_id == 2
    assert float(t.positions[:, mine, 0].max()) < 0.6 + 2 * 0.065  # walls are accurate to two cells


def test_nothing_stops_what_slides_or_rises_but_the_box_that_was_asked_for(balls):
    """Without friction one ball keeps its 3 m/s for 2.3 m; another rises as in empty space."""
    t = roll(balls, steps=40, friction=0.0, gravity=1.0, velocity=("object=1 3,0,0", "object=2 0,0,4"))
    assert float(mean_shift(t, 1)[0]) == pytest.approx(3 * 39 * 0.02, rel=0.02)
    assert float(mean_shift(t, 2)[2]) == pytest.approx(4 * 0.78 - 0.78**2 / 2, rel=0.02)


def test_what_flies_too_far_for_a_grid_is_named(balls, monkeypatch, caplog):
    monkeypatch.setattr(moving_grid.mpm, "max_contact_nodes", lambda device: 200_000)
    t = roll(balls, steps=25, gravity=0.0, velocity=("object=2 8,0,0",))
    assert "(thing) moves too far away from the other objects" in caplog.text
    assert float(mean_shift(t, 2)[0]) < 8 * 24 * 0.02


@pytest.mark.parametrize("options, message", [
    ({"quality": "best"}, "draft, normal, high"), ({"steps": 0}, "at least 1"), ({"dt": 0.0}, "--dt"),
    ({"gravity": float("nan")}, "--gravity"), ({"friction": -1.0}, "--friction"), ({"keypoints": 2}, "--keypoints"),
    ({"floor": float("inf")}, "--floor"), ({"port": 8000}, "only work with --live"),
    ({"browser": False}, "only work with --live"),
])  # fmt: skip
def test_invalid_options(options, message):
    with pytest.raises(InputError, match=message):
        SimulateOptions(**options)


def test_damaged_options_of_a_trajectory_are_refused(tmp_path, file):
    command(file, steps=2)
    trajectory = file.with_name("traj.h5")
    with h5py.File(trajectory, "a") as stored:
        made_by = json.loads(stored.attrs["provenance"])
    for name, value in (("dt", "abc"), ("material", 5), ("seed", 1e99), ("engine", ["mpm"])):
        with h5py.File(trajectory, "a") as stored:
            stored.attrs["provenance"] = json.dumps({**made_by, "options": {**made_by["options"], name: value}})
        with pytest.raises(InputError, match=f"its options of `ngff simulate` are damaged.*{name}"):
            run(file, tmp_path / "again.h5", SimulateOptions(forces=trajectory))


def test_a_recording_gives_all_options_that_are_not_given(tmp_path, file):
    """Except options that name files and devices, and those for forces and motions, which are among the prompts."""
    apart = {"material": (), "rest": False, "gravity": 1.62, "steps": 2, "quality": "draft"}
    run(file, tmp_path / "moon.h5", SimulateOptions(engine="mpm", **apart))
    again = with_recorded(SimulateOptions(forces=tmp_path / "moon.h5"))
    assert {name: getattr(again, name) for name in apart} == apart and again.engine == "mpm"
    earth = with_recorded(SimulateOptions(forces=tmp_path / "moon.h5"), {"gravity", "forces"})
    assert earth.gravity == SimulateOptions.gravity and not earth.rest
    elsewhere = {"steps", "materials", "force", "forces", "pin", "velocity", "lift", "weights", "device", "live",
                 "browser", "port"}  # fmt: skip
    assert set(OPTIONS) == {f.name for f in fields(SimulateOptions)} - elsewhere


def test_a_recording_of_another_engine_keeps_that_engines_options_to_itself(tmp_path, file):
    run(file, tmp_path / "a.h5", SimulateOptions(engine="ngff", contact="solved", steps=2))
    assert with_recorded(SimulateOptions(forces=tmp_path / "a.h5")).contact == "solved"
    assert with_recorded(SimulateOptions(forces=tmp_path / "a.h5", engine="mpm")).contact == "auto"


def test_objects_without_extent_are_left_out(balls, caplog):
    means = torch.where((balls.gaussians.object_id == 2)[:, None], torch.tensor([0.3, 0.0, 0.5]), balls.gaussians.means)
    scene = replace(balls, gaussians=replace(balls.gaussians, means=means))
    assert [o.id for o in with_objects(scene, Path("scene.ply")).objects] == [1]
    assert "object 2 (thing) is a point (600 Gaussians) and is skipped" in caplog.text
    only = scene.gaussians[scene.gaussians.object_id == 2]
    with pytest.raises(InputError, match="its objects are single points"):
        with_objects(replace(scene, gaussians=only), Path("scene.ply"))
    far = replace(scene, gaussians=replace(scene.gaussians, means=scene.gaussians.means + 1e6))
    with pytest.raises(InputError, match="move the scene to the origin"):
        with_objects(far, Path("scene.ply"))
    assert "object 1 (red ball) is too far from the origin for its size" in caplog.text


def test_prompts_that_change_nothing_are_named(tmp_path, file, caplog):
    prompts = {"pin": ("1",), "velocity": ("object=1 0,0,1",), "force": ("object=2 force=0,0,1 from=0.02",)}
    run(file, tmp_path / "a.h5", SimulateOptions(engine="rigid", steps=2, **prompts))
    assert "object 1 (red ball) is held fixed by --pin, so that its --velocity has no effect" in caplog.text
    assert "1 of 1 forces begin after the end of the simulation at 0.02 s" in caplog.text
    caplog.clear()
    run(file, tmp_path / "a.h5", SimulateOptions(engine="rigid", steps=3, force=prompts["force"]))
    assert "forces begin" not in caplog.text


def test_frames_of_thousands_of_steps_of_the_learned_field_are_refused(balls):
    g = balls.gaussians
    tiny = replace(balls, gaussians=replace(g, means=1e-6 * g.means, scales=1e-6 * g.scales))
    with pytest.raises(InputError, match="steps of the learned field.*smaller --dt"):
        roll(tiny, engine="ngff")


def test_unknown_engine(file):
    with pytest.raises(InputError, match="--engine magic: choose from auto, ngff, mpm"):
        command(file, engine="magic")


def test_doubled_resolution_keeps_bodies_on_the_floor(file):
    scene, options = with_objects(read_scene(file), file), SimulateOptions(quality="draft")
    coarse, fine = (set_up_scene(scene, ForcePrompts(), options, refinement) for refinement in (1, 2))
    assert fine.bodies.spacing == coarse.bodies.spacing / 2 and len(fine.start) > 5 * len(coarse.start)
    for s in (coarse, fine):
        assert float(s.start[s.bodies.body == 0, 2].quantile(0.01)) == pytest.approx(0.5 * s.bodies.spacing, rel=0.51)


def test_objects_of_a_scene_without_labels_are_those_of_segment(tmp_path, monkeypatch):
    monkeypatch.setattr(network_segmenter, "SCALES", SCALES[:1])  # one of three
    monkeypatch.setattr(network_segmenter, "REDUCTIONS", ())
    monkeypatch.setattr(network_segmenter, "COPIES", 1)  # one instead of four
    scene = three_apart(side=0.56, noise=0.002)
    blank = replace(scene.gaussians, object_id=torch.zeros_like(scene.gaussians.object_id))
    write_scene(tmp_path / "scene.ply", replace(scene, gaussians=blank))
    segment(tmp_path / "scene.ply", tmp_path / "labelled.ply")
    labelled, scene = (read_scene(tmp_path / name) for name in ("labelled.ply", "scene.ply"))
    found = with_objects(scene, tmp_path / "scene.ply")
    assert torch.equal(found.gaussians.object_id, labelled.gaussians.object_id)
    assert found.objects == labelled.objects and len(found.objects) == 3


def test_gpu_agrees_with_cpu(balls, device):
    if device == "cpu":
        pytest.skip("needs an NVIDIA GPU")
    cpu, gpu = roll(balls, device="cpu"), roll(balls, device="cuda", quality="normal")
    assert mean_shift(gpu, 1).norm() < SAG
    assert float(mean_shift(gpu, 2)[2]) == pytest.approx(float(mean_shift(cpu, 2)[2]), rel=0.02)


@pytest.mark.parametrize("material", ["sand", "snow", "plasticine", "dough"])
def test_plastic_materials_fall_freely_and_sand_slumps(balls, material):
    t = roll(balls, material=(f"thing={material}", "1=sand"), steps=15)
    assert float(mean_shift(t, 2, 5)[2]) == pytest.approx(-9.81 * 0.1**2 / 2, rel=0.03)
    assert float(t.com[-1, 0, 2]) < 0.8 * float(t.com[0, 0, 2])  # the ball of sand collapses


def test_the_slowest_vibration_has_the_loss_factor_of_the_material():
    """The frequency of a bar of length L is omega = pi c / L."""
    soft = Material(E=1e5, density=400.0, loss=0.2)
    found = _stable_material(soft, 0.5, 0.01, MpmQuality(1000, 3e-3))
    omega = math.pi * math.sqrt(1e5 / 400.0) / 0.5
    assert found.E == 1e5 and found.loss == 0.2 and found.viscosity == 0
    assert (found.branch_modulus, found.branch_rate) == maxwell_branches(0.2, omega)


@pytest.mark.parametrize("loss", [0.0, 0.3, 2.0])
@pytest.mark.parametrize(("h", "step"), [(0.01, 3e-3), (0.02, 3e-3), (0.01, 1.5e-3)])
def test_stiff_materials_are_softened_until_waves_cross_a_part_of_a_cell_in_a_substep(h, step, loss):
    level, stiff = MpmQuality(1000, step), Material(E=1e11, density=2500.0, nu=0.25, loss=loss)
    substep = level.substep(h)
    found = _stable_material(stiff, 0.5, h, level)
    speed = math.sqrt(1.2 * found.E / 2500.0)  # (1 - nu) / ((1 + nu) (1 - 2 nu)) = 1.2
    assert 0.2 < speed * substep / (2 * h) < 1 and found.loss == min(loss, 0.6)
    first = _stable_material(stiff, 0.5, 0.01, MpmQuality(1000, 3e-3)).E
    assert found.E / first == pytest.approx(h / 0.01 * (3e-3 / step) ** 2)  # E / (density g h) depends only on the step


@pytest.mark.parametrize("density", [40.0, 2500.0])
def test_the_viscosity_of_materials_that_flow_is_as_large_as_the_substep_allows(density):
    level = MpmQuality(1000, 3e-3)
    material = Material(E=1e11, density=density, nu=0.25, loss=2.0, model="sand")
    E, loss, viscosity, *_ = _stable_material(material, 5.0, 0.01, level)
    assert loss == pytest.approx(viscosity * math.pi * math.sqrt(E / density) / 5.0 / E) and loss < 2.0
    rate = engine.mpm.substep_rate(0.02, 0.0, viscosity / density)
    assert rate * level.substep(0.01) == pytest.approx(engine.CFL_MARGIN)


def test_particles_are_the_same_in_any_unit(balls):
    """For the same scene in metres and half metres, masses, stiffness, damping and positions are equal."""
    options, material = options_with(material=("thing=jelly",), quality="draft"), []
    for unit in (1.0, 0.5):
        g = balls.gaussians
        scene = replace(
            balls, gaussians=replace(g, means=g.means / unit, scales=g.scales / unit),
            scale={"metres_per_unit": unit, "source": "test"},
        )  # fmt: skip
        setup = set_up_scene(scene, ForcePrompts(), options)
        material.append(engine._particles(scene, setup, ForcePrompts(), options, options.level))
    one, other = material
    for name in ("x", "mass", "volume", "stiffness", "friction", "branch_modulus", "branch_rate"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=1e-4, atol=1e-6)
    assert float(one.branch_rate.min()) > 0


@pytest.mark.parametrize("along", [200, 250, 400, 1000])
def test_the_default_domain_is_reduced_until_its_grid_fits(along):
    """For a cube of side 1 on the floor, the margin is at best 1, and never less than MIN_ROOM voxels."""
    h = 1 / along
    box = _default_box(torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), 0.0, h)
    room = -box.low[0]
    assert box.low == (-room, -room, 0.0) and box.high == pytest.approx((1 + room,) * 3)

    def nodes(room: float) -> float:
        return ((1 + 2 * room) / (2 * h) + 16) ** 2 * ((1 + room) / (2 * h) + 16)

    assert nodes(room) < MAX_NODES / 2 or room <= MIN_ROOM * h
    assert room == 1 or (nodes(room / 0.8) > MAX_NODES / 2 and room > 0.8 * MIN_ROOM * h)
    assert (room == 1) == (along == 200)


def test_a_scene_in_which_no_object_is_found_is_refused(balls, monkeypatch, tmp_path):
    blank = replace(
        balls, gaussians=replace(balls.gaussians, object_id=torch.zeros(1250, dtype=torch.int64)), objects=()
    )
    found = {"none": blank, "without Gaussians": replace(blank, objects=balls.objects)}
    for grouped in found.values():
        monkeypatch.setattr(network_segmenter, "segment_by_network", lambda *_, grouped=grouped, **__: grouped)
        with pytest.raises(InputError, match="s.ply: no objects were found in the scene; label .* `ngff segment`"):
            with_objects(blank, tmp_path / "s.ply")


def test_the_seed_is_also_that_of_the_segmentation(balls, monkeypatch, tmp_path):
    g, seeds = balls.gaussians, []
    write_scene(tmp_path / "s.ply", replace(balls, gaussians=replace(g, object_id=torch.zeros_like(g.object_id))))

    def nothing_found(scene, seed, **_):
        seeds.append(seed)
        return replace(scene, objects=())

    monkeypatch.setattr(network_segmenter, "segment_by_network", nothing_found)
    for seed in (7, 0):
        with pytest.raises(InputError, match="no objects were found"):
            run(tmp_path / "s.ply", tmp_path / "t.h5", SimulateOptions(seed=seed))
    assert seeds == [7, 0]


def test_a_part_in_which_nothing_is_is_named(balls, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    parts = [{"box": [7, 7, 7, 8, 8, 8], "material": "wood"}, {"material": "rubber"}]
    (tmp_path / "m.json").write_text(json.dumps({"thing": {"parts": parts}}))
    options = options_with(materials=tmp_path / "m.json")
    particles = engine._particles(balls, set_up_scene(balls, ForcePrompts(), options), ForcePrompts(), options,
                                  options.level)  # fmt: skip
    assert "object 2 (thing): no particles are in its part of wood" in caplog.text
    assert "object 2 (thing): rubber, " in caplog.text and bool((particles.mass > 0).all())
