"""Parts are found on their wholes: exact without noise, within the limits with it, and strangers fit badly."""

from dataclasses import replace

import pytest
import torch

from stages.lab.bench_register import BenchOptions, errors, trial
from stages.lab.shapes import ellipsoid
from stages.refine.register import register
from stages.refine.register_cloud import Cloud, diameter
from stages.refine.register_guess import Poses, describe
from tests.refine.things import degrees_between, somewhere, thing
from tests.segment.tabletop import coloured


@pytest.fixture(scope="module")
def whole():
    return thing()


def test_a_moved_copy_is_found_where_it_was_put(whole):
    truth = somewhere(3)
    found = register(replace(whole, means=truth(whole.means)), whole)
    assert degrees_between(found.similarity.rotation, truth.rotation) < 0.3
    assert found.similarity.scale == pytest.approx(truth.scale, rel=3e-3)
    assert (found.similarity(whole.means) - truth(whole.means)).norm(dim=1).max() < 5e-3 * truth.scale
    assert found.fit > 0.97


@pytest.mark.parametrize("number", [0, 1])  # cut, bitten
def test_a_noisy_part_is_found_within_the_limits(whole, number):
    given = trial(whole, number, BenchOptions())
    assert len(given.part) == round(0.6 * len(whole))
    wrong = errors(register(given.part, whole).similarity, given, whole, revolved=False)
    assert wrong["rotation"] < 2 and wrong["scale"] < 2 and wrong["shift"] < 1


def test_another_thing_fits_less(whole):
    given = trial(whole, 0, BenchOptions())
    stranger = coloured(ellipsoid((0.3, 0.2, 0.5), 6000), (0.8, 0.7, 0.6), 1)
    other = register(given.part, stranger)
    assert other is None or other.fit < register(given.part, whole).fit - 0.15


def test_a_plain_ball_is_placed_though_it_may_be_turned_any_way():
    ball = coloured(ellipsoid((0.5, 0.5, 0.5), 8000), (0.8, 0.2, 0.1), 1)
    given = trial(ball, 1, BenchOptions())
    found = register(given.part, ball)
    if found is not None:  # no feature stands out, so it may find nothing
        wrong = errors(found.similarity, given, ball, revolved=False)
        assert wrong["scale"] < 3 and wrong["shift"] < 2


def test_a_handful_of_points_is_not_enough(whole):
    assert register(whole[:40], whole) is None


def test_features_do_not_depend_on_where_and_how_a_cloud_lies(whole):
    truth = somewhere(1)
    a, b = Cloud.of(whole), Cloud.of(replace(whole, means=truth(whole.means)))
    nearest = torch.cdist(truth(a.points * a.diameter + a.centre), b.points * b.diameter + b.centre)
    same = nearest.amin(1) < 0.004 * b.diameter
    i, j = torch.nonzero(same)[:50, 0], nearest.argmin(1)[same][:50]
    own, others = describe(a, i, 1.0), describe(b, torch.randperm(len(b.points))[:50], 1.0)
    assert (own - describe(b, j, 1.0)).norm(dim=1).median() < 0.3 * (own - others).norm(dim=1).median()


def test_poses_are_fitted_exactly():
    truth = somewhere(5)
    a = torch.randn(4, 3, 3)
    poses = Poses.fitted(a, truth(a))
    torch.testing.assert_close(poses.scale, torch.full((4,), truth.scale), rtol=1e-4, atol=0)
    torch.testing.assert_close(poses.rotation, truth.rotation.expand(4, 3, 3), rtol=0, atol=1e-4)


def test_the_diameter_of_a_box_is_its_diagonal():
    corners = torch.cartesian_prod(*[torch.tensor([0.0, s]) for s in (1.0, 2.0, 2.0)])
    assert diameter(corners) == pytest.approx(3.0)
