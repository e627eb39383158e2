"""Measures of errors in a simulation, each for a constructed motion."""

import logging
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.core.geometry.rotations import matrix
from stages.core.physics.forces import Force, ForcePrompts
from stages.core.physics.keypoints import choose_keypoints
from stages.core.physics.state import FrameState
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.shapes import box, to_gaussians
from stages.simulate.options import SimulateOptions
from stages.simulate.plausibility import PlausibilityMonitor

DT, G = 0.02, 9.81


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Two cubes of side 0.2, one on top of the other."""
    cubes = [box((0.2,) * 3, 0.0125).moved((0.0, 0.0, z)) for z in (0.1, 0.3)]
    parts = [to_gaussians(c, torch.full((len(c.points), 3), 0.5), i + 1, widest=math.inf) for i, c in enumerate(cubes)]
    return Scene(concatenate(parts), (SceneObject(1, "lower"), SceneObject(2, "upper")), None, 0.0)


def measured(
    scene: Scene, path, stretch=lambda t: 1.0, frames: int = 40, prompts: ForcePrompts | None = None
) -> tuple[dict, PlausibilityMonitor]:
    """Measures of a motion in which the upper cube is displaced by `path(t)` [m] and stretched about its centre."""
    keypoints = choose_keypoints(scene, 256)
    upper = keypoints.object_id == 2
    com = torch.stack([keypoints.rest[~upper].mean(0), keypoints.rest[upper].mean(0)])
    monitor = PlausibilityMonitor(scene, keypoints, prompts or ForcePrompts(), SimulateOptions())
    for n in range(frames):
        shift = torch.tensor(path(n * DT))
        x, moved = keypoints.rest.clone(), com.clone()
        x[upper] = com[1] + stretch(n * DT) * (x[upper] - com[1]) + shift
        moved[1] += shift
        monitor.add(FrameState(x, moved, torch.tensor([[1.0, 0, 0, 0]] * 2)))
    return monitor.result(), monitor


def ramp(*end: float):
    """A straight path to `end` within 0.1 s."""
    return lambda t: tuple(min(t / 0.1, 1.0) * v for v in end)


def test_nothing_is_found_in_a_fall_beside_another_object(scene):
    found, _ = measured(scene, lambda t: (0.3, 0.0, -min(G * t * t / 2, 0.2)))
    assert max(found["objects"]["2"].values()) < 0.01 and found["energy_gain"] < 0.01


def test_depth_of_penetration(scene, caplog):
    caplog.set_level(logging.WARNING)
    found, monitor = measured(scene, ramp(0.0, 0.0, -0.03))
    assert found["objects"]["2"]["penetration"] == pytest.approx(0.15, abs=0.03)
    assert found["objects"]["1"]["penetration"] == found["objects"]["2"]["penetration"]
    monitor.warn(found)
    assert "object 2 (upper) sinks into object 1 (lower)" in caplog.text
    below, _ = measured(scene, ramp(0.5, 0.0, -0.25))
    assert below["objects"]["2"]["penetration"] == pytest.approx(0.25, abs=0.01)


def test_a_dent_under_a_load_is_no_penetration(scene):
    """The lower cube is compressed by 1/5 and the upper one moves down with its surface, and then 0.01 further."""
    keypoints = choose_keypoints(scene, 256)
    upper = keypoints.object_id == 2
    com = torch.stack([keypoints.rest[~upper].mean(0), keypoints.rest[upper].mean(0)])
    for more, depth in ((0.0, 0.0), (0.01, 0.05)):
        monitor = PlausibilityMonitor(scene, keypoints, ForcePrompts(), SimulateOptions())
        for share in torch.linspace(0.0, 1.0, 10).tolist():
            x, moved = keypoints.rest.clone(), com.clone()
            x[~upper, 2] *= 1 - 0.2 * share
            moved[0, 2] *= 1 - 0.2 * share
            x[upper, 2] -= (0.04 + more) * share
            moved[1, 2] -= (0.04 + more) * share
            monitor.add(FrameState(x, moved, torch.tensor([[1.0, 0, 0, 0]] * 2)))
        found = monitor.result()["objects"]
        assert found["2"]["penetration"] == pytest.approx(depth, abs=0.02)


def test_depth_in_the_height_of_a_flat_sheet_is_relative_to_a_voxel_of_it(scene):
    """A sheet lies on the lower cube and penetrates it by 0.01."""
    upper = scene.gaussians.object_id == 2
    means = scene.gaussians.means.clone()
    means[upper, 2] = 0.2
    sheet = replace(scene, gaussians=replace(scene.gaussians, means=means))
    found, monitor = measured(sheet, ramp(0.0, 0.0, -0.01))
    assert found["objects"]["2"]["penetration"] == pytest.approx(0.01 / monitor._surface(1).h, rel=0.3)


def test_depth_of_penetration_without_a_floor(scene):
    found, _ = measured(replace(scene, floor=None), ramp(0.0, 0.0, -0.03))
    assert found["objects"]["2"]["penetration"] == pytest.approx(0.15, abs=0.03)


def test_overlap_by_a_lift_is_warned_of_and_not_counted(scene, caplog):
    """The lower cube is lifted by 0.06 into the upper one, and then penetrates by a further 0.03."""
    keypoints = choose_keypoints(scene, 256)
    lower = (keypoints.object_id == 1)[:, None]
    monitor = PlausibilityMonitor(scene, keypoints, ForcePrompts(lift={1: 0.06}), SimulateOptions())
    com = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.3]])
    for height in (0.06, 0.06, 0.09):
        up = torch.tensor([0.0, 0.0, height])
        shift = torch.stack([up, torch.zeros(3)])
        monitor.add(FrameState(keypoints.rest + lower * up, com + shift, torch.tensor([[1.0, 0, 0, 0]] * 2)))
        expected = 0.15 if height > 0.06 else 0.0
        assert monitor.result()["objects"]["1"]["penetration"] == pytest.approx(expected, abs=0.03)
    monitor.warn(monitor.result())
    (text,) = re.findall(r"object 1 .lower. and object 2 .upper. overlap by (\d+) %", caplog.text)
    assert int(text) == pytest.approx(30, abs=3)


def test_bodies_end_at_the_floor(scene):
    """The lower cube is below a floor at half height of the upper one, and rises into the lower half of that."""
    keypoints = choose_keypoints(scene, 256)
    lower = (keypoints.object_id == 1)[:, None]
    com = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.3]])
    for floor, depth in ((0.3, 0.0), (0.0, 0.4)):
        monitor = PlausibilityMonitor(scene, keypoints, ForcePrompts(), SimulateOptions(floor=floor))
        for height in (0.0, 0.08):
            up = torch.tensor([0.0, 0.0, height])
            shift = torch.stack([up, torch.zeros(3)])
            monitor.add(FrameState(keypoints.rest + lower * up, com + shift, torch.tensor([[1.0, 0, 0, 0]] * 2)))
        assert monitor.result()["objects"]["2"]["penetration"] == pytest.approx(depth, abs=0.03)


def test_overlap_at_rest_is_not_counted(scene):
    g = scene.gaussians
    lower = torch.where((g.object_id == 2)[:, None], torch.tensor([0.0, 0.0, -0.03]), torch.zeros(3))
    overlapping = replace(scene, gaussians=replace(g, means=g.means + lower))
    found, _ = measured(overlapping, ramp(0.0, 0.0, -0.02))
    assert found["objects"]["2"]["penetration"] == pytest.approx(0.1, abs=0.03)


def test_creep_spread_and_energy(scene, caplog):
    found, _ = measured(scene, lambda t: (0.02 * t, 0.0, 0.0))
    assert found["objects"]["2"]["creep"] == pytest.approx(0.1, rel=0.02) and found["objects"]["1"]["creep"] == 0
    found, _ = measured(scene, lambda t: (0.0, 0.0, 0.0), lambda t: 1 + 0.5 * t)
    assert found["objects"]["2"]["spread"] == pytest.approx(0.39, abs=0.01)
    for speed, creeps in ((0.13, True), (0.15, False)):  # the limit is 0.1 sqrt(g size) = 0.14
        found, _ = measured(scene, lambda t, speed=speed: (speed * t, 0.0, 0.0))
        assert found["objects"]["2"]["creep"] == pytest.approx(speed / 0.2 if creeps else 0.0, rel=0.02)
    fall = 0.2
    found, monitor = measured(scene, lambda t: (0.3, 0.0, -G * t * t / 2 if t < fall else -0.196 + 3.0 * (t - fall)))
    assert found["energy_gain"] > 1.0
    monitor.warn(found)
    assert "the objects gain" in caplog.text and "--engine rigid or mpm" in caplog.text


def monitor_of(scene: Scene, prompts: ForcePrompts = ForcePrompts(), **options) -> PlausibilityMonitor:  # noqa: B008
    return PlausibilityMonitor(scene, choose_keypoints(scene, 64), prompts, SimulateOptions(**options))


def test_energy_is_that_of_filled_bodies_and_of_their_deformation_weighted_by_mass(scene):
    """The lower cube rotates by 0.1 rad and moves; the upper one falls while its keypoints move apart."""
    monitor = monitor_of(replace(scene, scale={"metres_per_unit": 0.5, "source": "stated"}), dt=0.1)
    com = np.array([[0.0, 0, 0.1], [0, 0, 0.3]])
    turn = Rotation.from_rotvec([[0.0, 0, 0.1], [0, 0, 0]]).as_matrix()
    monitor._origin = com
    after_com = com + [[0.2, 0, 0], [0, 0, -0.1]]
    apart = 0.03 * np.sign(np.arange(len(monitor._rest[1])) % 2 - 0.5)[:, None] * [0.0, 1, 0]
    moved = [x + (r - c) @ R.T for x, r, c, R in zip(after_com, monitor._rest, com, turn, strict=True)]
    before, after = (monitor._rest, com, np.stack([np.eye(3)] * 2)), ([moved[0], moved[1] + apart], after_com, turn)
    g, square = G / 0.5, 2 * 0.1**2  # in scene units
    chord = (2 * math.sin(0.05)) ** 2
    first = (0.2**2 + chord * 0.2**2 / 6) / square + g * 0.1
    second = (0.1**2 + 0.03**2) / square + g * 0.25
    for mass in (1.0, 3.0):
        found = sum(monitor._mechanical_energy(after, before, np.array([mass, 1.0])))
        assert found == pytest.approx((mass * first + second) / (mass + 1), rel=2e-3)
    empty = [np.zeros((0, 3)), monitor._rest[1]], com, before[2]
    assert monitor._mechanical_energy(empty, empty, np.array([1.0, 1.0])) == (0.0, pytest.approx(g * 0.2))


@pytest.mark.parametrize(("energy", "gain"), [
    ([5.0, 3.0, 2.0, 4.0, 6.5], 0.5), ([5.0, 3.0, 2.0, 4.0], 0.0), ([5.0, 6.0], 1 / (1e-3 * G * 0.2)), ([5.0], 0.0),
    ([], 0.0),
])  # fmt: skip
def test_gain_of_energy_relative_to_what_was_converted(scene, energy, gain):
    monitor = monitor_of(scene)
    monitor._energy = [(0.0, e) for e in energy]
    assert monitor._energy_gain() == pytest.approx(gain, rel=0.02)


def test_a_rebound_before_the_second_frame_gains_no_energy(scene):
    """From a wall, .6 of the way through the first frame: the mean speed of that frame is below the one after it."""
    thrown = ForcePrompts(velocity={2: (5.0, 0.0, 0.0)})
    found, _ = measured(scene, lambda t: (min(5 * t, 0.06 - 4 * (t - 0.012)), 0.0, 0.1), prompts=thrown)
    assert found["energy_gain"] < 1e-6


def test_gain_of_energy_where_none_is_lost_is_relative_to_the_kinetic_energy(scene):
    """In free space, for example, rounding would otherwise be divided by almost zero."""
    monitor = monitor_of(scene, gravity=0.0)
    monitor._energy = [(2.0, 0.0), (2.02, 0.0), (2.5, 0.0)]
    assert monitor._energy_gain() == pytest.approx(0.2)
    monitor._energy = [(0.0, 5.0), (1.0, 4.001), (3.0, 2.0)]  # a fall from rest
    assert monitor._energy_gain() == pytest.approx(0.001 / 3)


@pytest.mark.parametrize(("end", "gain"), [
    (0.0, 0.5), (1.5 * DT, 3.0), (2 * DT, 3.0), (2.5 * DT, 0.0), (math.inf, 0.0),
])  # fmt: skip
def test_gain_of_energy_counts_from_the_last_force(scene, end, gain):
    monitor = monitor_of(scene, ForcePrompts((Force(1, start=-1.0, end=-0.5), Force(1, start=-1.0, end=end))))
    energy = [5.0, 3.0, 2.5, 2.0, 4.0 if end != 2.5 * DT else 1.0]
    if end == 0.0:
        energy = [5.0, 3.0, 2.0, 4.0, 6.5]
    monitor._energy = [(0.0, e) for e in energy]
    assert monitor._energy_gain() == pytest.approx(gain, rel=0.02)


def test_depth_below_the_surface_of_a_cube(scene):
    """The depth is linear towards the nearest face, and negative outside."""
    surface = monitor_of(scene)._surface(0)
    depth = surface.depth
    x = np.array([[0.0, 0.0, 0.1], [0.05, 0.0, 0.1], [0.0, -0.08, 0.1], [0.1, 0.0, 0.1], [0.15, 0.0, 0.1]])
    np.testing.assert_allclose(depth(x)[:4], [0.1, 0.05, 0.02, 0.0], atol=0.008)
    assert depth(x)[4] < -surface.h
    beside = np.array([[0.1 + surface.h, 0.0, 0.1], [0.0, -0.1 - surface.h, 0.1]])
    np.testing.assert_allclose(depth(beside), -surface.h, atol=0.5 * surface.h)


def test_a_body_that_has_turned_is_measured_where_it_is(scene):
    """The corner of the lower cube overlaps by 0.03; after rotation by 45 degrees about z, it has a side there."""
    keypoints = choose_keypoints(scene, 256)
    upper = keypoints.object_id == 2
    com = torch.stack([keypoints.rest[~upper].mean(0), keypoints.rest[upper].mean(0)])
    turned = torch.tensor([math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8)])
    for quat, low, high in ((turned, 0.0, 0.03), (torch.tensor([1.0, 0, 0, 0]), 0.07, 0.16)):
        monitor = PlausibilityMonitor(scene, keypoints, ForcePrompts(), SimulateOptions())
        for n in range(3):
            x, moved = keypoints.rest.clone(), com.clone()
            shift = torch.tensor([0.17, 0.17, -0.2]) * min(n, 1)
            x[upper] += shift
            moved[1] += shift
            x[~upper] = (x[~upper] - com[0]) @ matrix(quat).T + com[0]
            monitor.add(FrameState(x, moved, torch.stack([quat, torch.tensor([1.0, 0, 0, 0])])))
        assert low <= monitor.penetration[1] <= high


@pytest.mark.parametrize(("measure", "bound", "text"), [
    ("penetration", 0.03, "sinks into the floor by 4 %"), ("creep", 0.01, "creeps by 1.1 % of its size per second"),
    ("spread", 0.1, "changes its size by 11 %"), ("energy_gain", 0.05, "gain energy: 6 % of the energy"),
])  # fmt: skip
def test_warnings_begin_above_the_bounds(scene, caplog, measure, bound, text):
    caplog.set_level(logging.WARNING)
    monitor = monitor_of(scene)
    monitor._partner = ["the floor"] * 2
    for value, warned in ((bound, False), (bound + (0.001 if measure == "creep" else 0.01), True)):
        caplog.clear()
        row = dict.fromkeys(("penetration", "creep", "spread"), 0.0)
        result = {"objects": {"1": dict(row), "2": dict(row)}, "energy_gain": 0.0}
        if measure == "energy_gain":
            result[measure] = value
        else:
            result["objects"]["2"][measure] = value
        monitor.warn(result)
        assert len(caplog.records) == warned and (text in caplog.text) == warned
    assert ("object 2 (upper)" in caplog.text) == (measure != "energy_gain")


def test_few_frames_do_not_creep_and_lifted_objects_start_where_they_were(scene):
    for frames, creeps in ((7, False), (8, True)):
        found, _ = measured(scene, lambda t: (0.02 * t, 0.0, 0.0), frames=frames)
        assert (found["objects"]["2"]["creep"] > 0) == creeps
    keypoints = choose_keypoints(scene, 64)
    monitor = PlausibilityMonitor(scene, keypoints, ForcePrompts(lift={2: 0.5}), SimulateOptions())
    com = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.8]])
    monitor.add(FrameState(keypoints.rest, com, torch.tensor([[1.0, 0, 0, 0]] * 2)))
    np.testing.assert_allclose(monitor._origin, [[0, 0, 0.1], [0, 0, 0.3]], atol=1e-6)
