"""The rigid engine: free fall, friction, restitution, stacks, prompts and scale, compared with analytic values."""

import json
import logging
import math
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.rotations import matrix
from stages.core.physics import solid_surface
from stages.core.physics.materials import MATERIALS
from stages.core.physics.rigid_shapes import rigid_shapes
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.sequence import FilmedSequence
from stages.core.scene.trajectory import read_trajectory
from stages.lab.assets.shapes import Surface, box, ellipsoid, to_gaussians, union
from stages.lab.bench.experiments.bodies import compound, tilted
from stages.simulate import rigid
from stages.simulate.contact_forces import MAX_PASSES, REST_SPEED, set_references, solve
from stages.simulate.initial_overlaps import InitialOverlaps
from stages.simulate.options import QUALITIES, MpmQuality, SimulateOptions
from stages.simulate.rigid_model import OMEGA, restitution
from stages.simulate.stage import run
from tests.core.physics.test_cylinder_fit import cylinder
from tests.simulate.motion import Motion, roll_out

G = 9.81


@pytest.fixture(autouse=True)
def small_bodies(monkeypatch):
    """Use few particles, which only decide whether a body stands on the floor, and bodies of half the resolution."""
    monkeypatch.setitem(QUALITIES, "draft", MpmQuality(particles=1200, step=0.015))
    monkeypatch.setattr(solid_surface, "VOXELS_ALONG", 24)


@pytest.fixture
def usual_bodies(small_bodies, monkeypatch):
    """Use bodies of full resolution, for contacts of thin parts; other tests must not use the same surfaces."""
    monkeypatch.setattr(solid_surface, "VOXELS_ALONG", 48)


@cache
def cube(side: float, x: float, bottom: float) -> Surface:
    return box((side, side, side), side / 16).moved((x, 0.0, bottom + side / 2))


PHOTOS = {"command": "segment", "scene": {"command": "reconstruct"}}


@cache
def scene_of(surfaces: tuple[Surface, ...], unit: float = 1.0, photos: bool = False) -> Scene:
    """One object for each surface; cached, because Surface is hashed by identity."""
    grey = [torch.full((len(s.points), 3), 0.5) for s in surfaces]
    parts = [to_gaussians(s, grey[i], i + 1, widest=math.inf) for i, s in enumerate(surfaces)]
    objects = tuple(SceneObject(i + 1, f"body{i + 1}") for i in range(len(parts)))
    scale = {"metres_per_unit": unit, "source": "test"}
    return Scene(concatenate(parts), objects, None, 0.0, scale, PHOTOS if photos else {})


def options_of(scene: Scene, folder: Path, density: float = 500.0, loss: float = 0.3, **options) -> SimulateOptions:
    material = {o.name: {"E": 1e7, "density": density, "loss": loss, "friction": 0.3} for o in scene.objects}
    (folder / "m.json").write_text(json.dumps(material))
    chosen = {"engine": "rigid", "keypoints": 32, "materials": folder / "m.json", "quality": "draft", **options}
    return SimulateOptions(**chosen)


def roll(folder: Path, *surfaces: Surface, unit: float = 1.0, photos: bool = False, **options) -> Motion:
    scene = scene_of(surfaces, unit, photos)
    return roll_out(scene, options_of(scene, folder, **options))


def test_first_frame_is_the_scene_and_free_fall_is_a_parabola(tmp_path):
    """Run as a stage, from file to file."""
    scene = scene_of((cube(0.1, 0, 0.5),))
    write_scene(tmp_path / "scene.ply", scene)
    run(tmp_path / "scene.ply", tmp_path / "t.h5", options_of(scene, tmp_path, steps=11))
    t = read_trajectory(tmp_path / "t.h5")
    assert torch.equal(t.positions[0], t.keypoints.rest) and t.info.engine == "rigid"
    # semi-implicit Euler adds g t dt / 2 to the fall; the substep is less than 1 ms
    assert float(t.com[-1, 0, 2] - t.com[0, 0, 2]) == pytest.approx(-G * 0.2**2 / 2, rel=0.01)


FLAT = box((0.3, 0.2, 0.1), 0.02).moved((0.0, 0.0, 0.05))
BALL = ellipsoid((0.1,) * 3, 2000).moved((0, 0, 0.1))


@pytest.mark.parametrize("friction", [pytest.param(0.1, marks=pytest.mark.slow), 0.3, 0.6])
def test_a_box_slides_by_v2_over_2_mu_g(tmp_path, friction):
    time = 2 / (friction * G)
    t = roll(tmp_path, FLAT, velocity=("object=1 2,0,0",), friction=friction, steps=10 + math.ceil(time / 0.02))
    assert float(t.com[-1, 0, 0]) == pytest.approx(4 / (2 * friction * G), rel=0.03)


@pytest.mark.parametrize("loss", [0.1, 0.4])
def test_a_ball_rebounds_by_its_loss_factor(tmp_path, loss):
    t = roll(tmp_path, BALL, loss=loss, lift=("0.5",), dt=0.01, steps=70)
    z = t.com[:, 0, 2] - 0.1
    hit = int((z < 0.02).nonzero()[0])
    rebound = math.sqrt(float(z[hit:].max()) / 0.5)
    assert rebound == pytest.approx(math.exp(-math.pi * loss / 2), abs=0.03)  # half an oscillation with low damping


@pytest.mark.parametrize("gap", [0.0, 0.002])
@pytest.mark.parametrize("loss", [0.001, 0.15])
def test_the_last_of_a_row_of_balls_flies_off(tmp_path, gap, loss):
    """Newton's cradle: each ball transfers (1 + e) / 2 of its speed, even if the balls touch initially.

    The other balls then stay together, except for the small speed that separates balls that overlap after the impact.
    """
    row = [BALL.moved((i * (0.2 + gap) - 0.1 * (i == 0), 0.0, 0.0)) for i in range(4)]
    t = roll(tmp_path, *row, velocity=("object=1 1,0,0",), friction=0.0, loss=loss, dt=0.01, steps=31)
    speed = (t.com[-1, :, 0] - t.com[-2, :, 0]) / 0.01
    last, push = ((1 + restitution(loss)) / 2) ** 3, REST_SPEED * 0.2 / math.sqrt(0.2 / G)
    assert float(speed[3]) == pytest.approx(last, rel=0.005)
    assert float((speed[:3] - (1 - last) / 3).abs().max()) < push / 2 + 0.01
    assert float(speed.sum()) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(("name", "share"), [("steel", 0.597), ("glass", 0.658), ("wood", 0.603), ("plastic", 0.688)])
def test_stiff_solids_rebound_as_measured(name, share):
    """Balls were dropped from 0.92 m (The Physics Factbook, Coefficients of restitution)."""
    assert restitution(MATERIALS[name].loss) == pytest.approx(share, abs=0.01)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_ball_that_slid_rolls_on_and_is_slowed_by_the_loss_of_its_material_alone(tmp_path, noise):
    """At 5/7 of its speed it rolls (inertia 2/5 m r^2); then its deceleration is 5/7 g arm / r.

    The same applies to a ball with a noisy surface, as in a reconstruction.
    """
    stretch = 1 + noise * torch.randn(len(BALL.points), 1, generator=torch.Generator().manual_seed(0))
    middle = torch.tensor([0.0, 0.0, 0.1])
    rough = Surface(middle + (BALL.points - middle) * stretch, BALL.normals)
    t = roll(tmp_path, rough, velocity=("object=1 1,0,0",), friction=0.5, loss=0.15, density=540.0, steps=60)
    speed = (t.com[1:, 0, 0] - t.com[:-1, 0, 0]) / 0.02
    assert float(speed[9]) == pytest.approx(5 / 7, rel=0.03)
    load = 540.0 * 4 / 3 * math.pi * 0.1**3 * G
    contact = (0.75 * load * 0.1 * (1 - 0.3**2) / 1e7) ** (1 / 3)
    arm = 3 / 16 * contact * (1 - math.exp(-math.pi * 0.15))
    slowing = float(speed[9] - speed[-1]) / (49 * 0.02)
    assert slowing == pytest.approx(5 / 7 * G * arm / 0.1, rel=0.1)


@cache
def random_cylinder(axes: tuple[int, int, int]) -> Surface:
    """Random points on a cylinder of radius 0.1 on the floor, of length 0.3 along the axis given last."""
    points = torch.from_numpy(0.1 * cylinder(3.0)[:, np.argsort(axes)]).float()
    # approximate normals, which only determine the flat side of the Gaussians
    out = torch.nn.functional.normalize(points, dim=1)
    return Surface(points - points.amin(0) * torch.tensor([0.0, 0.0, 1.0]), out)


def test_a_cylinder_that_slid_rolls_on_and_is_slowed_by_the_loss_of_its_material_alone(tmp_path):
    """At 2/3 of its speed it rolls (inertia m r^2 / 2); then its deceleration is 2/3 g arm / r.

    As a polygon of 200 points, it would lose half of that speed in 2 s.
    """
    t = roll(
        tmp_path,
        random_cylinder((0, 2, 1)),
        velocity=("object=1 1,0,0",),
        friction=0.5,
        loss=0.15,
        density=540.0,
        steps=60,
    )
    speed = (t.com[1:, 0, 0] - t.com[:-1, 0, 0]) / 0.02
    assert float(speed[9]) == pytest.approx(2 / 3, rel=0.01)
    load = 540.0 * math.pi * 0.1**2 * G
    width = math.sqrt(4 * load * 0.1 * (1 - 0.3**2) / (math.pi * 1e7))
    arm = 2 / (3 * math.pi) * width * (1 - math.exp(-math.pi * 0.15))
    slowing = float(speed[9] - speed[-1]) / (49 * 0.02)
    assert slowing == pytest.approx(2 / 3 * G * arm / 0.1, rel=0.1)
    assert abs(float(t.com[-1, 0, 1])) < 1e-3


def test_a_cylinder_stands_on_its_end(tmp_path):
    t = roll(tmp_path, random_cylinder((0, 1, 2)), steps=30)
    assert float((t.com[-1] - t.com[0]).norm()) < 1e-3
    assert float(t.rotation[-1, 0, 1:].norm()) < 1e-3


def test_a_tray_that_stood_on_the_floor_has_an_underside_that_falls_on_a_ball(tmp_path):
    """It is lifted from above a small ball and dropped; the ball is in its hollow and must not penetrate it."""
    parts = [((0.3, 0.3, 0.03), (0, 0, 0.015)), *(((0.03, 0.3, 0.12), (x, 0, 0.06)) for x in (-0.135, 0.135))]
    ball = ellipsoid((0.05,) * 3, 1500).moved((0.0, 0.0, 0.05))
    t = roll(tmp_path, compound(0.012, *parts), ball, lift=("1=.3",), loss=0.6, steps=20)
    assert float(t.com[-1, 1, 2]) == pytest.approx(0.05, abs=2e-3)
    assert float(t.positions[-1, t.keypoints.object_id == 1, 2].min()) > 0.09


def test_a_lid_on_a_block_stays_level(tmp_path):
    """The inside of its top touches the block; edges of the block must not count as initial overlap."""
    sides = [((0.015, 0.3, 0.1), (x, 0, 0.05)) for x in (-0.1425, 0.1425)]
    sides += [((0.3, 0.015, 0.1), (0, y, 0.05)) for y in (-0.1425, 0.1425)]
    lid = compound(0.007, ((0.3, 0.3, 0.015), (0, 0, 0.0925)), *sides).moved((0.0, 0.0, 0.035))
    block = box((0.1, 0.1, 0.12), 0.008).moved((0.04, 0.0, 0.06))
    t = roll(tmp_path, block, lid, friction=0.5, steps=40)
    assert float((t.com[-1, 1] - t.com[0, 1]).norm()) < 1e-4
    assert float(matrix(t.rotation[-1, 1])[2, 2]) > math.cos(math.radians(0.05))


def test_a_heavy_box_that_falls_on_a_card_lies_on_it(tmp_path):
    """The card of 2 mm has 1/160 of the mass; it would need hundreds of impacts on box and floor to stop the box."""
    card = box((0.09, 0.06, 0.002), 0.003).moved((0.0, 0.0, 0.001))
    t = roll(tmp_path, card, cube(0.12, 0.02, 0.022), steps=40)
    low = (t.positions[-1, t.keypoints.object_id == 2, 2]).min()
    # the tolerance is for 1/1000 of the card's length, and for points of surfaces
    assert float(low) == pytest.approx(0.002, abs=3e-4)
    assert float(t.positions[:, t.keypoints.object_id == 1, 2].min()) > -3e-4


def test_a_fall_of_half_a_percent_of_the_size_ends_without_a_rebound(tmp_path):
    """Even a material without loss must not bounce, which would last for seconds."""
    t = roll(tmp_path, FLAT, lift=("0.001",), loss=0.0, dt=0.005, steps=24)
    assert float((t.com[8:, 0, 2] - t.com[-1, 0, 2]).abs().max()) < 2e-6
    assert float(t.com[-1, 0, 2] - t.com[0, 0, 2]) == pytest.approx(-0.001, abs=1e-4)


def test_a_tower_stands(tmp_path):
    t = roll(tmp_path, *(cube(0.1, 0, 0.1 * i) for i in range(5)), steps=60, loss=0.15)
    assert float((t.com[-1] - t.com[0]).norm(dim=1).max()) < 1e-3


def test_overlaps_at_the_start_remain_without_a_jump(tmp_path):
    """The upper of two cubes keeps its initial overlap with the lower one; they are not pushed apart."""
    t = roll(tmp_path, cube(0.1, 0, 0.0), cube(0.1, 0, 0.08), steps=20)
    assert torch.equal(t.positions[0], t.keypoints.rest)
    assert float((t.com - t.com[0]).norm(dim=-1).max()) < 2e-3


def test_what_was_lifted_out_of_an_overlap_does_not_sink_in_again(tmp_path):
    t = roll(tmp_path, cube(0.1, 0, 0.0), cube(0.1, 0, 0.085), steps=40, lift=("2=0.05",), photos=True)
    gap = float(t.com[-1, 1, 2] - t.com[-1, 0, 2]) - 0.1
    assert -0.004 < gap < 0.003 and float((t.com[-1, 0] - t.com[0, 0]).norm()) < 1e-3


def test_objects_of_photos_rest_until_something_disturbs_them(tmp_path):
    """A stacked object stays, although it would tip; it falls after the lower one is removed."""
    lower, upper, far = cube(0.1, 0, 0.0), cube(0.1, 0.06, 0.1), cube(0.1, 0.5, 0.0)
    still = roll(tmp_path, lower, upper, far, steps=10, photos=True)
    assert torch.equal(still.positions[-1], still.positions[0])  # otherwise the upper one would tip
    t = roll(tmp_path, lower, upper, far, steps=30, photos=True, velocity=("object=1 0,3,0",))
    moved = (t.com[-1] - t.com[0]).norm(dim=1)
    assert moved[2] == 0 and moved[0] > 0.2 and float(t.com[-1, 1, 2] - t.com[0, 1, 2]) < -0.05


def test_what_does_not_move_is_written_without_rounding(tmp_path):
    """It is then rendered without skinning and shading; another object moves, and this one is lifted."""
    prompts = {"velocity": ("object=1 0,1,0",), "lift": ("2=.1",), "pin": ("2",)}
    t = roll(tmp_path, cube(0.1, 0.37, 0.0), cube(0.1, -0.71, 0.0), unit=0.3, steps=10, photos=True, **prompts)
    still, lift = t.keypoints.object_id == 2, torch.tensor([0.0, 0.0, 0.1])
    assert torch.equal(t.positions[:, still], (t.keypoints.rest[still] + lift).expand(10, -1, -1))
    assert torch.equal(t.com[:, 1], t.com[:1, 1].expand(10, -1)) and float((t.com[-1, 0] - t.com[0, 0]).norm()) > 0.05


def test_contacts_are_found_once_something_moves(tmp_path, monkeypatch):
    found = []
    monkeypatch.setattr(rigid, "InitialOverlaps", lambda *of: found.append(of) or InitialOverlaps(*of))
    cubes = cube(0.1, 0, 0.0), cube(0.1, 0, 0.1)
    roll(tmp_path, *cubes, steps=4, photos=True)
    assert not found
    t = roll(tmp_path, *cubes, steps=20, photos=True, force=("object=1 force=60,0,0 from=.1",))
    assert len(found) == 1 and torch.equal(t.positions[5], t.positions[0])
    assert float(t.com[-1, 0, 0] - t.com[0, 0, 0]) > 0.1 and float(t.com[-1, 1, 2] - t.com[0, 1, 2]) < -0.05


def test_what_touches_nothing_in_photos_rests_on_what_is_below(tmp_path):
    """Objects of photos are at rest with an invisible support. The upper cube falls after the lower one is removed."""
    cubes = cube(0.1, 0.02, 0.15), cube(0.1, 0, 0.0), cube(0.1, -0.3, 0.15)
    still = roll(tmp_path, *cubes, steps=10, photos=True)
    assert torch.equal(still.positions[-1], still.positions[0])
    t = roll(tmp_path, *cubes, steps=40, photos=True, velocity=("object=2 0,3,0",))
    assert abs(float(t.com[-1, 0, 2] - t.com[0, 0, 2]) + 0.15) < 0.01
    hit = roll(tmp_path, *cubes, steps=40, photos=True, velocity=("object=3 4,0,0",))
    assert float(hit.com[:, 0, 2].min() - hit.com[0, 0, 2]) < -0.1


@pytest.mark.parametrize(("lift", "falls"), [((), False), (("1=2",), True)])
def test_a_board_that_leans_on_an_object_in_photos_falls_once_that_is_taken_away(tmp_path, lift, falls):
    board = tilted(box((0.4, 0.1, 0.04), 0.01), 50)
    low = board.points.amin(0)
    board = board.moved((0.1 - float(low[0]), 0.0, -float(low[2])))
    t = roll(tmp_path, box((0.2, 0.2, 0.4), 0.0125).moved((0.0, 0.0, 0.2)), board, photos=True, lift=lift, steps=21)
    assert (float(t.com[0, 1, 2] - t.com[-1, 1, 2]) > 0.03) == falls


def test_objects_of_films_and_with_no_rest_fall_from_where_they_are(tmp_path):
    """Within 0.12 s, the cube falls by half of its height of 0.15 above the floor."""
    hanging = cube(0.1, 0, 0.15)
    still, free = (roll(tmp_path, hanging, steps=7, photos=True, rest=rest) for rest in (True, False))
    assert torch.equal(still.positions[-1], still.positions[0])
    scene = replace(scene_of((hanging,), photos=True), sequence=FilmedSequence(50.0, 60, {"a": 3.0}))
    for t in (free, roll_out(scene, options_of(scene, tmp_path, steps=7))):
        assert float(t.com[-1, 0, 2] - t.com[0, 0, 2]) == pytest.approx(-G * 0.12**2 / 2, rel=0.05)


@pytest.mark.parametrize(("speed", "moves"), [(0.05, False), (1.0, True)])
def test_only_a_hard_enough_hit_moves_an_object_at_rest(tmp_path, speed, moves):
    t = roll(tmp_path, cube(0.1, 0, 0), cube(0.1, 0.11, 0), steps=30, friction=0.2, photos=True,
             velocity=(f"object=1 {speed},0,0",))  # fmt: skip
    assert (float(t.com[-1, 1, 0] - t.com[0, 1, 0]) > 0.05) == moves


def cross() -> Surface:
    bar = (torch.tensor([0.15, 0.025, 0.025]), box((0.3, 0.05, 0.05), 0.01))
    post = (torch.tensor([0.025, 0.15, 0.025]), box((0.05, 0.3, 0.05), 0.01))
    return union(*((s, lambda p, half=half: (p.abs() < half - 1e-4).all(1)) for half, s in (bar, post)))


def test_a_body_that_is_not_convex_slides_by_v2_over_2_mu_g(tmp_path):
    t = roll(tmp_path, cross().moved((0, 0, 0.025)), velocity=("object=1 1,0,0",), friction=0.3, steps=40)
    assert float(t.com[-1, 0, 0] - t.com[0, 0, 0]) == pytest.approx(1 / (2 * 0.3 * G), rel=0.03)
    assert torch.equal(t.com[-1], t.com[-2]) or float((t.com[-1] - t.com[-2]).norm()) < 1e-5


def test_a_body_that_is_not_convex_slides_on_without_friction(tmp_path):
    """One slides on the floor, with a box on it."""
    low = cross().moved((0, 0, 0.025))
    t = roll(tmp_path, low, cube(0.04, 0, 0.05), velocity=("object=1 1,0,0", "object=2 1,0,0"), friction=0.0, steps=20)
    moved = t.com[-1] - t.com[0]
    assert moved[:, 0].tolist() == pytest.approx([0.38, 0.38], rel=0.01)
    assert moved[:, 2].tolist() == pytest.approx([0.0, 0.0], abs=2e-3)


@pytest.mark.usefixtures("usual_bodies")
def test_bodies_that_are_not_convex_rebound_by_their_loss_factor(tmp_path):
    """A cross falls flat onto a pinned one; speeds are computed from the parabolas before and after the impact."""
    lower, upper = cross().moved((0, 0, 0.025)), cross().moved((0, 0, 0.2))
    t = roll(tmp_path, lower, upper, loss=0.1, pin=("1",), dt=0.01, steps=30)
    z = t.com[:, 1, 2].double()
    hit = int(z.argmin())
    fall, rise = z[0] - 0.075, z[hit:].max() - 0.075
    assert math.sqrt(rise / fall) == pytest.approx(math.exp(-math.pi * 0.1 / 2), abs=0.05)


def energy_between_frames(t: Motion, dt: float) -> torch.Tensor:
    """Energy per mass of the keypoints [J/kg], from differences of frames; too small for frames with an impact."""
    x = t.positions.double()
    return ((x[1:] - x[:-1]) ** 2).sum(-1).mean(1) / (2 * dt**2) + G * ((x[1:] + x[:-1]) / 2)[..., 2].mean(1)


def test_a_body_that_is_not_convex_gains_no_energy_on_the_floor(tmp_path):
    """Contact springs that appear and disappear during a collision could make a tumbling cross bounce ever higher.

    Between impacts, the energy of the keypoints of a rotating cross varies by 10 %, because they are not its mass.
    """
    t = roll(tmp_path, cross().moved((0, 0, 0.5)), loss=0.1, steps=400, dt=0.005, velocity=("object=1 1,0,0",),
             force=("object=1 force=0,0,0 torque=.3,.2,0 to=0.04",))  # fmt: skip
    energy = energy_between_frames(t, 0.005)[8:]
    least = torch.cummin(energy.unfold(0, 3, 1).amax(1), 0).values
    assert float(((energy[2:] - least) / energy[2:]).max()) < 0.15
    assert float(energy[-1]) < 0.6 * float(energy[0])


@pytest.mark.parametrize("unit", [pytest.param(1.0, marks=pytest.mark.slow), 0.5])
def test_force_torque_and_pin(tmp_path, unit):
    """Forces are in newtons and torques in newton metres at any scale; velocities and positions are in scene units."""
    boxes = cube(0.2, 0, 0.5), cube(0.2, 1, 0.5)
    mass = 500 * (0.2 * unit) ** 3
    inertia = mass * (0.2 * unit) ** 2 / 6
    t = roll(tmp_path, *boxes, gravity=0.0, pin=("2",), steps=12, unit=unit, force=(
        f"object=1 force={mass},0,0 torque=0,0,{inertia} to=0.1", "object=2 force=9,9,9"))  # fmt: skip
    assert torch.equal(t.com[-1, 1], t.com[0, 1])
    assert float((t.com[-1] - t.com[-2])[0, 0] / 0.02) == pytest.approx(0.1 / unit, rel=0.02)
    assert turning(t) == pytest.approx(0.1, rel=0.03)  # edges between the points are cut off
    # a push at half a side from the centre acts like its torque
    hit = roll(tmp_path, *boxes, gravity=0.0, pin=("2",), steps=8, unit=unit,
               force=(f"object=1 force=0,{mass},0 at=0.1,0,0.6 to=0.1",))  # fmt: skip
    assert turning(hit) == pytest.approx(mass * 0.1 * unit / inertia * 0.1, rel=0.03)
    assert float((hit.com[-1] - hit.com[-2])[0, 1] / 0.02) == pytest.approx(0.1 / unit, rel=0.02)


def turning(t: Motion) -> float:
    """Angular velocity of the first body about z at the end [rad/s]."""
    turned = 2 * torch.atan2(t.rotation[:, 0, 3], t.rotation[:, 0, 0])
    return float(turned[-1] - turned[-2]) / 0.02


def test_a_box_is_slowed_by_the_friction_of_its_material_at_any_scale(tmp_path):
    """A box of initially 1 m/s slides by v^2 / 2 mu g, in metres, with mu = 0.3; one unit is 5 m."""
    t = roll(tmp_path, FLAT, velocity=("object=1 .2,0,0",), unit=5.0, steps=25)
    assert 5 * float(t.com[-1, 0, 0]) == pytest.approx(1 / (2 * 0.3 * G), rel=0.04)


def test_motion_is_the_same_at_any_size(tmp_path):
    """One cube slides, and another bounces; rounding does not influence these motions."""
    one, *others = (
        roll(tmp_path, cube(0.2 * s, 0, 0), cube(0.1 * s, -0.5 * s, 0.2 * s), steps=25, dt=0.02 * math.sqrt(s),
             velocity=(f"object=1 {math.sqrt(s)},0,0",)).com / s
        for s in (1.0, 0.01, 100.0)
    )  # fmt: skip
    for other in others:
        torch.testing.assert_close(other, one, rtol=0, atol=2e-3)


def test_walls_hold_and_soft_or_plastic_bodies_are_warned_of(tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    t = roll(
        tmp_path, cube(0.1, 0, 0), box="-0.2,-0.2,0,0.2,0.2,1", velocity=("object=1 2,0,0",), friction=0.0,
        material=("1=sand",), steps=40,
    )  # fmt: skip
    assert float(t.positions[..., 0].max()) < 0.215 and "sand yields or flows" in caplog.text
    roll(tmp_path, cube(0.1, 0, 0), material=("1=jelly",), steps=1)
    assert "jelly is compressed by" in caplog.text


def test_motion_without_limit_is_an_error(tmp_path):
    with pytest.raises(InputError, match="diverged"):
        roll(tmp_path, cube(0.1, 0, 0.5), force=("object=1 force=9e8,0,0",), steps=9, dt=0.5)


SUBSTEPS_OF_A_CUBE = [  # sqrt(size / acceleration) / 200 or 0.05 size / speed, for 0.1 m and 0.5 kg on the floor
    ({}, 39.6), ({"gravity": 4 * G}, 79.2), ({"gravity": 0.0}, 1), ({"velocity": ("object=1 12,0,5",)}, 57.6),
    ({"force": ("object=1 force=30,40,0",)}, 126.5), ({"force": ("object=1 torque=0,0.6,0.8",)}, 56.6),
    ({"force": ("object=1 force=30,40,0 from=0 to=0.01",)}, 39.6), ({"unit": 0.25}, 79.2),
    ({"lift": ("body1=3.95",), "gravity": 0.1}, 4), ({"lift": ("body1=2.95",), "gravity": 9.81}, 39.6),
    ({"lift": ("body1=7.95",), "gravity": 9.81}, 50.1), ({"velocity": ("object=1 0,0,2000",)}, 5000),
]  # fmt: skip


@pytest.mark.parametrize(("options", "expected"), SUBSTEPS_OF_A_CUBE, ids=str)
def test_substeps_follow_from_acceleration_and_speed(tmp_path, caplog, options, expected):
    caplog.set_level(logging.INFO)
    roll(tmp_path, cube(0.1, 0, 0.0), steps=1, **options)
    (line,) = [r.getMessage() for r in caplog.records if "non-convex, substep" in r.getMessage()]
    found = int(line.split("(")[1].split()[0])
    assert found == pytest.approx(expected, abs=max(1.0, 0.02 * expected))
    assert float(line.split("substep ")[1].split()[0]) == pytest.approx(0.02 / found, rel=0.01)


def test_the_smallest_object_decides_on_the_substeps(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    roll(tmp_path, cube(0.1, 0, 0.0), cube(0.025, 1.0, 0.0), cube(0.2, 2.0, 0.0), steps=1)
    assert any("(80 per frame)" in r.getMessage() for r in caplog.records)


def test_the_fastest_object_decides_on_the_substeps(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    roll(tmp_path, cube(0.1, 0, 0.0), cube(0.1, 1.0, 0.0), steps=1, velocity=("object=2 12,0,5",))
    assert any("(58 per frame)" in r.getMessage() for r in caplog.records)


def test_an_object_below_the_floor_keeps_its_body_and_returns_to_where_it_stood(tmp_path, caplog):
    """A bar stands on the ground beside a table and is lifted by half its height; objects on the table do not fall.

    One of these objects is not convex.
    """
    caplog.set_level(logging.INFO)
    bar = box((0.1, 0.1, 0.3), 0.02).moved((0.3, 0.0, -0.25))
    t = roll(tmp_path, bar, cube(0.1, 0, 0.0), cross().moved((0.0, 0.5, 0.025)), lift=("1=0.15",), steps=40)
    assert any("(40 per frame)" in r.getMessage() for r in caplog.records)  # as follows from the size of the cube
    assert float(t.com[0, 0, 2]) == pytest.approx(-0.1, abs=1e-3)
    assert float((t.com[-1, 0] - t.com[0, 0] + torch.tensor([0.0, 0.0, 0.15])).norm()) < 2e-3
    assert float(t.com[:, 0, 2].max()) < -0.1 + 1e-4 and float((t.com[-1, 1:] - t.com[0, 1:]).norm()) < 1e-3


def rail() -> Surface:
    """A non-convex bar along x of 1.2 x 0.2 x 0.04, with a rim at its left end; its top is at 0."""
    pieces = ((1.2, 0.2, 0.04), (0.0, 0.0, -0.02)), ((0.04, 0.2, 0.1), (-0.58, 0.0, 0.01))
    return union(*((box(sides, 0.01).moved(at), partial(strictly_inside, sides=sides, at=at)) for sides, at in pieces))


def strictly_inside(points: torch.Tensor, sides: tuple, at: tuple) -> torch.Tensor:
    return ((points - torch.tensor(at)).abs() < torch.tensor(sides) / 2 - 1e-4).all(1)


def test_a_ball_rests_on_a_body_that_is_not_convex_whatever_sticks_out_of_its_surface(tmp_path):
    """A tuft of 0.08 radii at the bottom of the ball could tip it over."""
    below = BALL.points[:, 2] < 0.002
    points = BALL.points.clone()
    points[below, 2] -= 0.008
    ball = Surface(points, BALL.normals).moved((0.0, 0.0, 0.31))
    t = roll(tmp_path, rail().moved((0.0, 0.0, 0.3)), ball, pin=("1",), steps=30)
    torch.testing.assert_close(t.com[-1, 1], torch.tensor([0.0, 0.0, 0.4]), rtol=0, atol=2e-3)


@pytest.mark.usefixtures("usual_bodies")
@pytest.mark.parametrize("friction", [pytest.param(0.2, marks=pytest.mark.slow), 0.6])
def test_bodies_that_are_not_convex_slide_on_each_other_by_v2_over_2_mu_g(tmp_path, friction):
    t = roll(tmp_path, rail().moved((0.0, 0.0, 0.3)), cross().moved((-0.3, 0, 0.325)), pin=("1",), friction=friction,
             velocity=("object=2 1,0,0",), steps=20 + math.ceil(1 / (friction * G * 0.02)))  # fmt: skip
    assert float(t.com[-1, 1, 0] - t.com[0, 1, 0]) == pytest.approx(1 / (2 * friction * G), rel=0.05)
    assert float((t.com[-1] - t.com[-3]).norm()) < 1e-4


@pytest.mark.parametrize("friction", [0.3, pytest.param(0.9, marks=pytest.mark.slow)])
def test_a_force_a_little_beyond_friction_accelerates_a_box_by_the_difference(tmp_path, friction):
    """If contacts lifted a sliding body, it would slide faster. Its mass is measured without friction."""
    free = roll(tmp_path, FLAT, friction=0.0, force=("object=1 force=1,0,0",), steps=31)
    mass = 0.6**2 / 2 / float(free.com[-1, 0, 0] - free.com[0, 0, 0])
    t = roll(tmp_path, FLAT, friction=friction, force=(f"object=1 force={mass * G * (friction + 0.03)},0,0",), steps=31)
    assert float(t.com[-1, 0, 0] - t.com[0, 0, 0]) == pytest.approx(0.03 * G * 0.6**2 / 2, rel=0.05)


def spins(rotation: torch.Tensor, dt: float) -> torch.Tensor:
    """Angular velocities (t - 1, 3) between frames (t, 4) in the body's frame, for less than half a turn per frame."""
    R = matrix(rotation.double())
    turn = R[:-1].mT @ R[1:]
    axis = torch.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)
    sine, cosine = axis.norm(dim=1, keepdim=True) / 2, (turn.diagonal(dim1=1, dim2=2).sum(1, keepdim=True) - 1) / 2
    return axis / (2 * sine).clamp_min(1e-12) * torch.atan2(sine, cosine) / dt


def test_friction_adds_no_energy_to_tumbling_bodies(tmp_path):
    """Two crosses collide and tumble on a floor of friction 1, where sliding contacts must not lift bodies.

    A frame has one substep, so that differences of frames are velocities.
    """
    dt, bodies = 0.0005, (cross().moved((-0.3, 0, 0.3)), cross().moved((0.3, 0.05, 0.3)))
    velocity = ("object=1 3,0,0", "object=2 -3,0,0")
    t = roll(tmp_path, *bodies, loss=0.1, friction=1.0, dt=dt, velocity=velocity, steps=2400)
    energy, x = torch.zeros(2399, dtype=torch.float64), t.com.double()
    for row, shape in enumerate(rigid_shapes(scene_of(bodies), 0, 0.0)):
        spin = spins(t.rotation[:, row], dt)
        turning = ((spin @ (shape.inertia / shape.volume).double()) * spin).sum(1)
        moving = ((x[1:, row] - x[:-1, row]) / dt).square().sum(1)
        energy += (moving + turning) / 2 + G * (x[1:, row, 2] + x[:-1, row, 2]) / 2
    least = torch.cummin(energy, 0).values
    assert float((energy - least).max()) < 0.001 * float(energy[0] - energy.min())


def test_a_body_that_tumbles_in_free_space_keeps_its_energy(tmp_path):
    """It rotates about its middle axis of inertia and thus turns over repeatedly, for 3 s at 10 rad/s."""
    brick, dt = box((0.3, 0.2, 0.1), 0.02).moved((0.0, 0.0, 1.0)), 0.02
    moments = torch.tensor([0.2**2 + 0.1**2, 0.3**2 + 0.1**2, 0.3**2 + 0.2**2]) / 12  # moments of inertia per mass
    torque = 500 * 0.3 * 0.2 * 0.1 / dt * moments * torch.tensor([0.5, 10.0, 0.0])
    push = "object=1 from=0 to={} torque={},{},{}".format(dt, *torque.tolist())
    t = roll(tmp_path, brick, gravity=0.0, dt=dt, steps=152, force=(push,))
    assert float(matrix(t.rotation[1:, 0])[:, 1, 1].min()) < -0.9  # it turned over
    energy = spins(t.rotation[1:, 0], dt).square() @ moments.double()
    assert float(energy.max() / energy.min()) < 1.03
    assert float(energy[0]) == pytest.approx(float(moments[1]) * 100 + float(moments[0]) * 0.25, rel=0.1)


def test_a_body_that_spins_by_two_radians_in_a_substep_keeps_its_axis(tmp_path):
    """Rolling slender bodies spin this fast. It also rotates at 1 rad/s about another axis and nutates by 3 degrees."""
    bar, dt = box((0.3, 0.1, 0.1), 0.01).moved((0.0, 0.0, 1.0)), 0.02
    torque = 500 * 0.3 * 0.1 * 0.1 / 12 / dt * np.array([100 * 0.02, 1 * 0.1])
    push = f"object=1 from=0 to={dt} torque={torque[0]},{torque[1]},0"
    t = roll(tmp_path, bar, gravity=0.0, dt=dt, steps=60, force=(push,))
    assert float(matrix(t.rotation[:, 0])[:, 0, 0].min()) > math.cos(math.radians(8))


def test_a_dropped_body_that_is_not_convex_rests_when_its_rebounds_are_over(tmp_path):
    """With restitution e, the rebounds after a fall of time T last T (1 + e) / (1 - e) in total."""
    e, fall = math.exp(-math.pi * 0.4 / 2), math.sqrt(2 * 0.1 / G)
    t = roll(tmp_path, cross().moved((0, 0, 0.025)), lift=("1=0.1",), loss=0.4, dt=0.01, steps=60)
    last = math.ceil(fall * (1 + e) / (1 - e) / 0.01)
    assert float((t.positions[last + 2 :] - t.positions[last + 1]).norm(dim=-1).max()) < 1e-3 * 0.3


def contacts_at(speed: list[float], distance: list[float]) -> SimpleNamespace:
    """MuJoCo's data for contacts of geometries 0 and 1 with normal speeds, distances and a slip of (1, -2)."""
    n = len(speed)
    velocity = np.stack([np.array(speed), np.ones(n), np.full(n, -2.0)], 1).ravel()
    contact = SimpleNamespace(efc_address=3 * np.arange(n), friction=np.full((n, 5), 0.4), geom=np.array([[0, 1]] * n))
    return SimpleNamespace(contact=contact, efc_vel=velocity, efc_aref=np.full(3 * n, 7.0),
                           efc_pos=np.repeat(distance, 3))  # fmt: skip


def test_fast_contacts_rebound_within_a_substep_and_slow_ones_are_pushed_apart():
    """Deep contacts are separated at no more than the speed below which there is no rebound; slip ends immediately."""
    v = REST_SPEED
    data = contacts_at([-v, 0.0, v, v, -10 * v, -1.5 * v], [-d for d in (0.0, 1e-5, 1.0, 5.0, 0.0, 0.0)])
    normal, friction, rebounds = set_references(data, 0.01, np.array([1.0, 0.6]), np.zeros(18))
    assert normal.tolist() == [0, 3, 6, 9, 12, 15] and friction.tolist() == [0.4] * 6
    assert rebounds.tolist() == [False] * 4 + [True] * 2
    expected = [2 * OMEGA * v, OMEGA**2 * 1e-5, 0.0, 0.0, 10 * v * 1.6 / 0.01, 1.5 * v * 1.3 / 0.01]
    assert data.efc_aref[normal] == pytest.approx(expected)
    assert data.efc_aref[normal + 1].tolist() == [-100.0] * 6 and (data.efc_aref[normal + 2] == 200.0).all()


def passes(slip_after) -> list[float]:
    """The slips that the passes of the solver take, of a contact that slides at `slip_after(slip)` after a pass."""
    taken: list[float] = []

    def constraint(model, data):
        taken.append((2.0 - float(data.efc_aref[0])) / 0.5)  # friction times the slip is taken off the reference

    def rates(model, data, rate, qacc):
        rate[1:] = 0.6 * slip_after(taken[-1]), 0.8 * slip_after(taken[-1])

    mujoco = SimpleNamespace(mj_fwdConstraint=constraint, mj_mulJacVec=rates)
    data = SimpleNamespace(efc_aref=np.array([2.0, 0.0, 0.0]), efc_force=np.ones(3), nefc=3, qacc=None)
    solve(mujoco, None, data, np.array([0]), np.array([0.5]), np.array([False]))
    return taken


@pytest.mark.parametrize("slope", [0.5, -0.5, -1.0])
def test_passes_of_the_solver_find_the_slip_at_once_where_it_is_linear(slope):
    """Repeating alone alternates for ever, or diverges, with a slope of -1, as of a body in a groove."""
    assert passes(lambda slip: 3 + slope * slip) == pytest.approx([0.0, 3.0, 3 / (1 - slope)])


def test_passes_of_the_solver_end_when_the_slip_is_known():
    assert passes(lambda slip: 3.0) == pytest.approx([0.0, 3.0])
    assert len(passes(lambda slip: slip + 1)) == MAX_PASSES


def test_a_ball_rolls_down_a_groove_without_sinking_into_it(tmp_path):
    """Of 90 degrees: a = g sin(slope) / (1 + 2/5 r^2 / d^2), as the axis of its turn is d = r / sqrt(2) away."""
    radius, slope, time, lift = 0.06, math.radians(10), 0.9, 0.005
    half = box((1.4, 0.3, 0.1), 0.012)
    turns = (torch.tensor([[1.0, 0, 0], [0, c, -s * c], [0, s * c, c]]) for s, c in ((-1, 0.5**0.5), (1, 0.5**0.5)))
    walls = [Surface(half.moved((0, side * 0.15, -0.05)).points @ R.mT, half.normals @ R.mT)
             for side, R in zip((-1, 1), turns, strict=True)]  # fmt: skip
    ball = ellipsoid((radius,) * 3, 2000).moved((-0.5, 0, math.sqrt(2) * radius))
    bodies = [tilted(body, 10).moved((0, 0, 0.4)) for body in (*walls, ball)]
    t = roll(tmp_path, *bodies, pin=("1", "2"), lift=(f"3={lift}",), friction=0.8, loss=0.1, steps=46)
    way = t.com[-1, 2] - t.com[0, 2] + torch.tensor([0.0, 0.0, lift])
    along = torch.tensor([math.cos(slope), 0.0, -math.sin(slope)])
    # the loss of its material takes some of it
    assert float(way @ along) == pytest.approx(G * math.sin(slope) / 1.8 * time**2 / 2, rel=0.03)
    assert float((way - (way @ along) * along).norm()) < 0.01 * radius


@pytest.mark.parametrize("error", [RuntimeError("Caught an unknown exception!"), ValueError("Error: qhull error")])
def test_a_model_for_which_memory_is_short_is_out_of_memory(tmp_path, monkeypatch, error):
    """MuJoCo raises RuntimeError for all C++ exceptions of unknown type."""

    def compile(spec):
        raise error

    monkeypatch.setattr(pytest.importorskip("mujoco").MjSpec, "compile", compile)
    with pytest.raises(MemoryError):
        roll(tmp_path, cube(0.1, 0.0, 0.0), steps=2)
