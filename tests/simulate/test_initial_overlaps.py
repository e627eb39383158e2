"""Initial overlaps: the allowed overlap decreases with the actual overlap, and does not increase again."""

import numpy as np
import pytest

from stages.simulate.initial_overlaps import WINDOW, InitialOverlaps

mujoco = pytest.importorskip("mujoco")


def test_the_allowed_overlap_is_the_least_since_the_start():
    spec = mujoco.MjSpec()
    for x in (0.0, 0.15):
        body = spec.worldbody.add_body(pos=[x, 0, 0])
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    overlaps = InitialOverlaps(model, data)

    def after(distance: float, fixed: bool = False) -> float:
        data.qpos[7] = distance
        for _ in range(2 * WINDOW):
            mujoco.mj_fwdPosition(model, data)
            overlaps.subtract(data, np.array([True, fixed, fixed]), data.ncon)
        return overlaps.allowed.depth[0]

    assert after(0.15) == pytest.approx(0.05)
    assert after(0.17, fixed=True) == pytest.approx(0.05)
    assert after(0.17) == pytest.approx(0.03) and after(0.15) == pytest.approx(0.03)
    assert after(0.25) == 0
