"""Benchmarks of simulated, predicted, tracked and fitted motion, compared with theory or the truth."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from ngff_cli.options import AsJson, OutWithTable, add_benchmark, print_results, with_options
from stages.core.errors import InputError
from stages.lab.bench.motion_options import (
    AblationBenchOptions,
    DynamicsBenchOptions,
    FilmBenchOptions,
    FitBenchOptions,
    PhysicsBenchOptions,
    TrackBenchOptions,
)

app = typer.Typer()


add_benchmark(
    app,
    "physics",
    "stages.lab.bench.physics:run",
    PhysicsBenchOptions,
    "Textbook experiments (slides, slopes, towers, rebounds, ...): each engine compared with analytic values.",
    OutWithTable,
    Path("physics.json"),
)


@app.command("dynamics")
@with_options
def bench_dynamics(
    *,
    data: Annotated[Path | None, Option(help="folder of motions, written by `ngff-lab dataset`")] = None,
    weights: Annotated[
        Path | None, Option(help="folder of weights to evaluate (.safetensors); default: the weights in the package")
    ] = None,
    out: Annotated[
        Path, Option("-o", "--out", help="results (.json); existing results are kept; also writes a table and plots")
    ] = Path("results.json"),
    nudged: Annotated[
        Path | None,
        Option(
            help="data set of the same scenes with initial positions shifted by 1 mm, to measure their predictability"
        ),
    ] = None,
    results: Annotated[
        Path | None, Option("--from", help="only redraw the table and plots of existing results (.json)")
    ] = None,
    options: DynamicsBenchOptions,
    as_json: AsJson = False,
) -> None:
    """Dynamics models: errors of predicted motion on scenes not used in training."""
    from stages.core.models.checkpoints import SHIPPED
    from stages.lab.bench.dynamics import redraw, run

    if results is None and data is None:
        raise InputError(
            "--data is missing: name the folder of motions to measure on, or redraw existing results with --from"
        )

    def lines(path: Path) -> Iterable[str]:
        return redraw(path) if results is not None else run(data, weights or SHIPPED, path, options, nudged)

    print_results(lines, results or out, as_json)


@app.command("ablation")
@with_options
def bench_ablation(
    *,
    data: Annotated[Path, Option(help="folder of motions, written by `ngff-lab dataset`")],
    out: OutWithTable = Path("ablation.json"),
    only: Annotated[str, Option(help="names of the ablations to run, such as full,reaction; default: all")] = "",
    options: AblationBenchOptions,
    as_json: AsJson = False,
) -> None:
    """Ablation: retrain the force field with one component removed at a time."""
    from stages.lab.bench.ablation import run

    print_results(lambda path: run(data, path, options, only), out, as_json)


add_benchmark(
    app,
    "track",
    "stages.lab.bench.track:run",
    TrackBenchOptions,
    "Tracking: errors of pose and time, and lost frames, in videos of known motion rendered for ten cameras.",
)


add_benchmark(
    app,
    "fit",
    "stages.lab.bench.fit:run",
    FitBenchOptions,
    "Material estimation from motion: errors of the parameters and of the prediction of another motion.",
)


add_benchmark(
    app,
    "fit-films",
    "stages.lab.bench.fit_films:run",
    FilmBenchOptions,
    "Material estimation from films: errors of the parameters, compared with estimation from tracked motion.",
)
