"""Benchmarks of time and memory: kernels, networks, and all stages from photos to a video."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ngff_cli.options import AsJson, Out, add_benchmark, print_results, with_options
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


add_benchmark(
    app,
    "mpm",
    "stages.lab.bench.mpm:run",
    MpmBenchOptions,
    "MPM solver: time per substep and scenes per minute, compared with the unfused three-kernel solver.",
)


@app.command("raster")
@with_options
def bench_raster(
    *,
    device: Annotated[str, Option(help="cpu, or cuda to compare with gsplat on a GPU")] = "cpu",
    out: Out = None,
    options: RasterBenchOptions,
    as_json: AsJson = False,
) -> None:
    """Rasteriser: compared with a per-pixel rasteriser on the CPU, and with gsplat on a GPU (--device cuda)."""
    from stages.core.backends import pick_device
    from stages.lab.bench import raster

    if (at := pick_device(device)) == "cpu":
        print_results(lambda path: raster.run(path, options), out, as_json)
        return
    from stages.lab.bench import raster_cuda

    print_results(lambda path: raster_cuda.run(at, path, options), out, as_json)


add_benchmark(
    app,
    "pi3",
    "stages.lab.bench.pi3:run",
    Pi3BenchOptions,
    "π³ network at its published size, with random weights: time and memory, compared with unfused attention.",
)


add_benchmark(
    app,
    "rollout",
    "stages.lab.bench.rollout:run",
    RolloutBenchOptions,
    "Learned force field: time of a rollout, compared with the published model and MPM.",
    default=Path("rollout.json"),
)


@app.command("chain")
@with_options
def bench_chain(
    *,
    photos: Annotated[
        Path | None, Argument(metavar="PHOTOS", help="folder of photos, or a video; not allowed with --table")
    ] = None,
    table: Annotated[
        bool,
        Option("--table", help="measure the paper's table, from rendered photos of 3 and of 6 toys, instead of PHOTOS"),
    ] = False,
    rows: ChainTableOptions,
    options: ChainBenchOptions,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """All stages from photos to a video: time, GPU utilisation, and whether repeated runs give identical files."""
    from stages.lab.bench.chain import run
    from stages.lab.bench.chain_table import run as run_table

    if table != (photos is None):
        raise InputError("give PHOTOS or --table, one of the two")
    if table:
        print_results(lambda path: run_table(path, rows), out, as_json)
        return
    print_results(lambda path: run(photos, path, options), out, as_json)
