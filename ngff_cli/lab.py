"""`ngff-lab`: training, and a check of the installation; data.py and bench.py have its other commands."""

from pathlib import Path
from typing import Annotated

import typer

from ngff_cli import bench, data
from ngff_cli.options import (
    AsJson,
    CommandGroup,
    Device,
    SceneIn,
    Seed,
    Threads,
    limit_threads,
    print_results,
    run_command_line,
    set_up_logging,
)
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.questionnaire.options import StudyOptions
from stages.lab.track.options import TrackOptions

app = typer.Typer(cls=CommandGroup, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)

Half = Annotated[bool, typer.Option("--half", help="also store the weights in 16 bits, for the package")]


@app.callback()
def lab(threads: Threads = None) -> None:
    """Generate data, train models, run benchmarks, and check the installation."""
    set_up_logging(False)
    limit_threads(threads)


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Check the installation: GPU, packages, weights and disk space, with a remedy for each problem."""
    from ngff_cli.doctor import check_installation, write_findings

    print_results(lambda path: write_findings(check_installation(), path), None, as_json)


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING.npz", help="run of the published MPM solver")],
    out: Annotated[Path, typer.Option("-o", "--out", help="our run to write, as RECORDING")] = Path("ours.npz"),
    frames: Annotated[int, typer.Option(help="number of frames; 0: all of the recording")] = 0,
    device: Device = "auto",
) -> None:
    """Repeat a recorded run of the published MPM solver with ours and print the differences."""
    from stages.lab.bench.replay import ReplayOptions, run

    for line in run(recording, out, ReplayOptions(frames=frames, device=device)):
        print(line)


@app.command()
def fuzz(
    out: Annotated[Path, typer.Option("-o", "--out", help="report to write (.json)")] = Path("fuzz.json"),
    count: Annotated[int, typer.Option(help="number of damaged files")] = 10_000,
    seed: Annotated[int, typer.Option(help="random seed of the damage")] = 0,
    as_json: AsJson = False,
) -> None:
    """Fuzz the readers: read randomly damaged files of every format, and keep those that raise unexpected errors."""
    from stages.lab.fuzz.campaign import run

    print_results(lambda path: run(path, count, seed), out, as_json)


@app.command()
def train(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="ngff | ngff-paper | gcn | transformer | ...")],
    data: Annotated[Path, typer.Option(help="folder of motions, as `ngff-lab dataset` writes")],
    out: Annotated[Path, typer.Option("-o", "--out", help="weights to write (.safetensors)")],
    minutes: Annotated[float, typer.Option(help="training time [min]")] = 20.0,
    steps: Annotated[int, typer.Option(help="optimizer steps instead of --minutes; 0: use --minutes")] = 0,
    batch: Annotated[int, typer.Option(help="scenes per step")] = 32,
    keypoints: Annotated[int, typer.Option(help="keypoints per object")] = 256,
    sparse_keypoints: Annotated[
        int, typer.Option(help="keypoints per object in every fourth step; 0: the same in all steps")
    ] = 0,
    lr: Annotated[float, typer.Option(help="maximum learning rate")] = 1e-3,
    width: Annotated[
        int, typer.Option(help="width of the network, may exceed that of --from; 0: the model's default")
    ] = 0,
    horizons: Annotated[str, typer.Option(help="rollout length of each phase [frames]")] = "8,20,40",
    loss: Annotated[
        str,
        typer.Option(
            help="square: squared error | scene: RMSE per scene | axes: RMSE per object and axis | "
            "relative: axes, divided by the amount of motion"
        ),
    ] = "scene",  # fmt: skip
    optimizer: Annotated[str, typer.Option(help="adamw | soap (extra `train`)")] = "adamw",
    velocity_weight: Annotated[
        float, typer.Option(help="weight of velocity errors relative to position errors [s]; 0: none")
    ] = 0.0,
    gradient_discount: Annotated[float, typer.Option(help="factor on the gradient per frame of backpropagation")] = 0.9,
    groups: Annotated[
        str, typer.Option(help="groups to train on, also varied, solid, turned; the last 100 scenes are for validation")
    ] = "3_0..3_8",
    compiled: Annotated[bool, typer.Option("--compiled", help="compile the training step first; for GPUs")] = False,
    seed: Seed = 0,
    device: Device = "auto",
    start: Annotated[
        Path | None, typer.Option("--from", help="initial weights (.safetensors); default: random")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="continue from the .ckpt next to the weights")] = False,
) -> None:
    """Train a dynamics model on simulated motion."""
    from stages.lab.training.train import TrainOptions, run

    options = TrainOptions(
        minutes=minutes, steps=steps, batch=batch, keypoints=keypoints, sparse_keypoints=sparse_keypoints, lr=lr,
        horizons=horizons, width=width, loss=loss, optimizer=optimizer, velocity_weight=velocity_weight,
        gradient_discount=gradient_discount, groups=groups, compiled=compiled, seed=seed, device=device,
    )  # fmt: skip
    for line in run(model, data, out, options, resume, start):
        print(line)


@app.command()
def card(
    cards: Annotated[list[Path], typer.Argument(metavar="CARD.json", help="training cards; several are compared")],
    out: Annotated[Path, typer.Option("-o", "--out", help="plot to write (.png)")] = Path("training.png"),
    half: Half = False,
) -> None:
    """Plot training curves: loss and validation scores over time."""
    from stages.lab.training.card import run

    for line in run(cards, out, half):
        print(line)


@app.command()
def average(
    files: Annotated[list[Path], typer.Argument(metavar="WEIGHTS", help="two or more, of one model (.safetensors)")],
    out: Annotated[Path, typer.Option("-o", "--out", help="weights to write (.safetensors)")],
    ratios: Annotated[str, typer.Option(help="weight of each file, such as 0.7,0.3")],
    half: Half = False,
) -> None:
    """Average the weights of several training runs."""
    from stages.lab.training.average import run

    print(run(files, ratios, out, half))


@app.command("train-splatter")
def train_splatter(
    data: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="scenes (.ply), and folders of photos with their cameras (transforms.json or a COLMAP model)",
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="weights of pi3-splat to write (.safetensors)")],
    weights: Annotated[Path | None, typer.Option(help="initial weights of pi3 or pi3-splat; default: searched")] = None,
    steps: Annotated[int, typer.Option(help="optimizer steps")] = 20_000,
    views: Annotated[int, typer.Option(help="input views per step; one more view is rendered")] = 4,
    side: Annotated[int, typer.Option(help="longest side of an image [px]")] = 448,
    depth: Annotated[
        str, typer.Option(help="depth of the Gaussians: network | given (true depth, for scenes only)")
    ] = "network",
    width: Annotated[
        int, typer.Option(help="width of a small random network that replaces the weights, for tests; 0: none")
    ] = 0,
    lr: Annotated[float, typer.Option(help="maximum learning rate")] = 1e-4,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Train the Gaussian head of pi3-splat; the rest of the network stays fixed."""
    from stages.lab.training.train_splatter import SplatterOptions, run

    options = SplatterOptions(
        steps=steps, views=views, side=side, depth=depth, width=width, lr=lr, seed=seed, device=device
    )
    for line in run(data, out, options, weights):
        print(line, flush=True)


@app.command()
def clutter(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="folder of scenes; finished ones are kept")],
    meshes: Annotated[
        list[Path],
        typer.Option(
            "--from",
            metavar="MESH",
            help="textured mesh (.obj .glb .ply ...), or folder of meshes, added to the generated objects; repeatable",
        ),
    ] = [],  # noqa: B006
    count: Annotated[int, typer.Option(help="number of scenes")] = 20,
    first: Annotated[int, typer.Option(help="number of the first scene")] = 0,
    photos: Annotated[int, typer.Option(help="photos of each scene")] = 12,
    size: Annotated[int, typer.Option(help="longest side of a photo [px]")] = 512,
    observations: Annotated[
        int,
        typer.Option(
            help="write this many samples of a reconstruction-noise model per scene instead of photos; 0: write photos"
        ),
    ] = 0,
    reconstruct: Annotated[
        bool,
        typer.Option(
            "--reconstruct",
            help="reconstruct the photos with their true cameras, and write the labelled result instead",
        ),
    ] = False,
    exact: Annotated[bool, typer.Option("--exact", help="write the true Gaussians, labelled, not photos")] = False,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Generate labelled scenes of objects on tables, desks, shelves and floors, to train the segmentation.

    Without options, run `ngff reconstruct NNNN/photos --cameras NNNN/transforms.json -o NNNN/scene.ply` on each scene.
    """
    from stages.lab.clutter.scenes import ClutterOptions, run

    options = ClutterOptions(
        count=count, first=first, photos=photos, size=size, observations=observations, reconstruct=reconstruct,
        exact=exact, seed=seed, device=device,
    )  # fmt: skip
    for line in run(out, options, meshes):
        print(line, flush=True)


@app.command("train-segmenter")
def train_segmenter(
    data: Annotated[list[Path], typer.Argument(metavar="FOLDER", help="scenes of `ngff-lab clutter`; several folders")],
    out: Annotated[Path, typer.Option("-o", "--out", help="weights to write (.safetensors)")],
    minutes: Annotated[
        float, typer.Option(help="training time of the network [min]; 0: train only the candidate scores")
    ] = 30.0,
    steps: Annotated[int, typer.Option(help="optimizer steps instead of --minutes; 0: use --minutes")] = 0,
    rate: Annotated[float, typer.Option(help="maximum learning rate")] = 2e-3,
    voxels: Annotated[int, typer.Option(help="largest number of voxels of a training crop")] = 14_000,
    batch: Annotated[int, typer.Option(help="crops per step")] = 1,
    workers: Annotated[int, typer.Option(help="processes that prepare crops; 0: the training process itself")] = 0,
    blocks: Annotated[int, typer.Option(help="residual blocks of each level, down and up")] = 2,
    score_scenes: Annotated[int, typer.Option(help="augmented scenes whose candidates train the scores")] = 200,
    start: Annotated[
        Path | None, typer.Option("--from", help="initial weights (.safetensors); default: random")
    ] = None,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Train the network of `ngff segment --backend learned`."""
    from stages.lab.training.train_segmenter import SegmenterTraining, run

    options = SegmenterTraining(
        minutes=minutes, steps=steps, rate=rate, voxels=voxels, batch=batch, workers=workers, blocks=blocks,
        score_scenes=score_scenes, seed=seed, device=device,
    )  # fmt: skip
    for line in run(data, out, options, start):
        print(line, flush=True)


@app.command("estimate-materials")
def estimate_materials(
    video: Annotated[Path, typer.Argument(metavar="VIDEO.mp4", help="video of moving objects")],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="materials for `ngff simulate --materials` to write (.json)")
    ] = Path("materials.json"),
    objects: Annotated[
        str, typer.Option(help="names, such as duck,ball, or a scene.ply that has them; default: chosen by the model")
    ] = "",
    model: Annotated[str, typer.Option(help="name of a model that accepts images; default: $OPENAI_MODEL")] = "",
    timeout: Annotated[float, typer.Option(help="maximum waiting time for a reply [s]")] = 120.0,
) -> None:
    """Estimate the materials of the objects in a video with a vision-language model.

    Works with any endpoint that implements OpenAI's protocol: $OPENAI_BASE_URL, and $OPENAI_API_KEY if it needs a key.
    """
    from stages.lab.bench.estimate_materials import EstimateOptions, run

    for line in run(video, out, EstimateOptions(objects=objects, model=model, timeout=timeout)):
        print(line)


@app.command()
def fit(
    scene: SceneIn,
    track: Annotated[
        Path,
        typer.Argument(metavar="TRACK.h5", help="trajectory of the scene's objects; its first frame is the scene"),
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="materials for `ngff simulate --materials` to write (.json)")
    ] = Path("materials.json"),
    engine: Annotated[
        str, typer.Option(help="engine that simulates the candidates: auto | rigid | mpm | ngff")
    ] = "auto",
    quality: Annotated[str, typer.Option(help="of --engine mpm: draft | normal | high")] = MaterialFitOptions.quality,
    material: Annotated[
        list[str],
        typer.Option(help="OBJECT=MATERIAL: initial values, kept where the motion does not determine them; repeatable"),
    ] = [],  # noqa: B006
    keypoints: Annotated[int, typer.Option(help="keypoints compared per object")] = MaterialFitOptions.keypoints,
    frames: Annotated[int, typer.Option(help="frames of the track; 0: all")] = MaterialFitOptions.frames,
    noise: Annotated[
        float, typer.Option(help="standard deviation of the track's errors [scene units]; 0: estimated from it")
    ] = MaterialFitOptions.noise,
    evaluations: Annotated[int, typer.Option(help="largest number of simulations")] = MaterialFitOptions.evaluations,
    minutes: Annotated[float, typer.Option(help="longest time of the search [min]")] = MaterialFitOptions.minutes,
    workers: Annotated[int, typer.Option(help="processes")] = MaterialFitOptions.workers,
    seed: Seed = MaterialFitOptions.seed,
    device: Device = MaterialFitOptions.device,
) -> None:
    """Estimate materials and initial velocities of objects from their tracked motion."""
    from stages.lab.fit.fit import run

    options = MaterialFitOptions(
        engine=engine, quality=quality, material=tuple(material), keypoints=keypoints, frames=frames, noise=noise,
        evaluations=evaluations, minutes=minutes, workers=workers, seed=seed, device=device,
    )  # fmt: skip
    for line in run(scene, track, out, options):
        print(line)


@app.command()
def track(
    scene: SceneIn,
    films: Annotated[Path, typer.Argument(metavar="CAMERAS/", help="folder of the films that the scene was made from")],
    out: Annotated[Path, typer.Option("-o", "--out", help="trajectory to write (.h5)")] = Path("truth.h5"),
    resolution: Annotated[
        int, typer.Option(help="longest side at which frames and renderings are compared [px]")
    ] = TrackOptions.resolution,
    frames: Annotated[
        int, typer.Option(help="frames from the release on; 0: until everything rests")
    ] = TrackOptions.frames,
    masks: Annotated[
        Path | None, typer.Option(help="folder with a folder of label images for each film, one for each frame")
    ] = TrackOptions.masks,
    soft: Annotated[
        str, typer.Option(help="names of objects that deform, separated by commas; others are rigid")
    ] = TrackOptions.soft,
    keypoints: Annotated[int, typer.Option(help="keypoints per object, in the trajectory")] = TrackOptions.keypoints,
    seed: Seed = TrackOptions.seed,
    device: Device = TrackOptions.device,
) -> None:
    """Follow the objects of a scene through the films of several cameras: SCENE.ply and CAMERAS/ -> TRUTH.h5.

    The scene is made by `ngff reconstruct CAMERAS/ --sequence` and `ngff segment`; `ngff evaluate` takes the result as
    the truth.
    """
    from stages.lab.track.track import run

    options = TrackOptions(resolution=resolution, frames=frames, masks=masks, soft=soft, keypoints=keypoints, seed=seed,
                           device=device)  # fmt: skip
    for line in run(scene, films, out, options):
        print(line)


@app.command()
def questionnaire(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="folder of films, one folder for each model, in it "
            "one for each split if there are several; with --answers: a study",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            help="folder of the study to write, default: study; with --answers: JSON file to write the table to",
        ),
    ] = None,
    answers: Annotated[
        list[Path], typer.Option(help="file that a participant returned, or a folder of them; repeatable")
    ] = [],  # noqa: B006
    participants: Annotated[int, typer.Option(help="number of pages")] = StudyOptions.participants,
    films: Annotated[int, typer.Option(help="films per page")] = StudyOptions.films,
    seed: Seed = StudyOptions.seed,
) -> None:
    """Write the pages of a user study on which people rate videos, or with --answers the table of their ratings."""
    from stages.lab.questionnaire import answers as table
    from stages.lab.questionnaire import study

    options = StudyOptions(participants=participants, films=films, seed=seed)
    lines = table.run(folder, answers, out, seed) if answers else study.run(folder, out or Path("study"), options)
    print("\n".join(lines))


app.add_typer(data.app)
app.add_typer(bench.app, name="bench")


def main() -> None:
    """Entry point of the script `ngff-lab`."""
    run_command_line(app)


if __name__ == "__main__":
    main()
