"""Registration of parts to whole objects: exact without noise, and within tolerances with noise."""

from dataclasses import replace

import pytest
import torch

from stages.core.geometry.neighbours import BruteForce
from stages.core.geometry.rotations import matrix
from stages.lab.assets.shapes import ellipsoid
from stages.lab.bench.register import errors, make_trial
from stages.lab.bench.scene_options import RegisterBenchOptions
from stages.refine import registration, registration_cloud
from stages.refine.registration import register
from stages.refine.registration_cloud import RegistrationCloud, diameter
from stages.refine.registration_hypotheses import PoseHypotheses, local_features
from tests.conftest import DEVICES
from tests.refine.sample_objects import asymmetric_object, degrees_between, random_similarity
from tests.segment.tabletop import coloured_gaussians


@pytest.fixture(scope="module")
def whole():
    return asymmetric_object()


def test_transformed_copy_is_registered(whole):
    truth = random_similarity(3)
    found = register(replace(whole, means=truth(whole.means)), whole)
    assert degrees_between(found.similarity.rotation, truth.rotation) < 0.3
    assert found.similarity.scale == pytest.approx(truth.scale, rel=3e-3)
    assert (found.similarity(whole.means) - truth(whole.means)).norm(dim=1).max() < 5e-3 * truth.scale
    assert found.fit > 0.97


@pytest.mark.parametrize("number", [0, 1])  # a cut and a bitten part
def test_noisy_part_is_registered_within_tolerance(whole, number):
    given = make_trial(whole, number, RegisterBenchOptions())
    assert len(given.part) == round(0.6 * len(whole))
    wrong = errors(register(given.part, whole).similarity, given, whole, revolved=False)
    assert wrong["rotation"] < 2 and wrong["scale"] < 2 and wrong["shift"] < 1


@pytest.mark.slow
def test_brute_force_search_gives_the_same_registration(whole, monkeypatch):
    monkeypatch.setattr(registration_cloud, "TARGET_POINTS", 1500)  # searching all pairs is slow on a CPU
    given = make_trial(whole, 1, RegisterBenchOptions())
    expected = register(given.part, whole)
    for module in (registration, registration_cloud):
        monkeypatch.setattr(module, "neighbour_index", BruteForce)
    found = register(given.part, whole)
    assert degrees_between(found.similarity.rotation, expected.similarity.rotation) < 0.5
    assert found.similarity.scale == pytest.approx(expected.similarity.scale, rel=5e-3)
    assert found.fit == pytest.approx(expected.fit, abs=0.01)


@pytest.mark.gpu
@pytest.mark.skipif("cuda" not in DEVICES, reason="no NVIDIA GPU")
def test_registration_on_a_gpu(whole):
    given = make_trial(whole, 1, RegisterBenchOptions())
    near = given.truth._replace(scale=1.02 * given.truth.scale)  # a hint on the CPU, such as from a camera
    for hints in ((), (near,)):
        found = register(given.part.to("cuda"), whole.to("cuda"), hints=hints).similarity
        assert found.rotation.is_cuda and found.translation.is_cuda
        wrong = errors(found.to("cpu"), given, whole, revolved=False)
        assert wrong["rotation"] < 2 and wrong["scale"] < 2 and wrong["shift"] < 1


def test_another_object_has_a_lower_fit(whole):
    given = make_trial(whole, 0, RegisterBenchOptions())
    stranger = coloured_gaussians(ellipsoid((0.3, 0.2, 0.5), 6000), (0.8, 0.7, 0.6), 1)
    other = register(given.part, stranger)
    assert other is None or other.fit < register(given.part, whole).fit - 0.15


def test_sphere_is_registered_up_to_rotation():
    ball = coloured_gaussians(ellipsoid((0.5, 0.5, 0.5), 8000), (0.8, 0.2, 0.1), 1)
    given = make_trial(ball, 1, RegisterBenchOptions())
    found = register(given.part, ball)
    if found is not None:  # a sphere has no distinctive features, so there may be no hypothesis
        wrong = errors(found.similarity, given, ball, revolved=False)
        assert wrong["scale"] < 3 and wrong["shift"] < 2


def test_too_few_points_give_no_registration(whole):
    assert register(whole[:40], whole) is None


def test_features_are_invariant_to_similarities(whole):
    truth = random_similarity(1)
    a, b = RegistrationCloud.of(whole), RegistrationCloud.of(replace(whole, means=truth(whole.means)))
    nearest = torch.cdist(truth(a.points * a.diameter + a.centre), b.points * b.diameter + b.centre)
    same = nearest.amin(1) < 0.004 * b.diameter
    i, j = torch.nonzero(same)[:50, 0], nearest.argmin(1)[same][:50]
    own, others = local_features(a, i, 1.0), local_features(b, torch.randperm(len(b.points))[:50], 1.0)
    assert (own - local_features(b, j, 1.0)).norm(dim=1).median() < 0.3 * (own - others).norm(dim=1).median()


def test_fitted_poses_are_exact():
    truth = random_similarity(5)
    a = torch.randn(4, 3, 3)
    poses = PoseHypotheses.fitted(a, truth(a))
    torch.testing.assert_close(poses.scale, torch.full((4,), truth.scale), rtol=1e-4, atol=0)
    torch.testing.assert_close(poses.rotation, truth.rotation.expand(4, 3, 3), rtol=0, atol=1e-4)


def test_distinct_keeps_the_first_of_similar_poses():
    # rotations by 0, 1, 33, 0 and 34 degrees
    turns = matrix(torch.tensor([[1.0, 0, 0, a] for a in (0.0, 0.01, 0.3, 0.0, 0.31)]))
    shift = torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0.1, 0], [0, 0, 0]])
    kept = PoseHypotheses(torch.arange(5.0), turns, shift).distinct(3, degrees=5.0, shift=0.05)
    assert kept.scale.tolist() == [0.0, 2.0, 3.0]


def test_diameter_of_a_box_is_its_diagonal():
    corners = torch.cartesian_prod(*[torch.tensor([0.0, s]) for s in (1.0, 2.0, 2.0)])
    assert diameter(corners) == pytest.approx(3.0)
