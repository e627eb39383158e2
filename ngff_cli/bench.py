"""`ngff-lab bench`: quality and speed, each compared with a baseline measured in the same run."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from ngff_cli.options import AsJson, Device, Keypoints, SceneCount, Seed, new_app, print_results
from stages.core.errors import InputError

app = new_app()

Out = Annotated[Path | None, Option("-o", "--out", help="JSON file to write the results to")]
OutKept = Annotated[Path, Option("-o", "--out", help="JSON file of results; existing ones are kept")]
OutWithTable = Annotated[
    Path, Option("-o", "--out", help="results (.json), existing ones are kept; also writes a table (.md)")
]
Holdout = Annotated[int, Option(help="hold out every N-th photo")]
Views = Annotated[int, Option(help="number of cameras per scene")]
Workers = Annotated[int, Option(help="processes")]
Quality = Annotated[str, Option(help="quality of the reconstruction")]
Compiled = Annotated[bool, Option("--compiled", help="compile the training step first; for GPUs")]


@app.callback()
def _bench() -> None:
    """Run a benchmark; each compares with a baseline in the same run."""


@app.command("mpm")
def bench_mpm(
    device: Device = "auto",
    particles: Annotated[list[int], Option(help="particles per scene; repeatable")] = [6_144, 20_000, 250_000],  # noqa: B006
    scenes: Annotated[int, Option(help="scenes per batch; 0: chosen for the device")] = 0,
    frames: Annotated[int, Option(help="frames of 200 substeps to time")] = 10,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """MPM solver: time per substep and scenes per minute, compared with the unfused three-kernel solver."""
    from stages.lab.bench.mpm import MpmBenchOptions, run

    options = MpmBenchOptions(device=device, particles=tuple(particles), scenes=scenes, frames=frames)
    print_results(lambda path: run(options, path), out, as_json)


@app.command("raster")
def bench_raster(
    device: Annotated[str, Option(help="cpu, or cuda to compare with gsplat on a GPU")] = "cpu",
    out: Out = None,
    repeat: Annotated[int, Option(help="timed calls of each; the fastest counts")] = 15,
    shrink: Annotated[int, Option(help="factor by which the numbers of Gaussians and pixels are reduced")] = 1,
    as_json: AsJson = False,
) -> None:
    """Rasteriser: on the CPU compared with a per-pixel rasteriser, on a GPU (--device cuda) with gsplat."""
    from stages.core.backends import pick_device
    from stages.lab.bench import raster

    options = raster.RasterBenchOptions(repeat=repeat, shrink=shrink)
    if (at := pick_device(device)) == "cpu":
        print_results(lambda path: raster.run(path, options), out, as_json)
        return
    from stages.lab.bench import raster_cuda

    print_results(lambda path: raster_cuda.run(at, path, options), out, as_json)


@app.command("reconstruct")
def bench_reconstruct(
    sets: Annotated[list[Path], Argument(metavar="PHOTOSET...", help="folders with images/ and cameras.json")],
    out: OutKept = Path("reconstruct.json"),
    quality: Quality = "normal",
    holdout: Holdout = 8,
    device: Device = "auto",
    matcher: Annotated[str, Option(help="features matched between photos: sift | aliked-lightglue")] = "sift",
    cameras: Annotated[
        bool, Option("--cameras", help="stop after the cameras are estimated, to compare matchers")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Reconstruction: camera errors against reference cameras, PSNR of held-out photos, time and memory."""
    from stages.lab.bench.reconstruct import ReconstructBenchOptions, run

    options = ReconstructBenchOptions(quality=quality, holdout=holdout, device=device, matcher=matcher, cameras=cameras)
    print_results(lambda path: run(sets, path, options), out, as_json)


@app.command("chain")
def bench_chain(
    photos: Annotated[
        Path | None, Argument(metavar="PHOTOS", help="folder of photos or a video; not with --table")
    ] = None,
    table: Annotated[
        bool,
        Option("--table", help="instead of PHOTOS: the paper's table, from rendered photos of 3 and of 6 toys"),
    ] = False,
    quality: Quality = "normal",
    device: Device = "auto",
    steps: Annotated[int, Option(help="frames of the video")] = 100,
    refine: Annotated[bool, Option(help="complete the objects before they are simulated")] = True,
    repeat: Annotated[int, Option(help="runs in one process; the first one loads kernels")] = 2,
    commands: Annotated[bool, Option(help="also run each stage as a command")] = True,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """All stages from photos to a video: time, GPU utilisation, and whether repeated runs give equal files."""
    from stages.lab.bench.chain import ChainBenchOptions, run
    from stages.lab.bench.chain_table import ChainTableOptions
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


@app.command("appearance")
def bench_appearance(
    sets: Annotated[list[Path], Argument(metavar="PHOTOSET...", help="folders of photos, or with images/")],
    out: OutKept = Path("appearance.json"),
    quality: Quality = "high",
    holdout: Holdout = 8,
    models: Annotated[
        Path | None, Option(help="folder in which cameras and sparse points are cached between runs")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Novel views: held-out photos rendered from our Gaussians and from gsplat's default recipe after equal time."""
    from stages.lab.bench.appearance import AppearanceBenchOptions, run

    options = AppearanceBenchOptions(quality=quality, holdout=holdout, models=models)
    print_results(lambda path: run(sets, path, options), out, as_json)


@app.command("pi3")
def bench_pi3(
    device: Device = "auto",
    views: Annotated[list[int], Option(help="photos per pass; repeatable")] = [1, 8, 20, 50],  # noqa: B006
    size: Annotated[int, Option(help="side of the photos, a multiple of 14 [px]")] = 448,
    repeat: Annotated[int, Option(help="timed passes of each")] = 3,
    splats: Annotated[bool, Option("--splats", help="include the Gaussian head")] = False,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """π³ at its published size with random weights: time and memory, compared with unfused attention."""
    from stages.lab.bench.pi3 import Pi3BenchOptions, run

    options = Pi3BenchOptions(device=device, views=tuple(views), size=size, repeat=repeat, splats=splats)
    print_results(lambda path: run(options, out=path), out, as_json)


@app.command("segment")
def bench_segment(
    sets: Annotated[
        list[Path] | None,
        Argument(metavar="PHOTOSET...", show_default=False, help="with --photos: folders of photos, or with images/"),
    ] = None,
    photos: Annotated[
        bool, Option("--photos", help="real photo sets with label images, instead of synthetic scenes")
    ] = False,
    labels: Annotated[
        Path | None,
        Option(
            help="with --photos: folder of label images, or of such folders named as the sets; default: PHOTOSET/labels"
        ),
    ] = None,
    labelled: Annotated[
        Path | None,
        Option(help="with --photos: folder of labelled scenes PHOTOSET.ply; missing ones are made and kept there"),
    ] = None,
    scenes: Annotated[int, Option(help="scenes of each kind: separate objects, and objects in contact")] = 4,
    views: Views = 24,
    weights: Annotated[
        Path | None, Option(help="weights of network backends; default: searched; without any, they are skipped")
    ] = None,
    reconstruct: Annotated[
        bool,
        Option("--reconstruct", help="also segment scenes reconstructed from photos, by geometry and by the network"),
    ] = False,
    out: Out = None,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Segmentation by geometry, by true and by corrupted masks, and by networks: IoU with the true labels.

    With --photos: objects in real photos against label images: recall, IoU and panoptic quality.
    """
    if not photos:
        if sets or labels or labelled:
            raise InputError("PHOTOSET, --labels and --labelled: only apply to real photos; add --photos")
        from stages.lab.bench.segment import SegmentBenchOptions, run

        options = SegmentBenchOptions(
            scenes=scenes, views=views, weights=weights, device=device, reconstruct=reconstruct
        )
        print_results(lambda path: run(path, options), out, as_json)
        return
    from stages.lab.bench.segment_photos import SegmentPhotosOptions
    from stages.lab.bench.segment_photos import run as run_photos

    chosen = SegmentPhotosOptions(labels=labels, labelled=labelled, device=device)
    print_results(lambda path: run_photos(sets or [], path, chosen), out, as_json)


@app.command("segment-ablation")
def bench_segment_ablation(
    train: Annotated[
        list[Path],
        Argument(metavar="FOLDER...", help="scenes to train on, of `clutter --reconstruct --exact`"),
    ],
    scores: Annotated[list[Path], Option(help="other scenes, for the scores of candidates; repeatable")],
    judge: Annotated[list[Path], Option(help="reconstructed scenes to judge on; repeatable")],
    out: OutWithTable = Path("segment_ablation.json"),
    only: Annotated[list[str], Option(help="name of an ablation, such as colour; repeatable; default: all")] = [],  # noqa: B006
    steps: Annotated[int, Option(help="training steps of each network")] = 1500,
    batch: Annotated[int, Option(help="crops per step")] = 4,
    workers: Annotated[int, Option(help="processes that prepare crops; 0: the training process itself")] = 0,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Ablation: retrain the segmentation network without one of its inputs, classes or kinds of data at a time."""
    from stages.lab.bench.segment_ablation import SegmentAblationData, SegmentAblationOptions, run

    options = SegmentAblationOptions(steps=steps, batch=batch, workers=workers, seed=seed, device=device)
    data = SegmentAblationData(train, scores, judge)
    print_results(lambda path: run(data, path, options, only), out, as_json)


@app.command("refine")
def bench_refine(
    scenes: Annotated[int, Option(help="number of scenes of separate objects")] = 4,
    views: Views = 24,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """Inpainting of the table under removed objects: error against the true table in novel views."""
    from stages.lab.bench.refine import RefineBenchOptions, run

    options = RefineBenchOptions(scenes=scenes, views=views)
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


@app.command("rollout")
def bench_rollout(
    out: Annotated[Path, Option("-o", "--out", help="JSON file to write the results to")] = Path("rollout.json"),
    weights: Annotated[
        Path | None, Option(help="weights of the force field (.safetensors); default: those in the package")
    ] = None,
    keypoints: Annotated[int, Option(help="keypoints of each of the three objects")] = 2048,
    steps: Annotated[int, Option(help="number of 0.02 s steps")] = 100,
    scenes: Annotated[list[int], Option(help="scenes per batch; repeatable; default: 1, and 64 on a GPU")] = [],  # noqa: B006
    repeat: Annotated[int, Option(help="timed rollouts, of which the median counts")] = 5,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Learned force field: time of a rollout, compared with the published model and MPM."""
    from stages.lab.bench.rollout import RolloutBenchOptions, run

    options = RolloutBenchOptions(
        weights=weights, keypoints=keypoints, steps=steps, scenes=tuple(scenes), repeat=repeat, device=device
    )
    print_results(lambda path: run(path, options), out, as_json)


@app.command("register")
def bench_register(
    only: Annotated[str, Option(help="names of the objects, such as ball,duck; default: all ten")] = "",
    trials: Annotated[int, Option(help="partial views of each object")] = 10,
    out: Out = None,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Registration of partial to complete objects, compared with ICP and splatreg."""
    from stages.lab.bench.register import RegisterBenchOptions, run

    options = RegisterBenchOptions(only=only, trials=trials, seed=seed, device=device)
    print_results(lambda path: run(path, options), out, as_json)


@app.command("complete")
def bench_complete(
    scene: Annotated[list[str], Option(help="names of the objects of a scene, separated by commas; repeatable")] = [  # noqa: B006
        "panda,duck",
        "can,miku",
        "bowl,phone",
    ],
    known: Annotated[str, Option(help="names of the objects in the library; default: all ten")] = "",
    out: Out = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Object completion: surface error, PSNR from behind, and error of simulated falls, by completer."""
    from stages.lab.bench.complete import CompleteBenchOptions, run

    options = CompleteBenchOptions(scenes=tuple(scene), known=known, seed=seed)
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
