"""Contact search, compared with loops over all pairs."""

import itertools

import pytest
import torch

from stages.core.models.field.narrow_phase import _all_pairs, _argmin, _culled, near_walls, nearest
from tests.core.models.dynamics_fixtures import add_padding, overlapping_objects


@pytest.mark.parametrize("search", [_all_pairs, _culled])
def test_nearest_equals_a_loop(search):
    initial, radius = add_padding(overlapping_objects(2, 3, 9), 1, 2), 0.15
    x, valid = initial.points, initial.valid
    distance, index = search(x, valid, radius)
    count = 0
    for b, i, j, n in itertools.product(range(2), range(4), range(4), range(11)):
        gap = (x[b, i, n] - x[b, j]).norm(dim=-1).masked_fill(~valid[b, j], torch.inf).min()
        if i == j or not valid[b, i, n] or not valid[b, j].any():
            assert distance[b, i, j, n] == torch.inf
        elif gap < radius:
            assert abs(distance[b, i, j, n] - gap) < 1e-6  # candidates are in single precision
            assert (x[b, i, n] - x[b, j, index[b, i, j, n]]).norm() == pytest.approx(float(gap), abs=1e-6)
            count += 1
    assert count > 50


def test_only_points_within_the_radius_are_found():
    initial = overlapping_objects(2, 3, 9)
    distance, _ = nearest(initial.points, initial.valid, 0.1)
    near, _ = nearest(initial.points, initial.valid, 0.05)
    assert distance[distance.isfinite()].max() < 0.1
    assert torch.equal(near.isfinite(), distance < 0.05) and near.isfinite().any()


@pytest.mark.parametrize("keypoints", [200, 300])  # the search is sequential over objects, and parallel
def test_culled_search_equals_all_pairs(keypoints):
    initial = overlapping_objects(2, 3, keypoints)
    (a, i), (b, j) = (f(initial.points, initial.valid, 0.1) for f in (nearest, _all_pairs))
    b = b.masked_fill(b >= 0.1, torch.inf)
    torch.testing.assert_close(a, b)
    assert torch.equal(i[a.isfinite()], j[a.isfinite()])


def test_of_equally_near_points_the_first_is_found_and_nan_is_smallest():
    rows = torch.tensor([[3.0, 1.0, 2.0, 1.0], [torch.inf] * 4, [1.0, torch.nan, -1.0, torch.nan]])
    assert _argmin(rows).tolist() == rows.argmin(-1).tolist() == [1, 0, 1]


def test_accuracy_does_not_depend_on_the_distance_to_the_origin():
    initial = overlapping_objects(1, 2, 40)
    near = nearest(initial.points.float(), initial.valid, 1.0)[0]
    # at a distance of 64 m, float32 resolves 4e-6 m
    far = nearest(initial.points.float() + 64, initial.valid, 1.0)[0]
    torch.testing.assert_close(far, near, rtol=0, atol=2e-5)


def test_near_walls_covers_both_sides_and_ignores_the_ceiling():
    initial = overlapping_objects(1, 1, 6)
    points = [[0, 0, -0.94], [0, 0, -0.98], [0, 0, -1.0], [1.93, 0, 0], [0, -1.98, 0], [0, 0, 2.94]]
    points = torch.tensor(points).double()[None, None]
    near = near_walls(points, initial.valid, initial.box, 0.05)
    assert near.flatten().tolist() == [True, True, False, True, True, False]
