"""Keypoints of objects, and the weights with which Gaussians follow them."""

import math
from dataclasses import replace

import pytest
import torch

from stages.core.physics import keypoints as module
from stages.core.physics.keypoints import (
    bind_gaussians,
    choose_keypoints,
    farthest_points,
    nearest_weights,
    pull_range,
)
from stages.core.scene.trajectory import Keypoints
from tests.core.physics.test_particles import scene, splats


def test_weights_of_neighbours_on_a_line():
    """Weights are (1 - (d / r)^2)^2; r is the distance of the next neighbour after the k nearest."""
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [7, 0, 0]])
    index, weight = nearest_weights(points, torch.zeros(1, 3), 2)
    raw = torch.tensor([1.0, (1 - 1 / 9) ** 2])
    assert index.tolist() == [[0, 1]]
    torch.testing.assert_close(weight, (raw / raw.sum())[None])
    _, beyond = nearest_weights(points, torch.tensor([[8.0, 0, 0]]), 3)
    raw = torch.tensor([(1 - d * d / 64) ** 2 for d in (1, 5, 7)])
    torch.testing.assert_close(beyond, (raw / raw.sum())[None])


def test_weights_of_fewer_points_than_neighbours():
    """The radius is 1.5 times the distance of the farthest point; the unused columns have zero weight."""
    points = torch.tensor([[0.0, 0, 0], [2, 0, 0]])
    index, weight = nearest_weights(points, torch.zeros(1, 3), 4)
    raw = torch.tensor([1.0, (1 - 4 / 9) ** 2, 0, 0])
    torch.testing.assert_close(weight, (raw / raw.sum())[None])
    assert index[0, :2].tolist() == [0, 1]
    for one in (torch.zeros(1, 3), torch.ones(1, 3)):  # a query at the point and one elsewhere
        _, alone = nearest_weights(one, torch.zeros(3, 3), 4)
        assert alone.tolist() == [[1.0, 0, 0, 0]] * 3
    same = nearest_weights(torch.zeros(5, 3), torch.zeros(1, 3), 4)[1]
    torch.testing.assert_close(same, torch.full((1, 4), 0.25))  # all points coincide


def test_rounding_does_not_choose_between_points_that_are_equally_far():
    """On a lattice, most distances are equal; moving and scaling by rounding errors must give the same neighbours."""
    lattice = torch.cartesian_prod(*[torch.arange(9.0)] * 3)
    chosen = farthest_points(lattice, 60)
    assert len(chosen.unique()) == 60
    for scale, offset in ((1 / 3, 0.0), (0.07, 0.3), (1.7, -20.0)):
        assert torch.equal(farthest_points(lattice * scale + offset, 60), chosen), (scale, offset)


def test_keypoints_are_among_the_usable_gaussians_without_outliers():
    line = torch.cat([torch.linspace(0, 1, 41)[:, None], torch.zeros(41, 2)], 1)
    g = splats(torch.cat([line, torch.tensor([[500.0, 0, 0]])]))
    g.opacities[10:20] = 0.001
    found = choose_keypoints(scene(g, splats(line + 5, id=2)), 1000)
    first = found.rest[found.object_id == 1]
    assert len(first) == 31 and float(first[:, 0].max()) == 1
    assert not any(bool((first == p).all(1).any()) for p in line[10:20])
    assert int((found.object_id == 2).sum()) == 41


def test_objects_without_usable_gaussians_have_keypoints_where_these_are():
    g = splats(torch.tensor([[0.0, 0, 0], [1, 0, 0], [math.nan, 0, 0], [2, 0, 0], [3, math.inf, 0]]))
    g = replace(g, opacities=torch.zeros(5))
    nowhere = splats(torch.full((3, 3), math.nan), id=2)
    found = choose_keypoints(scene(g, nowhere), 8)
    assert sorted(found.rest[:, 0].tolist()) == [0, 1, 2] and found.object_id.tolist() == [1] * 3
    assert len(choose_keypoints(scene(replace(nowhere, object_id=torch.ones(3, dtype=torch.int64))), 8).rest) == 0


def test_an_object_is_not_reduced_to_a_point():
    """With two Gaussians one would be an outlier; of the three here only one is usable."""
    pair = splats(torch.tensor([[0.0, 0, 0], [0, 0, 1]]))
    three = splats(torch.tensor([[2.0, 0, 0], [3, 0, 0], [4, 0, 0]]))
    three = replace(three, opacities=torch.tensor([0.0, 0.9, 0.0]), object_id=torch.full((3,), 2))
    assert choose_keypoints(scene(pair, three), 8).object_id.tolist() == [1, 1, 2, 2, 2]


def test_of_many_gaussians_some_are_candidates(monkeypatch):
    monkeypatch.setattr(module, "MAX_CANDIDATES", 50)
    g = splats(torch.rand(500, 3, generator=torch.Generator().manual_seed(0)))
    a, b = (choose_keypoints(scene(g), 200, seed).rest for seed in (0, 1))
    assert len(a) == len(b) == 50 and not torch.equal(a, b)
    assert torch.equal(a, choose_keypoints(scene(g), 200, 0).rest)


def test_gaussians_follow_keypoints_of_their_own_object():
    g = splats(torch.rand(40, 3, generator=torch.Generator().manual_seed(0)))
    other = splats(g.means.clone(), id=2)
    other.means[3, 1] = math.nan
    both = scene(g, other, splats(torch.zeros(5, 3), id=0))
    both = replace(both, objects=both.objects[:2])
    keypoints = choose_keypoints(both, 16)
    binding = bind_gaussians(both, keypoints)
    index, weight = binding.index, binding.weight
    for row, id in enumerate(both.gaussians.object_id.tolist()):
        if id == 0 or row == 43:
            assert (index[row] == -1).all() and not weight[row].any()
        else:
            assert (keypoints.object_id[index[row]] == id).all() and float(weight[row].sum()) == pytest.approx(1)
    at = (keypoints.rest[0] == g.means).all(1).nonzero()[0, 0]
    assert int(index[at, 0]) == 0 and float(weight[at, 0]) == float(weight[at].max())


def test_each_point_is_the_farthest_from_those_before_it():
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    rows = farthest_points(points, 20)
    distance = torch.cdist(points, points)
    for i in range(1, 20):
        to_chosen = distance[rows[:i]].amin(0)
        assert to_chosen[rows[i]] == to_chosen.max()
    assert len(farthest_points(points[:7], 20).unique()) == 7 and len(farthest_points(points[:0], 5)) == 0
    assert int(farthest_points(points, 1, seed=1)) != int(farthest_points(points, 1, seed=2))


def test_users_pull_within_walls_with_a_margin_of_the_extent():
    keypoints = Keypoints(torch.tensor([[0.0, 0, 0], [4, 1, 2]]), torch.tensor([1, 2]))
    low, high = pull_range(keypoints, (-10.0, -10.0, 0.0), (10.0, 10.0, 20.0))
    assert low == pytest.approx((-9.4, -9.4, 0.6)) and high == pytest.approx((9.4, 9.4, 19.4))  # 0.15 of 4
