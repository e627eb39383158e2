"""The bench of completion sees less than everything, and measures it."""

import pytest
import torch

from stages.lab import bench_complete
from stages.lab.bench_complete import BenchOptions, distance, photographed, psnr_behind, truth
from tests.refine.things import thing


@pytest.fixture(scope="module")
def true():
    patch = pytest.MonkeyPatch()
    patch.setattr(bench_complete, "make_object", lambda name: thing(0.02))
    yield truth(BenchOptions())
    patch.undo()


def test_the_objects_stand_on_the_table_beside_each_other(true):
    g = true.gaussians
    lows = [float(g.means[g.object_id == i, 2].min()) for i in (1, 2)]
    assert lows == pytest.approx([0.0, 0.0], abs=1e-4)
    middles = torch.stack([g.means[g.object_id == i].mean(0) for i in (1, 2)])
    assert float((middles[1] - middles[0]).norm()) > 0.25


def test_the_cameras_miss_the_back_and_pictures_from_there_show_it(true):
    seen = photographed(true, BenchOptions())
    counts = [int((s.gaussians.object_id > 0).sum()) for s in (seen, true)]
    assert 0.3 * counts[1] < counts[0] < 0.8 * counts[1]
    assert distance(true, true) == 0 and distance(seen, true) > 1
    assert psnr_behind(seen, true) < 25
    exact = photographed(true, BenchOptions(noise=0.0))
    kept = exact.gaussians.means[exact.gaussians.object_id > 0]
    assert float(torch.cdist(kept[:50], true.gaussians.means).amin(1).max()) < 1e-3  # cdist rounds
