"""`ngff-lab bench`: how good and how fast things are, beside a peer in the same run."""

from pathlib import Path
from typing import Annotated

import typer

from ngff_cli.options import Commands, Device, Seed
from stages.core.errors import InputError

app = typer.Typer(cls=Commands, no_args_is_help=True, rich_markup_mode=None)


@app.callback()
def _bench() -> None:
    """Measure beside a peer in the same run."""


@app.command("mpm")
def bench_mpm(
    device: Device = "auto",
    particles: Annotated[list[int], typer.Option(help="particles a scene; may be repeated")] = [6_144, 20_000, 250_000],  # noqa: B006
    scenes: Annotated[int, typer.Option(help="scenes a batch; 0: what suits the device")] = 0,
    frames: Annotated[int, typer.Option(help="frames of 200 substeps to time")] = 10,
) -> None:
    """The MPM solver: time a substep, scenes a minute, and the plain three-kernel form."""
    from stages.lab.bench.mpm import MpmBenchOptions, run

    for line in run(MpmBenchOptions(device, tuple(particles), scenes, frames)):
        print(line, flush=True)


@app.command("raster")
def bench_raster(
    out: Annotated[Path | None, typer.Option("-o", "--out", help="the numbers as JSON")] = None,
    repeat: Annotated[int, typer.Option(help="timed calls of each; the fastest counts")] = 15,
    shrink: Annotated[int, typer.Option(help="divide Gaussians and pixels by this, for a quick look")] = 1,
) -> None:
    """The CPU rasteriser: frames a second and time on one thread, beside one thread a pixel."""
    from stages.lab.bench.raster import RasterBenchOptions, run

    for line in run(out, RasterBenchOptions(repeat, shrink)):
        print(line, flush=True)


@app.command("reconstruct")
def bench_reconstruct(
    sets: Annotated[list[Path], typer.Argument(metavar="PHOTOSET...", help="folders with images/ and cameras.json")],
    out: Annotated[Path, typer.Option("-o", "--out", help="the results as JSON, added to what is there")] = Path(
        "reconstruct.json"
    ),
    quality: Annotated[str, typer.Option(help="of the reconstruction")] = "normal",
    holdout: Annotated[int, typer.Option(help="keep every N-th photo out")] = 8,
    device: Device = "auto",
    matcher: Annotated[str, typer.Option(help="of photos: sift or aliked-lightglue")] = "sift",
    cameras: Annotated[bool, typer.Option("--cameras", help="end with the cameras, to compare matchers")] = False,
) -> None:
    """Photos to Gaussians: cameras against reference cameras, photos kept out, time and memory."""
    from stages.lab.bench.reconstruct import ReconstructBenchOptions, run

    for line in run(sets, out, ReconstructBenchOptions(quality, holdout, device, matcher, cameras)):
        print(line, flush=True)


@app.command("appearance")
def bench_appearance(
    sets: Annotated[list[Path], typer.Argument(metavar="PHOTOSET...", help="folders of photos, or with images/")],
    out: Annotated[Path, typer.Option("-o", "--out", help="the results as JSON, added to what is there")] = Path(
        "appearance.json"
    ),
    quality: Annotated[str, typer.Option(help="of the reconstruction")] = "high",
    holdout: Annotated[int, typer.Option(help="keep every N-th photo out")] = 8,
    models: Annotated[
        Path | None, typer.Option(help="folder that keeps cameras and sparse points from run to run")
    ] = None,
) -> None:
    """Photos kept out, drawn by our Gaussians and by those of gsplat's default recipe after the same seconds."""
    from stages.lab.bench.appearance import AppearanceBenchOptions, run

    for line in run(sets, out, AppearanceBenchOptions(quality, holdout, models)):
        print(line, flush=True)


@app.command("pi3")
def bench_pi3(
    device: Device = "auto",
    views: Annotated[list[int], typer.Option(help="photos at a time; may be repeated")] = [1, 8, 20, 50],  # noqa: B006
    size: Annotated[int, typer.Option(help="side of the photos, a multiple of 14 [px]")] = 448,
    repeat: Annotated[int, typer.Option(help="timed passes of each")] = 3,
    splats: Annotated[bool, typer.Option("--splats", help="with the head of Gaussians")] = False,
) -> None:
    """π³ at its published size with random weights: seconds and memory, beside attention written out."""
    from stages.lab.bench.pi3 import Pi3BenchOptions, run

    for line in run(Pi3BenchOptions(device, tuple(views), size, repeat, splats)):
        print(line, flush=True)


@app.command("segment")
def bench_segment(
    scenes: Annotated[int, typer.Option(help="scenes of each kind, apart and touching")] = 4,
    photos: Annotated[int, typer.Option(help="photos whose cameras a scene has")] = 24,
    weights: Annotated[Path | None, typer.Option(help="of sam2; looked for, and left out where there are none")] = None,
    reconstruct: Annotated[bool, typer.Option("--reconstruct", help="also after reconstruction from photos")] = False,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="the numbers as JSON")] = None,
    device: Device = "auto",
) -> None:
    """Objects found by geometry, from masks that are true or partly wrong, and by sam2: overlap with the truth."""
    from stages.lab.bench.segment import SegmentBenchOptions, run

    for line in run(out, SegmentBenchOptions(scenes, photos, weights, device, reconstruct)):
        print(line, flush=True)


@app.command("refine")
def bench_refine(
    scenes: Annotated[int, typer.Option(help="scenes, of objects apart")] = 4,
    photos: Annotated[int, typer.Option(help="photos a scene")] = 24,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="the numbers as JSON")] = None,
) -> None:
    """Holes that lifted objects leave: the table there beside the true one, from new views."""
    from stages.lab.bench.refine import RefineBenchOptions, run

    for line in run(out, RefineBenchOptions(scenes, photos)):
        print(line, flush=True)


@app.command("dynamics")
def bench_dynamics(
    data: Annotated[Path | None, typer.Option(help="folder of motions, as `ngff-lab dataset` writes")] = None,
    weights: Annotated[
        Path | None, typer.Option(help="folder of weights (.safetensors), all of which are measured; by default ours")
    ] = None,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="results (.json), added to what is there; table and plots beside")
    ] = Path("results.json"),
    nudged: Annotated[
        Path | None, typer.Option(help="the same scenes with starts moved by 1 mm, as another data set")
    ] = None,
    results: Annotated[
        Path | None, typer.Option("--from", help="only table and plots, from these results (.json)")
    ] = None,
    keypoints: Annotated[int, typer.Option(help="of each object")] = 256,
    limit: Annotated[int, typer.Option(help="scenes of each split; 0: all")] = 0,
    mpm: Annotated[
        int, typer.Option(help="scenes of each split for mpm-estimated, simulated on the way; 0: without that row")
    ] = 100,
    device: Device = "auto",
) -> None:
    """The dynamics models on motion that they have not seen."""
    from stages.core.models.checkpoints import SHIPPED
    from stages.lab.bench.dynamics import DynamicsBenchOptions, redraw, run

    if results is None and data is None:
        raise InputError("--data: name the folder of motions to measure on, or --from results to draw again")
    for line in (
        redraw(results) if results is not None
        else run(data, weights or SHIPPED, out, DynamicsBenchOptions(keypoints, limit, mpm, device=device), nudged)
    ):
        print(line)


@app.command("ablation")
def bench_ablation(
    data: Annotated[Path, typer.Option(help="folder of motions, as `ngff-lab dataset` writes")],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="the results (.json), added to what is there; a table (.md) goes beside")
    ] = Path("ablation.json"),
    only: Annotated[str, typer.Option(help="some of the choices, such as full,reaction")] = "",
    steps: Annotated[int, typer.Option(help="of training, for each choice")] = 1500,
    batch: Annotated[int, typer.Option(help="scenes a step")] = 64,
    keypoints: Annotated[int, typer.Option(help="of each object")] = 256,
    horizons: Annotated[str, typer.Option(help="frames to roll out in each phase")] = "8,20",
    groups: Annotated[str, typer.Option(help="of scenes to learn from")] = "3_0..3_8",
    test: Annotated[str, typer.Option(help="group of scenes to score on")] = "3_9",
    compiled: Annotated[bool, typer.Option("--compiled", help="compile a step first; for GPUs")] = False,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Our force field trained without each of its choices in turn: what they are worth."""
    from stages.lab.bench.ablation import AblationBenchOptions, run

    options = AblationBenchOptions(steps, batch, keypoints, horizons, groups, test, compiled, seed, device)
    for line in run(data, out, options, only):
        print(line, flush=True)


@app.command("rollout")
def bench_rollout(
    out: Annotated[Path, typer.Option("-o", "--out", help="the results as JSON")] = Path("rollout.json"),
    weights: Annotated[Path | None, typer.Option(help="of our force field (.safetensors); those that ship")] = None,
    keypoints: Annotated[int, typer.Option(help="of each of three objects")] = 2048,
    steps: Annotated[int, typer.Option(help="of 0.02 s")] = 100,
    scenes: Annotated[list[int], typer.Option(help="at once; may be repeated; none: 1, and 64 on a GPU")] = [],  # noqa: B006
    repeat: Annotated[int, typer.Option(help="timed rollouts, of which the median counts")] = 5,
    device: Device = "auto",
) -> None:
    """The learned force field: time a rollout, and the published model and MPM beside it."""
    from stages.lab.bench.rollout import RolloutBenchOptions, run

    for line in run(out, RolloutBenchOptions(weights, keypoints, steps, tuple(scenes), repeat, device)):
        print(line, flush=True)


@app.command("register")
def bench_register(
    only: Annotated[str, typer.Option(help="some of the ten objects, such as ball,duck")] = "",
    trials: Annotated[int, typer.Option(help="parts of each object")] = 10,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="all trials as JSON")] = None,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Registration of a part to the whole, beside plain ICP and splatreg."""
    from stages.lab.bench.register import RegisterBenchOptions, run

    for line in run(out, RegisterBenchOptions(only, trials, seed=seed, device=device)):
        print(line, flush=True)


@app.command("complete")
def bench_complete(
    scene: Annotated[
        list[str], typer.Option(help="objects of a scene, with commas between; may be repeated")
    ] = ["panda,duck", "can,miku", "bowl,phone"],  # noqa: B006
    known: Annotated[str, typer.Option(help="objects of the library; by default all ten")] = "",
    out: Annotated[Path | None, typer.Option("-o", "--out", help="the figures as JSON")] = None,
    seed: Seed = 0,
) -> None:
    """What completing objects does to their surfaces, to pictures from behind, and to how they fall."""
    from stages.lab.bench.complete import CompleteBenchOptions, run

    for line in run(out, CompleteBenchOptions(tuple(scene), known, seed=seed)):
        print(line, flush=True)
