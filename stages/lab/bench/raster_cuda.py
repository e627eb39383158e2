"""Benchmark of the GPU rasteriser, compared with gsplat in the same run.

The scenes are those of the CPU benchmark. Times are sums over kernels, since single calls are launch-bound; wall times
are given as well. Compositing tests every pixel of a tile against every splat in the tile's list, unless the splat's
box misses the pixels of the warp or the pixel is finished. The arithmetic of all these tests, 10 operations each, is
given as a fraction of the rate of a float32 matrix product in the same run. A step of the photometric fit is compared
with the copy bandwidth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch.profiler import ProfilerActivity, profile

from stages.core.kernels.splat.projection import TILE_SIZE, pack_camera
from stages.core.raster.rasterise import NEAR, count_pairs, rasterise_packed
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.lab.bench import common as bench
from stages.lab.bench.raster import FORWARD, RasterCase, random_gaussians, view_camera
from stages.lab.bench.speed_options import RasterBenchOptions
from stages.reconstruct.photometric import FitOptions, fit_gaussians
from stages.reconstruct.photos import Views

OPERATIONS_PER_TEST = 10  # operations of the quadratic form and the comparison
FIT_PIXELS = 640  # side of the image of the photometric fit
FIT_STEPS = 50, 190  # lengths of two fits whose difference gives the time of a step; longer fits split Gaussians


@dataclass(frozen=True)
class CudaRasterTiming(RasterCase):
    """Times of a call by our code and gsplat [ms]: sum over kernels, and wall time."""

    kernels: float
    wall: float
    gsplat_kernels: float
    gsplat_wall: float
    arithmetic: float | None  # fraction of the float32 rate that the tests of a forward pass reach

    def __str__(self) -> str:
        share = "" if self.arithmetic is None else f"; tests {100 * self.arithmetic:.0f} % of the float32 rate"
        return (
            f"{super().__str__()}: kernels {self.kernels:6.3f} ms, wall"
            f" {self.wall:6.3f} ms; gsplat {self.gsplat_kernels:6.3f} and {self.gsplat_wall:6.3f} ms:"
            f" {self.gsplat_kernels / self.kernels:4.2f}x{share}"
        )


def run(device: str, out: Path | None, options: RasterBenchOptions) -> Iterator[str]:
    """Yield the lines of the report; all results go to `out` as JSON. Raises MissingPackage without gsplat."""
    gsplat = bench.import_gsplat()
    yield bench.machine(device)
    rate, rows = bench.float32_rate(device), []
    yield f"float32 matrix product {rate / 1e12:.0f} TFLOP/s"
    for n, pixels in FORWARD:
        g = random_gaussians(n // options.shrink).to(device)
        pixels = -(-pixels // options.shrink)
        viewmat, K = view_camera(pixels)
        camera = pack_camera(viewmat, K, pixels, pixels, NEAR).to(device)
        tensors = [t.requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)]
        viewmats, Ks = viewmat[None].to(device), K[None].to(device)

        def ours(g=g, camera=camera, pixels=pixels) -> torch.Tensor:
            rgb, _, depth, *_ = rasterise_packed(g, camera, pixels, pixels)
            return rgb.sum() + depth.sum()

        def theirs(tensors=tensors, viewmats=viewmats, Ks=Ks, pixels=pixels) -> torch.Tensor:
            return gsplat.rasterization(*tensors, viewmats, Ks, pixels, pixels, sh_degree=0, packed=False,
                                        render_mode="RGB+ED")[0].sum()  # fmt: skip

        with torch.no_grad():
            forward = _times(ours, options.repeat, device), _times(theirs, options.repeat, device)
            tests = count_pairs(g, camera, pixels, pixels) * TILE_SIZE**2
        rows.append(_row("forward", g, pixels, *forward, OPERATIONS_PER_TEST * tests / rate))
        yield str(rows[-1])
        pulled = [lambda f=f, t=tensors: torch.autograd.grad(f(), t) for f in (ours, theirs)]
        both = [_times(call, options.repeat, device) for call in pulled]
        rows.append(_row("forward, backward", g, pixels, *both, None))
        yield str(rows[-1])
    fit = _fit_step(device, options.shrink)
    yield fit["text"]
    facts = {"float32_rate": rate, "rows": [asdict(row) for row in rows], "fit": fit}
    bench.write_results(out, "raster", device, facts)


def _fit_step(device: str, shrink: int) -> dict:
    """Time of a step of the photometric fit, and its minimum memory traffic as a fraction of the copy bandwidth.

    The minimum is to read and write once every parameter, its gradient and its two moments.
    """
    n, pixels = FORWARD[0][0] // shrink, -(-FIT_PIXELS // shrink)
    g, (viewmat, K) = random_gaussians(n), view_camera(pixels)
    with torch.no_grad():
        camera = pack_camera(viewmat, K, pixels, pixels, NEAR).to(device)
        image = (rasterise_packed(g.to(device), camera, pixels, pixels)[0].clamp(0, 1) * 255).to(torch.uint8).cpu()
    cameras = Cameras(viewmat[None], K[None], torch.tensor([[pixels, pixels]]), ("0",))
    views, g = Views((image,), cameras), replace(g, sh=g.sh + 0.1)

    def seconds(steps: int) -> float:
        call = lambda: fit_gaussians(g, views, FitOptions(steps, 2.0, device=device))  # noqa: E731
        call()
        return bench.median_seconds(call, device, 3)

    some, more = FIT_STEPS
    step, floats = (seconds(more) - seconds(some)) / (more - some), 11 + 3 * g.sh.shape[1]
    copy = bench.copy_bandwidth(device)
    share = 4 * 8 * floats * n / step / copy
    text = f"fit step {n:,} Gaussians {pixels} px: {1e3 * step:.3f} ms; parameters at {100 * share:.0f} % of the " \
           f"copy bandwidth, {copy / 1e12:.2f} TB/s"  # fmt: skip
    return {"gaussians": n, "pixels": pixels, "seconds": step, "share": share, "copy_bandwidth": copy, "text": text}


def _row(
    what: str, g: Gaussians, pixels: int, ours: tuple[float, float], theirs: tuple[float, float], floor: float | None
) -> CudaRasterTiming:
    share = None if floor is None else 1e3 * floor / ours[0]
    return CudaRasterTiming(what, len(g), pixels, *ours, *theirs, share)


def _times(call: Callable[[], object], repeat: int, device: str) -> tuple[float, float]:
    """Time of a call summed over kernels, and wall time [ms]."""
    call()
    wall = 1e3 * bench.median_seconds(call, device, repeat)
    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        for _ in range(repeat):
            call()
        torch.cuda.synchronize(device)
    kernels = sum(event.self_device_time_total for event in profiler.key_averages())
    return kernels / repeat / 1e3, wall
