"""Benchmarks of time and memory: kernels, networks, and all stages from photos to a video."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ngff_cli.options import AsJson, Device, Out, Quality, print_results
from stages.core.errors import InputError
from stages.lab.bench.speed_options import (
    ChainBenchOptions,
    ChainTableOptions,
    MpmBenchOptions,
    Pi3BenchOptions,
    RasterBenchOptions,
    RolloutBenchOptions,
)

app = typer.Typer()


@app.command("mpm")
def bench_mpm(
    device: Device = MpmBenchOptions.device,
    particles: Annotated[list[int], Option(help="particles per scene; repeatable")] = MpmBenchOptions.particles,
    scenes: Annotated[int, Option(help="scenes per batch; 0: chosen for the device")] = MpmBenchOptions.scenes,
    frames: Annotated[int, Option(help="frames of 200 substeps to time")] = MpmBenchOptions.frames,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """MPM solver: time per substep and scenes per minute, compared with the unfused three-kernel solver."""
    from stages.lab.bench.mpm import run

    options = MpmBenchOptions(device=device, particles=tuple(particles), scenes=scenes, frames=frames)
    print_results(lambda path: run(options, path), out, as_json)


@app.command("raster")
def bench_raster(
    device: Annotated[str, Option(help="cpu, or cuda to compare with gsplat on a GPU")] = "cpu",
    out: Out = None,
    repeat: Annotated[int, Option(help="timed calls of each; the fastest counts")] = RasterBenchOptions.repeat,
    shrink: Annotated[
        int, Option(help="factor by which the numbers of Gaussians and pixels are reduced")
    ] = RasterBenchOptions.shrink,
    as_json: AsJson = False,
) -> None:
    """Rasteriser: on the CPU compared with a per-pixel rasteriser, on a GPU (--device cuda) with gsplat."""
    from stages.core.backends import pick_device
    from stages.lab.bench import raster

    options = RasterBenchOptions(repeat=repeat, shrink=shrink)
    if (at := pick_device(device)) == "cpu":
        print_results(lambda path: raster.run(path, options), out, as_json)
        return
    from stages.lab.bench import raster_cuda

    print_results(lambda path: raster_cuda.run(at, path, options), out, as_json)


@app.command("pi3")
def bench_pi3(
    device: Device = Pi3BenchOptions.device,
    views: Annotated[list[int], Option(help="photos per pass; repeatable")] = Pi3BenchOptions.views,
    size: Annotated[int, Option(help="side of the photos, a multiple of 14 [px]")] = Pi3BenchOptions.size,
    repeat: Annotated[int, Option(help="timed passes of each")] = Pi3BenchOptions.repeat,
    splats: Annotated[bool, Option("--splats", help="include the Gaussian head")] = Pi3BenchOptions.splats,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """π³ at its published size with random weights: time and memory, compared with unfused attention."""
    from stages.lab.bench.pi3 import run

    options = Pi3BenchOptions(device=device, views=tuple(views), size=size, repeat=repeat, splats=splats)
    print_results(lambda path: run(options, out=path), out, as_json)


@app.command("rollout")
def bench_rollout(
    out: Annotated[Path, Option("-o", "--out", help="JSON file to write the results to")] = Path("rollout.json"),
    weights: Annotated[
        Path | None, Option(help="weights of the force field (.safetensors); default: those in the package")
    ] = RolloutBenchOptions.weights,
    objects: Annotated[int, Option(help="objects of a scene, in piles of three")] = RolloutBenchOptions.objects,
    keypoints: Annotated[int, Option(help="keypoints of each object")] = RolloutBenchOptions.keypoints,
    steps: Annotated[int, Option(help="number of 0.02 s steps")] = RolloutBenchOptions.steps,
    scenes: Annotated[
        list[int], Option(help="scenes per batch; repeatable; default: 1, and 64 on a GPU")
    ] = RolloutBenchOptions.scenes,
    repeat: Annotated[int, Option(help="timed rollouts, of which the median counts")] = RolloutBenchOptions.repeat,
    device: Device = RolloutBenchOptions.device,
    as_json: AsJson = False,
) -> None:
    """Learned force field: time of a rollout, compared with the published model and MPM."""
    from stages.lab.bench.rollout import run

    options = RolloutBenchOptions(weights, objects, keypoints, steps, tuple(scenes), repeat, device)
    print_results(lambda path: run(path, options), out, as_json)


@app.command("chain")
def bench_chain(
    photos: Annotated[
        Path | None, Argument(metavar="PHOTOS", help="folder of photos or a video; not with --table")
    ] = None,
    table: Annotated[
        bool,
        Option("--table", help="instead of PHOTOS: the paper's table, from rendered photos of 3 and of 6 toys"),
    ] = False,
    quality: Quality = ChainBenchOptions.quality,
    device: Device = ChainBenchOptions.device,
    steps: Annotated[int, Option(help="frames of the video")] = ChainBenchOptions.steps,
    refine: Annotated[bool, Option(help="complete the objects before they are simulated")] = ChainBenchOptions.refine,
    repeat: Annotated[int, Option(help="runs in one process; the first one loads kernels")] = ChainBenchOptions.repeat,
    commands: Annotated[bool, Option(help="also run each stage as a command")] = ChainBenchOptions.commands,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """All stages from photos to a video: time, GPU utilisation, and whether repeated runs give equal files."""
    from stages.lab.bench.chain import run
    from stages.lab.bench.chain_table import run as run_table

    if table != (photos is None):
        raise InputError("give PHOTOS or --table")
    if table:
        rows = ChainTableOptions(quality=quality, device=device, steps=steps, repeat=repeat)
        print_results(lambda path: run_table(path, rows), out, as_json)
        return
    options = ChainBenchOptions(
        quality=quality, device=device, steps=steps, refine=refine, repeat=repeat, commands=commands
    )
    print_results(lambda path: run(photos, path, options), out, as_json)
