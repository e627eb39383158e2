"""The initial state of a simulation."""

import math

import pytest
import torch

from stages.core.physics.forces import ForcePrompts
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.shapes import box, to_gaussians
from stages.simulate.options import SimulateOptions
from stages.simulate.setup import set_up_scene


@pytest.mark.parametrize("side", [0.1, 0.12, 0.15])
def test_boxes_on_the_floor_are_not_moved_for_mpm(side):
    """One box, and several small ones of few particles; voxels that are less than 1/10 filled have no particle."""
    for places in ([(0.0, 0.0)], [(x, y) for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4)]):
        cubes = [box((side,) * 3, side / 24).moved((x, y, side / 2)) for x, y in places]
        parts = [to_gaussians(c, torch.full((len(c.points), 3), 0.5), i + 1, widest=math.inf)
                 for i, c in enumerate(cubes)]  # fmt: skip
        objects = tuple(SceneObject(i + 1, f"box{i + 1}") for i in range(len(cubes)))
        scene = Scene(concatenate(parts), objects, None, 0.0)
        setup = set_up_scene(scene, ForcePrompts(), SimulateOptions(engine="mpm", quality="draft"), refinement=1)
        assert float(setup.floor_offset.abs().max()) < 0.1 * setup.bodies.spacing
