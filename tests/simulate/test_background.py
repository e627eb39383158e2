"""Fixed boxes that represent the background of a scene."""

import math
from dataclasses import replace

import numpy as np
import torch

from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.shapes import box, to_gaussians
from stages.simulate.background import background_boxes, merged


def test_boxes_cover_the_full_cells_once():
    full = np.random.default_rng(0).random((9, 8, 7)) < 0.6
    count = np.zeros(full.shape, int)
    for low, high in merged(full):
        count[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] += 1
    assert np.array_equal(count, full.astype(int))
    assert merged(np.ones((3, 4, 5), bool)) == [((0, 0, 0), (3, 4, 5))]


def test_a_wall_becomes_boxes_but_neither_the_table_nor_what_adjoins_an_object():
    pieces = [box((0.2,) * 3, 0.01).moved((0, 0, 0.1)), box((0.02, 0.5, 0.3), 0.004).moved((0.15, 0, 0.15)),
              box((0.002, 0.18, 0.18), 0.004).moved((-0.102, 0, 0.1)), box((1, 1, 0.01), 0.01)]  # fmt: skip
    gaussians = [to_gaussians(p, torch.full((len(p.points), 3), 0.5), int(i == 0), widest=math.inf)
                 for i, p in enumerate(pieces)]  # fmt: skip
    gaussians = [replace(g, opacities=torch.ones_like(g.opacities)) for g in gaussians]
    scene = Scene(concatenate(gaussians), (SceneObject(1, "cube"),), None, 0.0)
    boxes = np.array(background_boxes(scene, 0.0))
    low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
    assert 0.13 < low[0] < 0.141 and 0.159 < high[0] < 0.17  # the piece at -0.102 touches the cube
    shift = np.array([4.0, -3.0, 2.0])
    moved = replace(scene.gaussians, means=scene.gaussians.means + torch.from_numpy(shift).float())
    again = np.array(background_boxes(replace(scene, gaussians=moved, floor=2.0), 2.0)) - shift
    bounds = np.stack([again[:, 0].min(0), again[:, 1].max(0)])
    np.testing.assert_allclose(bounds, [low, high], atol=0.01)  # equal to a voxel, because means are rounded
    assert abs(high[2] - 0.3) < 0.01 and 0 < low[2] < 0.02 and abs(high[1] - 0.2) < 0.01  # limits of the region
