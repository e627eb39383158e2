"""Options of `ngff simulate`: limits of their values, and derived settings."""

import math
import re
from pathlib import Path

import pytest

from stages.core.errors import InputError
from stages.core.physics.forces import Change
from stages.simulate.changes import changed_options, changed_pins
from stages.simulate.options import SimulateOptions

ACCEPTED = {
    "steps": (1, 10**9), "dt": (1e-5, 1.0), "gravity": (0.0, -9999.0, 9999.0), "friction": (0.0, 99.0, None),
    "keypoints": (8, 100_000, None), "floor": (-1e9, 0.0, None), "integrator": ("rk4",),
}  # fmt: skip
REFUSED = {
    "steps": (0, 10**9 + 1, 10**20), "dt": (0.99e-5, 1.01, math.nan),
    "gravity": (1e4, -1e4, math.inf), "friction": (-0.01, 100.0),
    "keypoints": (7, 100_001), "floor": (math.nan, -math.inf, 1.1e9), "integrator": ("leapfrog",), "quality": ("best",),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_limits_of_options(name):
    for value in ACCEPTED.get(name, ()):
        assert getattr(SimulateOptions(**{name: value}), name) == value
    for value in REFUSED[name]:
        with pytest.raises(InputError, match=re.escape(f"--{name} {value}: ")):
            SimulateOptions(**{name: value})


@pytest.mark.parametrize(("port", "right"), [(0, True), (1, True), (65535, True), (65536, False), (-1, False)])
def test_limits_of_the_port(port, right):
    if right:
        assert SimulateOptions(live=True, port=port, browser=False).port == port
    else:
        with pytest.raises(InputError, match=f"--port {port}: must be 0"):
            SimulateOptions(live=True, port=port)


def test_integrators_are_for_learned_engines():
    assert SimulateOptions(engine="ngff", integrator="euler").integrator == "euler"
    for engine in ("mpm", "rigid"):
        with pytest.raises(InputError, match=f"only works with learned engines, not with --engine {engine}"):
            SimulateOptions(engine=engine, integrator="euler")
        with pytest.raises(InputError, match=f"--weights a: only works .*, not with --engine {engine}"):
            SimulateOptions(engine=engine, weights=Path("a"))
        SimulateOptions(engine=engine, integrator="step")


def test_a_live_session_has_fewer_keypoints_unless_they_are_given():
    assert SimulateOptions().keypoint_count == 1024 and SimulateOptions(live=True).keypoint_count == 128
    assert SimulateOptions(live=True, keypoints=500).keypoint_count == 500
    levels = [SimulateOptions(quality=name).level for name in ("draft", "normal", "high")]
    assert levels == sorted(levels, key=lambda level: level.particles)
    assert levels == sorted(levels, key=lambda level: -level.step)


def test_changes_hold_from_then_on():
    changes = (Change("gravity", 1.6, 0.0), Change("material", "steel", 0.0, 2), Change("pinned", True, 0.0, 1),
               Change("friction", 0.1, 0.5), Change("pinned", False, 0.5, 3))  # fmt: skip
    before = SimulateOptions(material=("1=foam",))
    after = changed_options(before, changes)
    assert (after.gravity, after.friction, after.material) == (1.6, 0.1, ("1=foam", "2=steel"))
    assert changed_options(before, ()) == before and before.gravity == 9.81
    assert changed_pins(frozenset({3, 4}), changes) == {1, 4}
