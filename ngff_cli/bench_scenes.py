"""Benchmarks of scenes: cameras, views, objects and what was filled in, against the truth."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ngff_cli.options import AsJson, Device, Out, OutKept, OutWithTable, Quality, Seed, print_results
from stages.core.errors import InputError
from stages.lab.bench.scene_options import (
    AppearanceBenchOptions,
    CompleteBenchOptions,
    ReconstructBenchOptions,
    RefineBenchOptions,
    RegisterBenchOptions,
    SegmentAblationData,
    SegmentAblationOptions,
    SegmentBenchOptions,
    SegmentPhotosOptions,
)

app = typer.Typer()

Holdout = Annotated[int, Option(help="hold out every N-th photo")]
Views = Annotated[int, Option(help="number of cameras per scene")]


@app.command("reconstruct")
def bench_reconstruct(
    sets: Annotated[list[Path], Argument(metavar="PHOTOSET...", help="folders with images/ and cameras.json")],
    out: OutKept = Path("reconstruct.json"),
    quality: Quality = ReconstructBenchOptions.quality,
    holdout: Holdout = ReconstructBenchOptions.holdout,
    device: Device = ReconstructBenchOptions.device,
    matcher: Annotated[
        str, Option(help="features matched between photos: sift | aliked-lightglue")
    ] = ReconstructBenchOptions.matcher,
    cameras_only: Annotated[
        bool, Option("--cameras-only", help="stop after the cameras are estimated, to compare matchers")
    ] = ReconstructBenchOptions.cameras_only,
    as_json: AsJson = False,
) -> None:
    """Reconstruction: camera errors against reference cameras, PSNR of held-out photos, time and memory."""
    from stages.lab.bench.reconstruct import run

    options = ReconstructBenchOptions(
        quality=quality, holdout=holdout, device=device, matcher=matcher, cameras_only=cameras_only
    )
    print_results(lambda path: run(sets, path, options), out, as_json)


@app.command("appearance")
def bench_appearance(
    sets: Annotated[list[Path], Argument(metavar="PHOTOSET...", help="folders of photos, or with images/")],
    out: OutKept = Path("appearance.json"),
    quality: Quality = AppearanceBenchOptions.quality,
    holdout: Holdout = AppearanceBenchOptions.holdout,
    models: Annotated[
        Path | None, Option(help="folder in which cameras and sparse points are cached between runs")
    ] = AppearanceBenchOptions.models,
    as_json: AsJson = False,
) -> None:
    """Novel views: held-out photos rendered from our Gaussians and from gsplat's default recipe after equal time."""
    from stages.lab.bench.appearance import run

    options = AppearanceBenchOptions(quality=quality, holdout=holdout, models=models)
    print_results(lambda path: run(sets, path, options), out, as_json)


@app.command("segment")
def bench_segment(
    sets: Annotated[
        list[Path] | None,
        Argument(
            metavar="PHOTOSET...",
            show_default=False,
            help="folders of photos, or with images/, that have label images; default: synthetic scenes",
        ),
    ] = None,
    labels: Annotated[
        Path | None,
        Option(
            help="of photo sets: folder of label images, or of such folders named as the sets; default: PHOTOSET/labels"
        ),
    ] = SegmentPhotosOptions.labels,
    labelled: Annotated[
        Path | None,
        Option(help="of photo sets: folder of labelled scenes PHOTOSET.ply; missing ones are made and kept there"),
    ] = SegmentPhotosOptions.labelled,
    scenes: Annotated[
        int, Option(help="scenes of each kind: separate objects, and objects in contact")
    ] = SegmentBenchOptions.scenes,
    views: Views = SegmentBenchOptions.views,
    weights: Annotated[
        Path | None, Option(help="weights of network backends; default: searched; without any, they are skipped")
    ] = SegmentBenchOptions.weights,
    reconstruct: Annotated[
        bool,
        Option("--reconstruct", help="also segment scenes reconstructed from photos, by geometry and by the network"),
    ] = SegmentBenchOptions.reconstruct,
    out: Out = None,
    device: Device = SegmentPhotosOptions.device,
    as_json: AsJson = False,
) -> None:
    """Segmentation by geometry, by true and by corrupted masks, and by networks: IoU with the true labels.

    Of photo sets: objects in real photos against label images: recall, IoU and panoptic quality.
    """
    if not sets:
        if labels or labelled:
            raise InputError("--labels and --labelled: only apply to real photos; name their folders (PHOTOSET)")
        from stages.lab.bench.segment import run

        options = SegmentBenchOptions(
            scenes=scenes, views=views, weights=weights, device=device, reconstruct=reconstruct
        )
        print_results(lambda path: run(path, options), out, as_json)
        return
    from stages.lab.bench.segment_photos import run as run_photos

    chosen = SegmentPhotosOptions(labels=labels, labelled=labelled, device=device)
    print_results(lambda path: run_photos(sets, path, chosen), out, as_json)


@app.command("segment-ablation")
def bench_segment_ablation(
    train: Annotated[
        list[Path],
        Argument(metavar="FOLDER...", help="scenes to train on, of `clutter --reconstruct --exact`"),
    ],
    scores: Annotated[list[Path], Option(help="other scenes, for the scores of candidates; repeatable")],
    judge: Annotated[list[Path], Option(help="reconstructed scenes to judge on; repeatable")],
    out: OutWithTable = Path("segment_ablation.json"),
    only: Annotated[str, Option(help="names of the ablations, such as full,colour; default: all")] = "",
    steps: Annotated[int, Option(help="training steps of each network")] = SegmentAblationOptions.steps,
    batch: Annotated[int, Option(help="crops per step")] = SegmentAblationOptions.batch,
    workers: Annotated[
        int, Option(help="processes that prepare crops; 0: the training process itself")
    ] = SegmentAblationOptions.workers,
    seed: Seed = SegmentAblationOptions.seed,
    device: Device = SegmentAblationOptions.device,
    as_json: AsJson = False,
) -> None:
    """Ablation: retrain the segmentation network without one of its inputs, classes or kinds of data at a time."""
    from stages.lab.bench.segment_ablation import run

    options = SegmentAblationOptions(steps=steps, batch=batch, workers=workers, seed=seed, device=device)
    data = SegmentAblationData(train, scores, judge)
    print_results(lambda path: run(data, path, options, only), out, as_json)


@app.command("refine")
def bench_refine(
    scenes: Annotated[int, Option(help="number of scenes of separate objects")] = RefineBenchOptions.scenes,
    views: Views = RefineBenchOptions.views,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """Inpainting of the table under removed objects: error against the true table in novel views."""
    from stages.lab.bench.refine import run

    options = RefineBenchOptions(scenes=scenes, views=views)
    print_results(lambda path: run(path, options), out, as_json)


@app.command("register")
def bench_register(
    only: Annotated[
        str, Option(help="names of the objects, such as ball,duck; default: all ten")
    ] = RegisterBenchOptions.only,
    trials: Annotated[int, Option(help="partial views of each object")] = RegisterBenchOptions.trials,
    out: Out = None,
    seed: Seed = RegisterBenchOptions.seed,
    device: Device = RegisterBenchOptions.device,
    as_json: AsJson = False,
) -> None:
    """Registration of partial to complete objects, compared with ICP and splatreg."""
    from stages.lab.bench.register import run

    options = RegisterBenchOptions(only=only, trials=trials, seed=seed, device=device)
    print_results(lambda path: run(path, options), out, as_json)


@app.command("complete")
def bench_complete(
    scene: Annotated[
        list[str], Option(help="names of the objects of a scene, separated by commas; repeatable")
    ] = CompleteBenchOptions.scenes,
    known: Annotated[
        str, Option(help="names of the objects in the library; default: all ten")
    ] = CompleteBenchOptions.known,
    out: Out = None,
    seed: Seed = CompleteBenchOptions.seed,
    as_json: AsJson = False,
) -> None:
    """Object completion: surface error, PSNR from behind, and error of simulated falls, by completer."""
    from stages.lab.bench.complete import run

    options = CompleteBenchOptions(scenes=tuple(scene), known=known, seed=seed)
    print_results(lambda path: run(path, options), out, as_json)
