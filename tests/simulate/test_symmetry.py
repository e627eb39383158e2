"""Scenes rotated about the vertical: bodies fall and hit the floor in the same way."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.simulate.options import SimulateOptions
from tests.core.physics.test_particles import scene, splats
from tests.core.physics.test_random_surfaces import box_samples
from tests.simulate.motion import roll_out


@pytest.mark.parametrize("engine", ["rigid", "ngff"])
def test_a_tilted_box_hits_the_floor_in_the_same_way_in_a_turned_scene(device, engine):
    """A step derived from the sides of axis-aligned boxes would change the time of the impact by 0.001."""
    tilt, turn = Rotation.from_rotvec([0.2, 0.35, 0.0]), Rotation.from_rotvec([0.0, 0.0, 0.65])
    points = tilt.apply(box_samples((0.2, 0.3, 0.1), 4000)) + [0.0, 0.0, 0.2]
    solved = {"contact": "solved"} if engine == "ngff" else {}
    options = SimulateOptions(engine=engine, steps=11, keypoints=64, quality="draft", device=device, **solved)

    def motion(points: np.ndarray) -> np.ndarray:
        return roll_out(scene(splats(torch.from_numpy(points)), floor=0.0), options).com[:, 0].double().numpy()

    here = motion(points)
    assert np.diff(here[:, 2]).max() > -0.01  # it has hit the floor
    np.testing.assert_allclose(motion(turn.apply(points)), turn.apply(here), rtol=0, atol=1e-4)
