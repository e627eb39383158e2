"""Detection of objects on a wall."""

from dataclasses import replace

import pytest
import torch

from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.perception.grouping import group_objects
from stages.core.perception.support import view_extent
from stages.core.perception.wall import find_wall, rotate_wall_to_floor
from stages.core.scene.gaussians import transformed
from stages.core.scene.scene import Scene
from tests.segment.tabletop import best_overlap, block, scene_of, table_gaussians, three_apart

UP = Similarity(1.0, matrix(torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0])), torch.tensor([0.3, -0.2, 0.4]))


def hung(scene: Scene) -> Scene:
    """A tabletop scene rotated by 90 degrees about x into a wall that faces -y; without a floor."""
    return replace(scene, gaussians=transformed(scene.gaussians, UP), cameras=scene.cameras.transformed(UP), floor=None)


def test_wall_is_rotated_to_the_floor():
    scene = hung(three_apart(noise=0.001))
    turn = find_wall(scene, view_extent(scene))
    laid = rotate_wall_to_floor(scene, turn)
    wall = laid.gaussians.means[scene.gaussians.object_id == 0]
    assert float(wall[:, 2].abs().median()) < 0.002  # the noise of the points
    assert float(laid.gaussians.means[scene.gaussians.object_id > 0][:, 2].min()) > -0.004
    back = transformed(laid.gaussians, turn.inverse())
    torch.testing.assert_close(back.means, scene.gaussians.means, rtol=0, atol=1e-5)
    torch.testing.assert_close(back.sh, scene.gaussians.sh, rtol=0, atol=1e-5)


def test_objects_on_a_wall_are_found():
    scene = hung(three_apart(noise=0.001))
    blank = replace(scene, gaussians=replace(scene.gaussians, object_id=torch.zeros_like(scene.gaussians.object_id)))
    found = group_objects(blank)
    assert len(found.objects) == 3
    assert min(best_overlap(found.gaussians.object_id, scene.gaussians.object_id).values()) >= 0.9
    assert torch.equal(found.gaussians.means, scene.gaussians.means)  # the scene is labelled, not rotated


@pytest.mark.parametrize(
    "scene",
    [
        three_apart(),  # a table is not a wall
        replace(three_apart(), floor=None),  # not even if the floor height is unknown
        hung(scene_of(block((0.0, 0.0), (0.4, 0.4, 0.1), (0.8, 0.1, 0.1), 1))),  # the front of a book is not a wall
        replace(hung(three_apart()), cameras=None),  # the visible side is unknown
    ],
    ids=["floor", "table", "book", "no cameras"],
)
def test_no_wall(scene):
    assert find_wall(scene, view_extent(scene)) is None


def test_plane_with_gaussians_behind_it_is_no_wall():
    scene = hung(scene_of(table_gaussians()))
    behind = transformed(scene.gaussians, Similarity(1.0, torch.eye(3), torch.tensor([0.0, 0.15, 0.0])))
    both = replace(scene, gaussians=type(behind)(*(torch.cat(pair) for pair in zip(
        vars(scene.gaussians).values(), vars(behind).values(), strict=True))))  # fmt: skip
    assert find_wall(scene, view_extent(scene)) is not None
    assert find_wall(both, view_extent(both)) is None
