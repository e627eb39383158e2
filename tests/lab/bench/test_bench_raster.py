"""The rasteriser benchmark and its baseline. Speed is not tested."""

import json

import pytest
import torch

from stages.core.errors import InputError
from stages.core.raster.rasterise import rasterise
from stages.lab.bench.raster import random_gaussians, render_per_pixel, run, view_camera
from stages.lab.bench.speed_options import RasterBenchOptions


def test_baseline_equals_the_rasteriser():
    """They have only projection and sorting in common; their adjoints are independent."""
    g, (viewmat, K) = random_gaussians(3000), view_camera(90)
    tensors = [t.requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)]
    drawn = rasterise(g, viewmat[None], K[None], 90, 90)
    plain = render_per_pixel(g, viewmat, K, 90)
    torch.testing.assert_close(plain[..., :3], drawn.rgb[0], rtol=0, atol=1e-5)
    torch.testing.assert_close(plain[..., 3], (drawn.depth * drawn.alpha)[0], rtol=0, atol=3e-5)
    weight = torch.randn(90, 90, 3, generator=torch.Generator().manual_seed(0))
    ours, theirs = (torch.autograd.grad((rgb * weight).sum(), tensors) for rgb in (drawn.rgb[0], plain[..., :3]))
    for a, b in zip(ours, theirs, strict=True):
        assert float((a - b).norm() / b.norm()) < 1e-4


@pytest.mark.parametrize("n", [2000, 16000])
def test_random_gaussians_fill_the_image(n):
    g, (viewmat, K) = random_gaussians(n), view_camera(64)
    drawn = rasterise(g, viewmat[None], K[None], 64, 64)
    assert float(drawn.visible.float().mean()) > 0.95
    assert float(drawn.alpha[0, 16:48, 16:48].mean()) > 0.9 and 0.5 < float(drawn.alpha.mean()) < 0.95


def test_report_has_every_row_and_the_machine(tmp_path):
    lines = list(run(tmp_path / "raster.json", RasterBenchOptions(repeat=1, shrink=20)))
    assert "cores" in lines[0] and len(lines) == 8
    assert [line.split(":")[0].split()[0] for line in lines[1:]] == ["forward"] * 4 + ["forward,"] * 2 + ["SSIM,"]
    kept = json.loads((tmp_path / "raster.json").read_text())
    assert [row["gaussians"] for row in kept["rows"]] == [5000, 5000, 15000, 15000, 2500, 5000, 0]
    for row, line in zip(kept["rows"], lines[1:], strict=True):
        assert row["cpu"] > 0 and row["plain_cpu"] > 0
        assert line.endswith(f"{row['plain_cpu'] / row['cpu']:.1f}x")


def test_invalid_options_are_rejected():
    with pytest.raises(InputError, match="--repeat"):
        RasterBenchOptions(repeat=0)


@pytest.mark.gpu
def test_gpu_report_compares_with_gsplat(tmp_path):
    pytest.importorskip("gsplat")
    from stages.lab.bench import raster_cuda

    lines = list(raster_cuda.run("cuda", tmp_path / "raster.json", RasterBenchOptions(repeat=2, shrink=10)))
    assert len(lines) == 2 + 8 + 1
    for row in json.loads((tmp_path / "raster.json").read_text())["rows"]:
        assert 0 < row["kernels"] < 100 and 0 < row["gsplat_kernels"] < 100
