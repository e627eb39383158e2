"""Benchmarks of motion: simulated, predicted, tracked and fitted, against theory or the truth."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from ngff_cli.options import AsJson, Compiled, Device, Keypoints, Out, OutWithTable, SceneCount, Seed, print_results
from stages.core.errors import InputError

app = typer.Typer()

Workers = Annotated[int, Option(help="processes")]


@app.command("physics")
def bench_physics(
    out: OutWithTable = Path("physics.json"),
    only: Annotated[
        list[str], Option(help="experiments by group or pattern, such as slide or 'boxes/0.3m*'; repeatable")
    ] = [],  # noqa: B006
    engine: Annotated[list[str], Option(help="auto | rigid | mpm | ngff; repeatable; default: the last three")] = [],  # noqa: B006
    quality: Annotated[str, Option(help="quality of MPM: draft | normal | high")] = "draft",
    keypoints: Keypoints = 256,
    weights: Annotated[Path | None, Option(help="weights of the learned engine; default: those in the package")] = None,
    contact: Annotated[str, Option(help="contacts of the engine ngff: auto | learned | solved")] = "auto",
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Textbook experiments (slides, slopes, towers, rebounds, ...): each engine compared with the analytic value."""
    from stages.lab.bench.physics import PhysicsBenchOptions, run

    chosen = {"engines": tuple(engine)} if engine else {}
    options = PhysicsBenchOptions(
        only=tuple(only), quality=quality, keypoints=keypoints, weights=weights, contact=contact, device=device,
        **chosen,
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
    keypoints: Keypoints = 256,
    limit: Annotated[int, Option(help="scenes of each split; 0: all")] = 0,
    mpm: Annotated[
        int, Option(help="scenes of each split to simulate for the row mpm-estimated; 0: omit that row")
    ] = 100,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Dynamics models: errors of predicted motion on scenes not used in training."""
    from stages.core.models.checkpoints import SHIPPED
    from stages.lab.bench.dynamics import DynamicsBenchOptions, redraw, run

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
    steps: Annotated[int, Option(help="training steps of each ablation")] = 1500,
    batch: Annotated[int, Option(help="scenes per training step")] = 64,
    keypoints: Keypoints = 256,
    horizons: Annotated[str, Option(help="rollout length of each training phase [frames]")] = "8,20",
    groups: Annotated[str, Option(help="groups of scenes to train on")] = "3_0..3_8",
    test: Annotated[str, Option(help="group of scenes to test on")] = "3_9",
    compiled: Compiled = False,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Ablation: retrain the force field with one component removed at a time."""
    from stages.lab.bench.ablation import AblationBenchOptions, run

    options = AblationBenchOptions(
        steps=steps, batch=batch, keypoints=keypoints, horizons=horizons, groups=groups, test=test, compiled=compiled,
        seed=seed, device=device,
    )  # fmt: skip
    print_results(lambda path: run(data, path, options, only), out, as_json)


@app.command("track")
def bench_track(
    sequences: Annotated[int, Option(help="number of sequences")] = 5,
    first: Annotated[int, Option(help="seed of the first sequence")] = 0,
    width: Annotated[int, Option(help="width of the videos [px]")] = 240,
    frames: Annotated[int, Option(help="frames of motion")] = 50,
    reconstructed: Annotated[
        str,
        Option(help="track scenes reconstructed from the videos at this quality and segmented; default: true scenes"),
    ] = "",
    device: Device = "auto",
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """Tracking: errors of pose and time, and lost frames, in rendered videos of ten cameras with known motion."""
    from stages.lab.bench.track import TrackBenchOptions, run

    options = TrackBenchOptions(
        sequences=sequences, first=first, width=width, frames=frames, quality=reconstructed, device=device
    )
    print_results(lambda path: run(path, options), out, as_json)


@app.command("fit")
def bench_fit(
    scenes: SceneCount = 20,
    only: Annotated[str, Option(help="slide | bounce | collision | soft; default: all four, alternating")] = "",
    truth: Annotated[str, Option(help="engine of the motions; default: that which fits them")] = "",
    noise: Annotated[float, Option(help="standard deviation of the tracks' errors [m]")] = 0.002,
    evaluations: Annotated[int, Option(help="largest number of simulations of a scene")] = 1500,
    minutes: Annotated[float, Option(help="longest time of a scene [min]")] = 10.0,
    workers: Workers = 2,
    out: Out = None,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Material estimation from motion: errors of the parameters and of the prediction of another motion."""
    from stages.lab.bench.fit import FitBenchOptions, run

    options = FitBenchOptions(
        scenes=scenes, only=only, truth=truth, noise=noise, evaluations=evaluations, minutes=minutes, workers=workers,
        seed=seed, device=device,
    )  # fmt: skip
    print_results(lambda path: run(path, options), out, as_json)


@app.command("fit-films")
def bench_fit_films(
    scenes: SceneCount = 6,
    only: Annotated[str, Option(help="slide | throw; default: both, alternating")] = "",
    cameras: Annotated[int, Option(help="films per scene")] = 2,
    width: Annotated[int, Option(help="width of the films [px]")] = 320,
    frames: Annotated[int, Option(help="frames of each film")] = 25,
    workers: Workers = 2,
    out: Out = None,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Material estimation from films: errors of the parameters, beside those from the motion as it was tracked."""
    from stages.lab.bench.fit_films import FilmBenchOptions, run

    options = FilmBenchOptions(
        scenes=scenes, only=only, cameras=cameras, width=width, frames=frames, workers=workers, seed=seed, device=device
    )
    print_results(lambda path: run(path, options), out, as_json)
