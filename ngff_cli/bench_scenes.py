"""Benchmarks of scenes: cameras, views, segmented objects and completed surfaces, compared with the truth."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ngff_cli.options import AsJson, Out, OutKept, OutWithTable, add_benchmark, print_results, with_options
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

Views = Annotated[int, Option(help="number of cameras per scene")]


@app.command("reconstruct")
@with_options
def bench_reconstruct(
    *,
    sets: Annotated[list[Path], Argument(metavar="PHOTOSET...", help="folders that contain images/ and cameras.json")],
    out: OutKept = Path("reconstruct.json"),
    options: ReconstructBenchOptions,
    as_json: AsJson = False,
) -> None:
    """Reconstruction: camera errors relative to reference cameras, PSNR of held-out photos, time and memory."""
    from stages.lab.bench.reconstruct import run

    print_results(lambda path: run(sets, path, options), out, as_json)


@app.command("appearance")
@with_options
def bench_appearance(
    *,
    sets: Annotated[
        list[Path], Argument(metavar="PHOTOSET...", help="folders of photos, or folders that contain images/")
    ],
    out: OutKept = Path("appearance.json"),
    options: AppearanceBenchOptions,
    as_json: AsJson = False,
) -> None:
    """Novel views: held-out photos rendered from our Gaussians and from gsplat's default recipe after equal time."""
    from stages.lab.bench.appearance import run

    print_results(lambda path: run(sets, path, options), out, as_json)


@app.command("segment")
@with_options
def bench_segment(
    *,
    sets: Annotated[
        list[Path] | None,
        Argument(
            metavar="PHOTOSET...",
            show_default=False,
            help="folders of photos (or of images/) that have label images; default: synthetic scenes",
        ),
    ] = None,
    options: SegmentBenchOptions,
    chosen: SegmentPhotosOptions,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """Segmentation by geometry, by true and corrupted masks, and by networks: IoU with the true labels.

    With photo sets, compare the objects found in real photos with label images: recall, IoU and panoptic quality.
    """
    if not sets:
        if chosen.labels or chosen.labelled:
            raise InputError(
                "--labels and --labelled: only apply to photo sets; name their folders (PHOTOSET), or drop them"
            )
        from stages.lab.bench.segment import run

        print_results(lambda path: run(path, options), out, as_json)
        return
    from stages.lab.bench.segment_photos import run as run_photos

    print_results(lambda path: run_photos(sets, path, chosen), out, as_json)


@app.command("segment-ablation")
@with_options
def bench_segment_ablation(
    *,
    train: Annotated[
        list[Path],
        Argument(
            metavar="FOLDER...",
            help="folder of scenes to train on, written by `ngff-lab clutter --reconstruct --exact`",
        ),
    ],
    scores: Annotated[list[Path], Option(help="folder of other scenes, to train the scores of candidates; repeatable")],
    judge: Annotated[list[Path], Option(help="folder of reconstructed scenes to evaluate on; repeatable")],
    out: OutWithTable = Path("segment_ablation.json"),
    only: Annotated[str, Option(help="names of the ablations to run, such as full,colour; default: all")] = "",
    options: SegmentAblationOptions,
    as_json: AsJson = False,
) -> None:
    """Ablation: retrain the segmentation network, each time without one of its inputs, classes or kinds of data."""
    from stages.lab.bench.segment_ablation import run

    data = SegmentAblationData(train, scores, judge)
    print_results(lambda path: run(data, path, options, only), out, as_json)


add_benchmark(
    app,
    "refine",
    "stages.lab.bench.refine:run",
    RefineBenchOptions,
    "Inpainting of the table under removed objects: errors relative to the true table in novel views.",
)


add_benchmark(
    app,
    "register",
    "stages.lab.bench.register:run",
    RegisterBenchOptions,
    "Registration of partial to complete objects, compared with ICP and splatreg.",
)


add_benchmark(
    app,
    "complete",
    "stages.lab.bench.complete:run",
    CompleteBenchOptions,
    "Object completion: surface error, PSNR from behind, and error of simulated falls, by completer.",
)
