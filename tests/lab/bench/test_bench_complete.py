"""The completion benchmark: visible parts, and metrics of the missing parts."""

import json

import pytest
import torch

from stages.core.scene.scene import Scene
from stages.lab.assets.shapes import ellipsoid
from stages.lab.bench import complete as bench_complete
from stages.lab.bench.complete import (
    COMPLETERS,
    FRONT_AZIMUTH,
    METRICS,
    camera_arc,
    chamfer_mm,
    psnr_behind,
    run,
    true_scene,
    visible,
    visible_scene,
)
from stages.lab.bench.scene_options import CompleteBenchOptions
from tests.refine.sample_objects import asymmetric_object
from tests.segment.tabletop import coloured_gaussians


@pytest.fixture(scope="module")
def true():
    patch = pytest.MonkeyPatch()
    patch.setattr(bench_complete, "make_object", lambda name: asymmetric_object(0.02))
    yield true_scene("panda,duck", CompleteBenchOptions())
    patch.undo()


def test_objects_stand_on_the_table_side_by_side(true):
    g = true.gaussians
    lows = [float(g.means[g.object_id == i, 2].min()) for i in (1, 2)]
    assert lows == pytest.approx([0.0, 0.0], abs=1e-4)
    middles = torch.stack([g.means[g.object_id == i].mean(0) for i in (1, 2)])
    assert float((middles[1] - middles[0]).norm()) > 0.25


def test_missing_back_lowers_psnr_from_behind(true):
    seen = visible_scene(true, CompleteBenchOptions())
    counts = [int((s.gaussians.object_id > 0).sum()) for s in (seen, true)]
    assert 0.3 * counts[1] < counts[0] < 0.8 * counts[1]
    assert chamfer_mm(true, true) == 0 and chamfer_mm(seen, true) > 1
    assert psnr_behind(seen, true) < 25
    exact = visible_scene(true, CompleteBenchOptions(noise=0.0))
    kept = exact.gaussians.means[exact.gaussians.object_id > 0]
    # the tolerance is for rounding in cdist
    assert float(torch.cdist(kept[:50], true.gaussians.means).amin(1).max()) < 1e-3


def test_visible_fraction_does_not_depend_on_density():
    """The cameras see the same fraction of a ball of 4,000 and of 30,000 Gaussians."""
    shares = []
    for count in (4000, 30_000):
        ball = coloured_gaussians(ellipsoid((0.1, 0.1, 0.1), count).moved((0, 0, 0.12)), (0.8, 0.3, 0.2), 1)
        shares.append(float(visible(Scene(ball, (), camera_arc(10, FRONT_AZIMUTH, 28.0), 0.0)).float().mean()))
    assert shares[0] == pytest.approx(shares[1], abs=0.05) and 0.5 < shares[0] < 0.9


def test_results_have_each_scene_and_the_mean(tmp_path, monkeypatch):
    """In one scene, every metric has twice the value of the other."""

    def measured(placed, folder, options):
        assert (folder / "library/duck.ply").exists()
        factor = 1 + (placed == "can,miku")
        for i, way in enumerate(COMPLETERS, 1):
            yield way, {figure: factor * i * 10**j for j, figure in enumerate(METRICS)}

    monkeypatch.setattr(bench_complete, "measure", measured)
    monkeypatch.setattr(bench_complete, "make_object", lambda name: asymmetric_object(0.02))
    lines = list(run(tmp_path / "out.json", CompleteBenchOptions(("panda,duck", "can,miku"), "duck")))
    assert [line.split()[:2] for line in lines[-3:]] == [["mean", way] for way in COMPLETERS] and len(
        lines
    ) == 1 + 3 * 3
    facts = json.loads((tmp_path / "out.json").read_text())
    assert facts["mean"]["close"] == {"chamfer_mm": 3.0, "psnr_behind_db": 30.0, "motion_rmse_mm": 300.0}
    assert facts["scenes"]["can,miku"]["library"]["chamfer_mm"] == 6
