"""Benchmarks of motion: simulated, predicted, tracked and fitted, against theory or the truth."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from ngff_cli.options import AsJson, Compiled, Device, Keypoints, Out, OutWithTable, SceneCount, Seed, print_results
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

Workers = Annotated[int, Option(help="processes")]


@app.command("physics")
def bench_physics(
    out: OutWithTable = Path("physics.json"),
    only: Annotated[
        str, Option(help="experiments by group or pattern, such as slide,'boxes/0.3m*'; default: all")
    ] = PhysicsBenchOptions.only,
    engine: Annotated[list[str], Option(help="auto | rigid | mpm | ngff; repeatable")] = PhysicsBenchOptions.engines,
    quality: Annotated[str, Option(help="quality of MPM: draft | normal | high")] = PhysicsBenchOptions.quality,
    keypoints: Keypoints = PhysicsBenchOptions.keypoints,
    weights: Annotated[
        Path | None, Option(help="weights of the learned engine; default: those in the package")
    ] = PhysicsBenchOptions.weights,
    contact: Annotated[
        str, Option(help="contacts of the engine ngff: auto | learned | solved")
    ] = PhysicsBenchOptions.contact,
    device: Device = PhysicsBenchOptions.device,
    as_json: AsJson = False,
) -> None:
    """Textbook experiments (slides, slopes, towers, rebounds, ...): each engine compared with the analytic value."""
    from stages.lab.bench.physics import run

    options = PhysicsBenchOptions(
        only=only, engines=tuple(engine), quality=quality, keypoints=keypoints, weights=weights,
        contact=contact, device=device,
    )  # fmt: skip
    print_results(lambda path: run(path, options), out, as_json)


@app.command("dynamics")
def bench_dynamics(
    data: Annotated[Path | None, Option(help="folder of motions, as `ngff-lab dataset` writes")] = None,
    weights: Annotated[
        Path | None, Option(help="folder of weights to evaluate (.safetensors); default: those in the package")
    ] = None,
    out: Annotated[
        Path, Option("-o", "--out", help="results (.json), existing ones are kept; also writes a table and plots")
    ] = Path("results.json"),
    nudged: Annotated[
        Path | None, Option(help="data set of the same scenes with initial positions shifted by 1 mm")
    ] = None,
    results: Annotated[
        Path | None, Option("--from", help="only draw the table and plots of these results (.json)")
    ] = None,
    keypoints: Keypoints = DynamicsBenchOptions.keypoints,
    limit: Annotated[int, Option(help="scenes of each split; 0: all")] = DynamicsBenchOptions.limit,
    mpm: Annotated[
        int, Option(help="scenes of each split to simulate for the row mpm-estimated; 0: omit that row")
    ] = DynamicsBenchOptions.mpm,
    device: Device = DynamicsBenchOptions.device,
    as_json: AsJson = False,
) -> None:
    """Dynamics models: errors of predicted motion on scenes not used in training."""
    from stages.core.models.checkpoints import SHIPPED
    from stages.lab.bench.dynamics import redraw, run

    if results is None and data is None:
        raise InputError("--data: name the folder of motions to measure on, or --from results to draw again")
    options = DynamicsBenchOptions(keypoints=keypoints, limit=limit, mpm=mpm, device=device)

    def lines(path: Path) -> Iterable[str]:
        return redraw(path) if results is not None else run(data, weights or SHIPPED, path, options, nudged)

    print_results(lines, results or out, as_json)


@app.command("ablation")
def bench_ablation(
    data: Annotated[Path, Option(help="folder of motions, as `ngff-lab dataset` writes")],
    out: OutWithTable = Path("ablation.json"),
    only: Annotated[str, Option(help="names of the ablations, such as full,reaction; default: all")] = "",
    steps: Annotated[int, Option(help="training steps of each ablation")] = AblationBenchOptions.steps,
    batch: Annotated[int, Option(help="scenes per training step")] = AblationBenchOptions.batch,
    keypoints: Keypoints = AblationBenchOptions.keypoints,
    horizons: Annotated[
        str, Option(help="rollout length of each training phase [frames]")
    ] = AblationBenchOptions.horizons,
    groups: Annotated[str, Option(help="groups of scenes to train on")] = AblationBenchOptions.groups,
    test: Annotated[str, Option(help="group of scenes to test on")] = AblationBenchOptions.test,
    compiled: Compiled = AblationBenchOptions.compiled,
    seed: Seed = AblationBenchOptions.seed,
    device: Device = AblationBenchOptions.device,
    as_json: AsJson = False,
) -> None:
    """Ablation: retrain the force field with one component removed at a time."""
    from stages.lab.bench.ablation import run

    options = AblationBenchOptions(
        steps=steps, batch=batch, keypoints=keypoints, horizons=horizons, groups=groups, test=test, compiled=compiled,
        seed=seed, device=device,
    )  # fmt: skip
    print_results(lambda path: run(data, path, options, only), out, as_json)


@app.command("track")
def bench_track(
    sequences: Annotated[int, Option(help="number of sequences")] = TrackBenchOptions.sequences,
    first: Annotated[int, Option(help="seed of the first sequence")] = TrackBenchOptions.first,
    width: Annotated[int, Option(help="width of the videos [px]")] = TrackBenchOptions.width,
    frames: Annotated[int, Option(help="frames of motion")] = TrackBenchOptions.frames,
    reconstructed: Annotated[
        str,
        Option(help="track scenes reconstructed from the videos at this quality and segmented; default: true scenes"),
    ] = TrackBenchOptions.quality,
    device: Device = TrackBenchOptions.device,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """Tracking: errors of pose and time, and lost frames, in rendered videos of ten cameras with known motion."""
    from stages.lab.bench.track import run

    options = TrackBenchOptions(
        sequences=sequences, first=first, width=width, frames=frames, quality=reconstructed, device=device
    )
    print_results(lambda path: run(path, options), out, as_json)


@app.command("fit")
def bench_fit(
    scenes: SceneCount = FitBenchOptions.scenes,
    only: Annotated[
        str, Option(help="some of slide,bounce,collision,soft, alternating; default: all four")
    ] = FitBenchOptions.only,
    truth: Annotated[str, Option(help="engine of the motions; default: that which fits them")] = FitBenchOptions.truth,
    noise: Annotated[float, Option(help="standard deviation of the tracks' errors [m]")] = FitBenchOptions.noise,
    evaluations: Annotated[int, Option(help="largest number of simulations of a scene")] = FitBenchOptions.evaluations,
    minutes: Annotated[float, Option(help="longest time of a scene [min]")] = FitBenchOptions.minutes,
    workers: Workers = FitBenchOptions.workers,
    out: Out = None,
    seed: Seed = FitBenchOptions.seed,
    device: Device = FitBenchOptions.device,
    as_json: AsJson = False,
) -> None:
    """Material estimation from motion: errors of the parameters and of the prediction of another motion."""
    from stages.lab.bench.fit import run

    options = FitBenchOptions(
        scenes=scenes, only=only, truth=truth, noise=noise, evaluations=evaluations, minutes=minutes, workers=workers,
        seed=seed, device=device,
    )  # fmt: skip
    print_results(lambda path: run(path, options), out, as_json)


@app.command("fit-films")
def bench_fit_films(
    scenes: SceneCount = FilmBenchOptions.scenes,
    only: Annotated[str, Option(help="slide or throw; default: both, alternating")] = FilmBenchOptions.only,
    films: Annotated[int, Option(help="films per scene")] = FilmBenchOptions.films,
    width: Annotated[int, Option(help="width of the films [px]")] = FilmBenchOptions.width,
    frames: Annotated[int, Option(help="frames of each film")] = FilmBenchOptions.frames,
    workers: Workers = FilmBenchOptions.workers,
    out: Out = None,
    seed: Seed = FilmBenchOptions.seed,
    device: Device = FilmBenchOptions.device,
    as_json: AsJson = False,
) -> None:
    """Material estimation from films: errors of the parameters, beside those from the motion as it was tracked."""
    from stages.lab.bench.fit_films import run

    options = FilmBenchOptions(
        scenes=scenes, only=only, films=films, width=width, frames=frames, workers=workers, seed=seed, device=device
    )
    print_results(lambda path: run(path, options), out, as_json)
