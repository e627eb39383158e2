"""Merging of interlocking or suspended parts; all parts have the same colour."""

import torch

from stages.core.perception.body_merging import merge_bodies
from stages.core.perception.support import find_support
from stages.lab.assets.shapes import box, ellipsoid
from tests.segment.tabletop import coloured_gaussians, scene_of, table_gaussians


def brick(low: tuple, high: tuple, object_id: int):
    sides = tuple(b - a for a, b in zip(low, high, strict=True))
    middle = tuple((a + b) / 2 for a, b in zip(low, high, strict=True))
    return coloured_gaussians(box(sides, 0.007).moved(middle), (0.5, 0.5, 0.5), object_id)


def ball(centre: tuple, radius: float, object_id: int):
    return coloured_gaussians(ellipsoid((radius,) * 3, 1500).moved(centre), (0.5, 0.5, 0.5), object_id)


def bodies(*parts) -> set[frozenset[int]]:
    """Objects, each given by the numbers of its parts."""
    scene = scene_of(table_gaussians(), *parts)
    parts, ids = scene.gaussians.object_id, merge_bodies(scene.gaussians, find_support(scene)).object_id
    mine = {n: int(ids[parts == n].unique()) for n in parts.unique().tolist()}
    return {frozenset(n for n in mine if mine[n] == k) for k in set(mine.values())} - {frozenset({0})}


def test_interlocking_parts_are_one_body():
    belly = coloured_gaussians(ellipsoid((0.06, 0.06, 0.1), 2500).moved((0.0, 0.0, 0.1)), (0.5, 0.5, 0.5), 1)
    sides = [brick((-0.065, y, 0.07), (0.065, y + 0.02, 0.11), 2) for y in (-0.065, 0.045)]
    front = [brick((x, -0.045, 0.07), (x + 0.02, 0.045, 0.11), 2) for x in (-0.065, 0.045)]
    # they stand on the table by themselves
    legs = [brick((0.045, y, 0.0), (0.065, y + 0.02, 0.07), 2) for y in (-0.065, 0.045)]
    assert bodies(belly, *sides, *front, *legs) == {frozenset({1, 2})}


def test_touching_objects_stay_separate():
    side_by_side = brick((-0.1, -0.05, 0.0), (0.0, 0.05, 0.1), 1), brick((0.003, -0.05, 0.0), (0.1, 0.05, 0.1), 2)
    assert bodies(*side_by_side) == {frozenset({1}), frozenset({2})}
    assert bodies(side_by_side[0], ball((0.06, 0.0, 0.06), 0.058, 2)) == {frozenset({1}), frozenset({2})}


def test_one_sided_hull_overlap_does_not_merge():
    corner = brick((-0.1, -0.1, 0.0), (0.1, -0.07, 0.1), 1), brick((-0.1, -0.07, 0.0), (-0.07, 0.1, 0.1), 1)
    assert bodies(*corner, ball((-0.02, -0.02, 0.045), 0.045, 2)) == {frozenset({1}), frozenset({2})}


def test_suspended_parts_merge_and_supported_ones_do_not():
    post = brick((-0.03, -0.03, 0.0), (0.03, 0.03, 0.2), 1)
    on_top = ball((0.0, 0.0, 0.25), 0.05, 2)
    assert bodies(post, on_top) == {frozenset({1}), frozenset({2})}
    # it is at the side of the post and does not extend down to the table
    plait = brick((0.032, -0.02, 0.06), (0.07, 0.02, 0.21), 2)
    assert bodies(post, plait) == {frozenset({1, 2})}
    leaning = brick((0.032, -0.02, 0.0), (0.07, 0.02, 0.15), 2)
    assert bodies(post, leaning) == {frozenset({1}), frozenset({2})}


def test_non_finite_gaussians_keep_their_labels():
    scene = scene_of(table_gaussians(), brick((-0.1, -0.05, 0.0), (0.0, 0.05, 0.1), 1))
    scene.gaussians.means[-3:] = torch.nan
    assert torch.equal(merge_bodies(scene.gaussians, find_support(scene)).object_id, scene.gaussians.object_id)
