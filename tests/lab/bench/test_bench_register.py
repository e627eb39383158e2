"""The registration benchmark: error measures, symmetries, and the baselines ICP and splatreg."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from stages.core.backends import pick_device
from stages.core.geometry.harmonics import rgb_to_sh
from stages.core.geometry.rotations import matrix, rotation_angle
from stages.core.geometry.similarity import Similarity, umeyama
from stages.lab.assets.shapes import ellipsoid
from stages.lab.bench import common as bench
from stages.lab.bench import register as bench_register
from stages.lab.bench.register import errors, icp, make_trial, nearest_z_rotation, run, splatreg
from stages.lab.bench.scene_options import RegisterBenchOptions
from tests.refine.sample_objects import asymmetric_object, random_similarity
from tests.segment.tabletop import coloured_gaussians


@pytest.fixture(scope="module")
def can():
    """A grey ellipsoid; the fixture `painted` has one red side."""
    return coloured_gaussians(ellipsoid((0.3, 0.3, 0.5), 8000), (0.5, 0.5, 0.5), 1, grain=0.0)


def turned_about_z(pose: Similarity, degrees: float) -> Similarity:
    half = torch.deg2rad(torch.tensor(degrees / 2))
    about = matrix(torch.stack([half.cos(), torch.tensor(0.0), torch.tensor(0.0), half.sin()]))
    return Similarity(pose.scale, pose.rotation @ about, pose.translation)


def test_errors_of_known_deviations(can):
    given = make_trial(can, 0, RegisterBenchOptions())
    exact = errors(given.truth, given, can, revolved=True)
    assert max(exact.values()) < 0.1
    larger = given.truth._replace(scale=1.05 * given.truth.scale)
    assert errors(larger, given, can, revolved=False)["scale"] == pytest.approx(5, abs=1e-3)
    off = turned_about_z(given.truth, 20.0)
    assert errors(off, given, can, revolved=False)["rotation up to symmetry"] == pytest.approx(20, abs=0.1)


def test_invisible_rotation_is_no_error(can):
    given = make_trial(can, 0, RegisterBenchOptions())
    off = turned_about_z(given.truth, 90.0)
    assert errors(off, given, can, revolved=True)["rotation up to symmetry"] < 0.1
    red = torch.where(can.means[:, :1] > 0, torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.5, 0.5, 0.5]))
    painted = replace(can, sh=rgb_to_sh(red))
    assert errors(off, given, painted, revolved=True)["rotation up to symmetry"] == pytest.approx(90, abs=0.1)


def test_parts_have_the_requested_size_and_pose(can):
    given = make_trial(can, 1, RegisterBenchOptions(missing=0.4, noise=0.0, tint=0.0))
    assert len(given.part) == round(0.6 * len(can))
    torch.testing.assert_close(given.part.means, given.truth(can.means[given.seen]))
    torch.testing.assert_close(given.part.sh, can.sh[given.seen])


def test_nearest_z_rotation():
    a = matrix(torch.tensor([0.9, 0.0, 0.0, 0.3]))
    assert rotation_angle(a @ nearest_z_rotation(a).mT) < 0.1
    x = matrix(torch.tensor([0.9, 0.3, 0.0, 0.0]))
    assert rotation_angle(nearest_z_rotation(x)) < 0.1


def test_inverse_similarity():
    pose = random_similarity(2)
    points = torch.randn(5, 3)
    torch.testing.assert_close(pose.inverse()(pose(points)), points, rtol=0, atol=1e-5)


def test_icp_corrects_small_rotations():
    whole = asymmetric_object(0.02)
    pose = Similarity(1.3, matrix(torch.tensor([1.0, 0.02, 0.03, -0.02])), torch.tensor([0.2, 0.1, 0.0]))
    found = icp(replace(whole, means=pose(whole.means)), whole)
    assert (found(whole.means) - pose(whole.means)).norm(dim=1).mean() < 0.03


@pytest.fixture
def stand_in(monkeypatch):
    """Module that replaces splatreg; it matches by colour and returns a 4x4 pose, from model to observation."""

    def estimate_object_pose(model, observation, *, init, transform):
        assert (init, transform) == ("features", "sim3") and torch.get_num_threads() == 1
        for g in (model, observation):
            assert not g.log_scales and (g.colors >= 0).all() and (g.colors <= 1).all()
            assert (g.means - g.means.mean(0)).square().sum(1).mean().sqrt() == pytest.approx(0.14, rel=1e-4)
        pose = umeyama(model.means, observation.means[torch.cdist(model.colors, observation.colors).argmin(1)])
        T = torch.eye(4)
        T[:3, :3], T[:3, 3] = pose.scale * pose.rotation, pose.translation
        return SimpleNamespace(T_SO=T)

    def gaussians(means, quats, scales, opacities, colors=None, log_scales=False):
        return SimpleNamespace(means=means, colors=colors, scales=scales, log_scales=log_scales)

    module = SimpleNamespace(Gaussians=gaussians, estimate_object_pose=estimate_object_pose)
    monkeypatch.setitem(sys.modules, "splatreg", module)


def test_splatreg_interface(can, stand_in):
    rng, threads = torch.Generator().manual_seed(0), torch.get_num_threads()
    whole = can[torch.randperm(len(can), generator=rng)[: bench_register.SPLATREG_GAUSSIANS]]
    whole = replace(whole, sh=rgb_to_sh(torch.rand(len(whole), 3, generator=rng)))
    pose = random_similarity(3)
    found = splatreg(replace(whole, means=pose(whole.means), scales=pose.scale * whole.scales), whole)
    torch.testing.assert_close(found(whole.means), pose(whole.means), rtol=0, atol=1e-4)
    assert found.scale == pytest.approx(pose.scale, rel=1e-4) and torch.get_num_threads() == threads


def test_installed_splatreg_registers_a_whole_object():
    pytest.importorskip("splatreg")
    whole, pose = asymmetric_object(0.02), random_similarity(1)
    whole = whole[
        torch.randperm(len(whole), generator=torch.Generator().manual_seed(0))[: bench_register.SPLATREG_GAUSSIANS]
    ]
    found = splatreg(replace(whole, means=pose(whole.means), scales=pose.scale * whole.scales), whole)
    torch.testing.assert_close(found(whole.means), pose(whole.means), rtol=0, atol=1e-3)


def test_run_counts_and_writes_results(tmp_path, monkeypatch):
    monkeypatch.setattr(bench_register, "make_object", lambda name: asymmetric_object(0.02))
    monkeypatch.setattr(bench_register, "METHODS", {"ICP": icp})
    lines = list(run(tmp_path / "out.json", RegisterBenchOptions("duck", 1)))
    assert lines[0].split() == ["correct", "of", "1", "ICP"] and lines[1].split()[0] == "duck"
    facts = json.loads((tmp_path / "out.json").read_text())
    assert facts["machine"] == bench.machine(pick_device("auto"))
    assert [row["method"] for row in facts["trials"]] == ["ICP"]
    assert "splatreg is not installed" in lines[-1] and "pip install --no-deps splatreg" in lines[-1]
