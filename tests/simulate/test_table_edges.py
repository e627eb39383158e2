"""Rigid bodies at the edge of a table: supported ones stay, others fall to the ground."""

import json
import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.core.perception.table_outline import table_outline
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.keypoints import choose_keypoints
from stages.core.physics.rigid_shapes import standing_shapes
from stages.core.physics.state import FrameState
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.trajectory import read_trajectory
from stages.lab.assets.shapes import Surface, box, ellipsoid, to_gaussians
from stages.simulate.options import QUALITIES, MpmQuality, SimulateOptions
from stages.simulate.plausibility import PlausibilityMonitor
from stages.simulate.stage import run
from tests.simulate.motion import Motion, roll_out
from tests.tables import GROUND, HIGH, table_scene

G, EDGE = 9.81, HIGH[0]


@pytest.fixture(autouse=True)
def few_particles(monkeypatch):
    """Particles of a body only decide whether it stands on the floor; its mass and contacts do not depend on them."""
    monkeypatch.setitem(QUALITIES, "draft", MpmQuality(particles=1200, step=0.015))


def on_table(surface: Surface):
    return table_scene(to_gaussians(surface, torch.full((len(surface.points), 3), 0.7), 1, widest=math.inf))


def options_of(folder, **options) -> SimulateOptions:
    (folder / "m.json").write_text(json.dumps({"body1": {"E": 1e7, "density": 500, "loss": 0.3, "friction": 0.4}}))
    chosen = {"engine": "rigid", "keypoints": 32, "materials": folder / "m.json", "quality": "draft", **options}
    return SimulateOptions(**chosen)


def roll(folder, surface: Surface, **options) -> Motion:
    return roll_out(on_table(surface), options_of(folder, **options))


def block(x: float) -> Surface:
    return box((0.12, 0.08, 0.04), 0.008).moved((x, 0.0, 0.02))


def tilt(t: Motion) -> torch.Tensor:
    """Largest angle to the horizontal in each frame [rad]."""
    w, x, y, z = t.rotation[:, 0].T
    return torch.acos((1 - 2 * (x * x + y * y)).clamp(-1, 1))


def test_a_block_that_stops_over_the_edge_is_held_by_it(tmp_path, monkeypatch):
    """Its centre comes to rest 0.04 before the edge, with two of its four lower corners beyond the edge."""

    def of_corners(*args):
        sides = ((p, torch.stack(p.hull.aminmax(dim=0), 1), ground) for p, ground in standing_shapes(*args))
        return [(replace(p, hull=torch.cartesian_prod(*corners)), ground) for p, corners, ground in sides]

    monkeypatch.setattr("stages.simulate.rigid.standing_shapes", of_corners)
    speed = math.sqrt(2 * 0.4 * G * (EDGE - 0.04 - 0.2))
    t = roll(tmp_path, block(0.2), velocity=(f"object=1 {speed},0,0",), steps=36)
    assert float(t.com[-1, 0, 0]) == pytest.approx(EDGE - 0.04, abs=0.006)
    assert float(tilt(t).max()) < math.radians(1)
    assert float((t.com[-1] - t.com[-8]).norm()) < 1e-4


def test_a_ball_that_rolls_over_the_edge_falls_in_a_parabola(tmp_path):
    ball = ellipsoid((0.04,) * 3, 1000).moved((EDGE - 0.15, 0, 0.04))
    t = roll(tmp_path, ball, velocity=("object=1 1,0,0",), dt=0.01, steps=50)
    x, z = t.com[:, 0, 0], t.com[:, 0, 2]
    off = int((x > EDGE + 0.02).nonzero()[0])
    assert float(z[: off - 5].min()) > 0.038  # it is on the table until then
    fall = (z[off : off + 20] - z[off]).double()
    time = 0.01 * torch.arange(20).double()
    speed = (fall[-1] + G * time[-1] ** 2 / 2) / time[-1]  # speed at frame `off`, positive upwards
    torch.testing.assert_close(fall, speed * time - G * time**2 / 2, atol=2e-3, rtol=0)
    assert float(z[-1]) < -0.1 and -0.6 < float(speed) < 0.1


def test_what_slides_over_the_edge_lands_on_the_ground_and_does_not_sink(tmp_path, caplog):
    """Run as a stage, from file to file; with --floor, the floor has no edge."""
    scene = on_table(block(0.2))
    write_scene(tmp_path / "scene.ply", scene)
    options = {"velocity": ("object=1 2,0,0",), "steps": 70}
    with caplog.at_level(logging.WARNING):
        run(tmp_path / "scene.ply", tmp_path / "t.h5", options_of(tmp_path, **options))
    assert "sinks" not in caplog.text
    t = read_trajectory(tmp_path / "t.h5")
    assert float(t.com[-1, 0, 2]) == pytest.approx(GROUND + 0.02, abs=0.06)
    run(tmp_path / "scene.ply", tmp_path / "t.h5", options_of(tmp_path, floor=0.0, **options | {"steps": 25}))
    t = read_trajectory(tmp_path / "t.h5")
    assert float(t.com[-1, 0, 0]) > EDGE + 0.1 and float(t.com[-1, 0, 2]) == pytest.approx(0.02, abs=0.005)


def test_depth_in_a_table_is_that_below_its_top_or_from_its_side(tmp_path):
    """The end of a block of height 0.04 is below the top, and extends 0.03 or 0.01 over the table."""
    scene = on_table(block(0.2))
    keypoints, options = choose_keypoints(scene, 200), options_of(tmp_path)
    com, no_turn = torch.tensor([[0.2, 0.0, 0.02]]), torch.tensor([[1.0, 0, 0, 0]])
    edge = EDGE - float(table_outline(scene).beyond(np.array([[EDGE, 0.0]]))[0])  # position of the edge as detected
    for over, depth in ((0.03, 0.015), (0.01, 0.01)):
        monitor = PlausibilityMonitor(scene, keypoints, ForcePrompts(), options)
        for shift in (torch.zeros(3), torch.tensor([edge + 0.06 - over - 0.2, 0.0, -0.015])):
            monitor.add(FrameState(keypoints.rest + shift, com + shift, no_turn))
        assert monitor.result()["objects"]["1"]["penetration"] == pytest.approx(depth / 0.04, abs=0.02)


def test_engines_without_edges_say_so(tmp_path, caplog):
    write_scene(tmp_path / "scene.ply", on_table(block(0.25)))
    options = options_of(tmp_path, velocity=("object=1 3,0,0",), steps=25, dt=0.01)
    run(tmp_path / "scene.ply", tmp_path / "t.h5", replace(options, engine="ngff"))
    assert "object 1 (body1) is beyond the edge of the table" in caplog.text
