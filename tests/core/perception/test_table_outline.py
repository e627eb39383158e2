"""The outline of a table, detected from cameras that see the ground beyond its edges."""

from dataclasses import replace

import numpy as np
import torch

from stages.core.perception.table_outline import table_outline
from stages.core.scene.gaussians import concatenate
from tests.tables import GROUND, HIGH, LOW, level, table_scene


def test_the_edges_of_a_table_are_where_the_ground_is_seen():
    outline = table_outline(table_scene())
    along = np.linspace(-1, 1, 21)
    for half, axis in ((HIGH[0], 0), (HIGH[1], 1)):
        for side in (-1, 1):
            other = 0.8 * along * (HIGH[0] + HIGH[1] - half)
            at = np.stack([other, other], 1)
            at[:, axis] = side * half
            # a cell has 0.013 m, and pixels of the depth maps are about as large
            np.testing.assert_allclose(outline.beyond(at), 0, atol=0.03)
    assert GROUND - 0.01 < outline.ground < GROUND + 0.04  # depth maps contain the minimum of 3 x 3 pixels


def test_a_table_that_fills_the_photos_has_no_edge():
    assert table_outline(table_scene(low=(-2, -2), high=(2, 2))) is None


def test_where_no_camera_sees_the_ground_the_table_goes_on():
    outline = table_outline(table_scene(low=(LOW[0], LOW[1]), high=(2.0, HIGH[1])))
    there = np.array([[1.5, 0.0], [4.0, 0.0], [-0.5, 0.0], [0.0, 0.4]])
    assert ((outline.beyond(there) > 0) == [False, False, True, True]).all()


def test_nothing_under_the_table_and_no_cameras_give_no_edge():
    assert table_outline(table_scene(ground=None)) is None
    assert table_outline(replace(table_scene(), cameras=None)) is None


def test_objects_that_stand_at_its_height_are_on_the_table():
    """One object is beyond the visible table; a leg next to the table extends to the ground and is not on it."""
    slab = level(0.005, (0.5, -0.03), (0.6, 0.03), 0.01, 0.5)
    leg = level(0.005, (-0.6, -0.03), (-0.5, 0.03), 0.01, 0.5)
    down = torch.tensor([0.0, 0.0, 0.4]) * torch.rand(len(leg), 1, generator=torch.Generator().manual_seed(0))
    things = [replace(slab, object_id=torch.ones_like(slab.object_id)),
              replace(leg, means=leg.means - down, object_id=torch.full_like(leg.object_id, 2))]  # fmt: skip
    outline = table_outline(table_scene(concatenate(things)))
    assert float(outline.beyond(np.array([[0.58, 0.0]]))[0]) <= 0.02
    assert float(outline.beyond(np.array([[-0.45, 0.0]]))[0]) > 0.05
