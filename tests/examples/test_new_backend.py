import runpy
from pathlib import Path

import pytest

from stages.core.scene.trajectory import read_trajectory

BOUNCE = Path(__file__).resolve().parents[2] / "examples/new_backend/bounce.py"


def test_bounce_writes_a_valid_trajectory(tmp_path, two_balls):
    runpy.run_path(str(BOUNCE))["simulate"](two_balls, tmp_path / "t.h5")
    trajectory = read_trajectory(tmp_path / "t.h5")
    assert len(trajectory) == 100 and trajectory.info.engine == "bounce"
    # until it lands, the green ball (0.28 above the floor) falls by g t^2 / 2, up to the scheme's first-order error
    fallen = float(trajectory.com[0, 1, 2] - trajectory.com[10, 1, 2])
    assert fallen == pytest.approx(9.81 * 0.2**2 / 2, rel=0.01)
    assert float(trajectory.positions[:, :, 2].min()) > -1e-3
