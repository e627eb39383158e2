"""Benchmark of the CPU rasteriser, compared with per-pixel compositing in the same run.

Random Gaussians in a unit cube fill the image. A frame is projection, colour, sorting, binning and compositing. Wall
time is measured with all of torch's threads, CPU time with one thread; CPU time depends little on other load and is
the number to compare.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from stages.core.geometry.cameras import intrinsics, look_at
from stages.core.kernels.splat.projection import pack_camera, project
from stages.core.kernels.splat.ssim import ssim, ssim_reference
from stages.core.raster.rasterise import rasterise
from stages.core.scene.gaussians import Gaussians
from stages.lab.bench import common as bench
from stages.lab.bench.raster_per_pixel import bin_into_tiles, composite_per_pixel
from stages.lab.bench.speed_options import RasterBenchOptions

FORWARD = ((100_000, 448), (100_000, 800), (300_000, 448), (300_000, 800))  # Gaussians, image side [px]
FORWARD_BACKWARD = ((50_000, 448), (100_000, 448))  # Gaussians, image side [px]
SSIM_SIZE = 448  # side of the images of the SSIM benchmark [px]


@dataclass(frozen=True)
class RasterCase:
    """The timed operation and its problem size."""

    what: str
    gaussians: int
    pixels: int  # side of the image

    def __str__(self) -> str:
        return f"{self.what:<18}" + (f"{self.gaussians:>8,}" if self.gaussians else " " * 8) + f" {self.pixels:4d} px"


@dataclass(frozen=True)
class RasterTiming(RasterCase):
    """Times of our implementation and the baseline [ms]: wall time on `threads` threads and CPU time on one."""

    threads: int
    wall: float
    cpu: float
    plain_wall: float  # per-pixel baseline
    plain_cpu: float

    def __str__(self) -> str:
        return (
            f"{super().__str__()}: {self.wall:7.1f} ms on {self.threads} threads, {1e3 / self.wall:6.1f} a"
            f" second; one thread {self.cpu:7.1f} ms; plain {self.plain_wall:7.1f} and {self.plain_cpu:7.1f} ms:"
            f" {self.plain_cpu / self.cpu:4.1f}x"
        )


def random_gaussians(n: int, seed: int = 0) -> Gaussians:
    """n random Gaussians that fill the unit cube around the origin, with SH degree 0."""
    rng = torch.Generator().manual_seed(seed)
    quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=rng), dim=1)
    scales = 0.3 * n ** (-1 / 3) * torch.exp(0.5 * torch.randn(n, 3, generator=rng))
    return Gaussians(
        torch.rand(n, 3, generator=rng) - 0.5, quats, scales, 0.1 + 0.85 * torch.rand(n, generator=rng),
        0.6 * torch.randn(n, 1, 3, generator=rng), torch.zeros(n, dtype=torch.int64),
    )  # fmt: skip


def view_camera(pixels: int) -> tuple[Tensor, Tensor]:
    """Extrinsics (world to camera) and intrinsics of a square image filled by the cube."""
    return look_at(torch.tensor([1.6, 0.9, 0.8]), torch.zeros(3)), intrinsics(pixels, pixels, 1.4 * pixels)


def render_per_pixel(g: Gaussians, viewmat: Tensor, K: Tensor, pixels: int) -> Tensor:
    """Colour and depth (pixels, pixels, 4) over black, by the per-pixel baseline."""
    tensors = (g.means, g.quats, g.scales, g.opacities, g.sh)
    splats, keys, _ = project(pack_camera(viewmat, K, pixels, pixels, 0.01), *tensors)
    return composite_per_pixel(splats, bin_into_tiles(splats, keys, pixels, pixels))


def wall_and_cpu_ms(call: Callable[[], object], repeat: int) -> tuple[float, float]:
    """Wall time on all of torch's threads and CPU time on one thread [ms], each the minimum of `repeat` calls."""
    call()
    wall = _fastest(call, time.perf_counter, repeat)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return wall, _fastest(call, time.thread_time, repeat)
    finally:
        torch.set_num_threads(threads)


def _fastest(call: Callable[[], object], clock: Callable[[], float], repeat: int) -> float:
    times = []
    for _ in range(repeat):
        start = clock()
        call()
        times.append(1e3 * (clock() - start))
    return min(times)


def measure_forward(n: int, pixels: int, repeat: int) -> RasterTiming:
    """Time a forward pass over n Gaussians in an image of `pixels` x `pixels`, by our code and the baseline [ms]."""
    g, (viewmat, K) = random_gaussians(n), view_camera(pixels)
    ours = lambda: rasterise(g, viewmat[None], K[None], pixels, pixels)  # noqa: E731
    plain = lambda: render_per_pixel(g, viewmat, K, pixels)  # noqa: E731
    return _row("forward", n, pixels, ours, plain, repeat)


def measure_forward_backward(n: int, pixels: int, repeat: int) -> RasterTiming:
    """Time a forward and a backward pass, with gradients of all Gaussian parameters."""
    g, (viewmat, K) = random_gaussians(n), view_camera(pixels)
    tensors = [t.requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)]
    ours = lambda: rasterise(g, viewmat[None], K[None], pixels, pixels).rgb.sum()  # noqa: E731
    plain = lambda: render_per_pixel(g, viewmat, K, pixels)[..., :3].sum()  # noqa: E731
    pulled = [lambda loss=loss: torch.autograd.grad(loss(), tensors) for loss in (ours, plain)]
    return _row("forward, backward", n, pixels, *pulled, repeat)


def measure_ssim(pixels: int, repeat: int) -> RasterTiming:
    """Time SSIM of two images and its gradient, compared with plain PyTorch."""
    rng = torch.Generator().manual_seed(0)
    first, second = (torch.rand(pixels, pixels, 3, generator=rng) for _ in range(2))
    first.requires_grad_()
    pulled = [lambda f=f: torch.autograd.grad(f(first, second), first) for f in (ssim, ssim_reference)]
    return _row("SSIM, backward", 0, pixels, *pulled, repeat)


def _row(what: str, n: int, pixels: int, ours: Callable, plain: Callable, repeat: int) -> RasterTiming:
    threads = torch.get_num_threads()
    return RasterTiming(
        what, n, pixels, threads, *wall_and_cpu_ms(ours, repeat), *wall_and_cpu_ms(plain, max(1, repeat // 3))
    )


def run(out: Path | None, options: RasterBenchOptions) -> Iterator[str]:
    """Yield the lines of the report; all results go to `out` as JSON."""
    yield bench.machine("cpu")
    by = options.shrink
    suites = (measure_forward, FORWARD), (measure_forward_backward, FORWARD_BACKWARD)
    sizes = [(measure, n // by, math.ceil(p / by)) for measure, rows in suites for n, p in rows]
    rows = []
    for measure, n, pixels in sizes:
        rows.append(measure(n, pixels, options.repeat))
        yield str(rows[-1])
    rows.append(measure_ssim(math.ceil(SSIM_SIZE / by), options.repeat))
    yield str(rows[-1])
    times = f"ms, the fastest of {options.repeat} calls ({max(1, options.repeat // 3)} of the baseline)"
    facts = {"load": os.getloadavg()[0], "times": times, "rows": [asdict(row) for row in rows]}
    bench.write_results(out, "raster", "cpu", facts)
