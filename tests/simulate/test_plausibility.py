"""Measures of what goes wrong in a simulation, each for a motion made by hand."""

import logging
import math
from dataclasses import replace

import pytest
import torch

from stages.core.physics.forces import ForcePrompts
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
    """Two cubes of side .2, one on the other."""
    cubes = [box((0.2,) * 3, 0.0125).moved((0.0, 0.0, z)) for z in (0.1, 0.3)]
    parts = [to_gaussians(c, torch.full((len(c.points), 3), 0.5), i + 1, widest=math.inf) for i, c in enumerate(cubes)]
    return Scene(concatenate(parts), (SceneObject(1, "lower"), SceneObject(2, "upper")), None, 0.0)


def measured(scene: Scene, path, stretch=lambda t: 1.0, frames: int = 40) -> tuple[dict, PlausibilityMonitor]:
    """Of a motion in which the upper cube is displaced by `path(t)` [m] and stretched about its centre."""
    keypoints = choose_keypoints(scene, 256)
    upper = keypoints.object_id == 2
    com = torch.stack([keypoints.rest[~upper].mean(0), keypoints.rest[upper].mean(0)])
    monitor = PlausibilityMonitor(scene, keypoints, ForcePrompts(), SimulateOptions())
    for n in range(frames):
        shift = torch.tensor(path(n * DT))
        x, moved = keypoints.rest.clone(), com.clone()
        x[upper] = com[1] + stretch(n * DT) * (x[upper] - com[1]) + shift
        moved[1] += shift
        monitor.add(FrameState(x, moved, torch.tensor([[1.0, 0, 0, 0]] * 2)))
    return monitor.result(), monitor


def ramp(*end: float):
    """A straight path to `end` in .1 s."""
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
    for speed, creeps in ((0.13, True), (0.15, False)):  # beside .1 sqrt(g size) = .14
        found, _ = measured(scene, lambda t, speed=speed: (speed * t, 0.0, 0.0))
        assert found["objects"]["2"]["creep"] == pytest.approx(speed / 0.2 if creeps else 0.0, rel=0.02)
    fall = 0.2
    found, monitor = measured(scene, lambda t: (0.3, 0.0, -G * t * t / 2 if t < fall else -0.196 + 3.0 * (t - fall)))
    assert found["energy_gain"] > 1.0
    monitor.warn(found)
    assert "the objects gain" in caplog.text and "--engine rigid or mpm" in caplog.text
