"""Contact search against loops over all pairs."""

import itertools

import pytest
import torch

from stages.core.models.field.narrow_phase import _all_pairs, _culled, near_walls, nearest
from tests.core.models.worlds import crowd, padded


@pytest.mark.parametrize("search", [_all_pairs, _culled])
def test_nearest_equals_a_loop(search):
    initial, reach = padded(crowd(2, 3, 9), 1, 2), 0.15
    x, valid = initial.points, initial.valid
    distance, index = search(x, valid, reach)
    seen = 0
    for b, i, j, n in itertools.product(range(2), range(4), range(4), range(11)):
        gap = (x[b, i, n] - x[b, j]).norm(dim=-1).masked_fill(~valid[b, j], torch.inf).min()
        if i == j or not valid[b, i, n] or not valid[b, j].any():
            assert distance[b, i, j, n] == torch.inf
        elif gap < reach:
            assert abs(distance[b, i, j, n] - gap) < 1e-6  # candidates are in single precision
            assert (x[b, i, n] - x[b, j, index[b, i, j, n]]).norm() == pytest.approx(float(gap), abs=1e-6)
            seen += 1
    assert seen > 50


def test_only_what_is_within_reach_is_found():
    initial = crowd(2, 3, 9)
    distance, _ = nearest(initial.points, initial.valid, 0.1)
    near, _ = nearest(initial.points, initial.valid, 0.05)
    assert distance[distance.isfinite()].max() < 0.1
    assert torch.equal(near.isfinite(), distance < 0.05) and near.isfinite().any()


def test_many_points_are_searched_as_few_are():
    initial = crowd(2, 3, 300)
    (a, i), (b, j) = (f(initial.points, initial.valid, 0.1) for f in (nearest, _all_pairs))
    b = b.masked_fill(b >= 0.1, torch.inf)
    torch.testing.assert_close(a, b)
    assert torch.equal(i[a.isfinite()], j[a.isfinite()])


def test_a_far_scene_is_as_exact_as_one_at_the_origin():
    initial = crowd(1, 2, 40)
    near = nearest(initial.points.float(), initial.valid, 1.0)[0]
    # float32 at 64 m resolves 4e-6 m
    far = nearest(initial.points.float() + 64, initial.valid, 1.0)[0]
    torch.testing.assert_close(far, near, rtol=0, atol=2e-5)


def test_walls_are_felt_on_both_sides_and_the_ceiling_is_open():
    initial = crowd(1, 1, 6)
    places = [[0, 0, -0.94], [0, 0, -0.98], [0, 0, -1.0], [1.93, 0, 0], [0, -1.98, 0], [0, 0, 2.94]]
    points = torch.tensor(places).double()[None, None]
    felt = near_walls(points, initial.valid, initial.box, 0.05)
    assert felt.flatten().tolist() == [True, True, False, True, True, False]
