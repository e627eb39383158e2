"""`ngff-lab`: its commands, of which training.py, data.py and bench.py define most."""

import math
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from ngff_cli import bench, data, training
from ngff_cli.options import AsJson, Device, SceneIn, Seed, Threads, new_app, print_results, run_command_line, set_up
from stages.lab.bench.motion_options import EstimateOptions, ReplayOptions
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.questionnaire.options import StudyOptions
from stages.lab.track.options import TrackOptions

app = new_app()

MaterialsOut = Annotated[Path, Option("-o", "--out", help="materials for `ngff simulate --materials` to write (.json)")]


@app.callback()
def lab(threads: Threads = None) -> None:
    """Generate data, train models, run benchmarks, and check the installation."""
    set_up(threads)


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Check the installation: GPU, packages, weights and disk space, with a remedy for each problem."""
    from ngff_cli.doctor import check_installation, write_findings

    print_results(lambda path: write_findings(check_installation(), path), None, as_json)


@app.command()
def replay(
    recording: Annotated[Path, Argument(metavar="RECORDING.npz", help="run of the published MPM solver")],
    out: Annotated[Path, Option("-o", "--out", help="our run to write, as RECORDING")] = Path("ours.npz"),
    frames: Annotated[int, Option(help="number of frames; 0: all of the recording")] = ReplayOptions.frames,
    device: Device = ReplayOptions.device,
) -> None:
    """Repeat a recorded run of the published MPM solver with ours and print the differences."""
    from stages.lab.bench.replay import run

    for line in run(recording, out, ReplayOptions(frames=frames, device=device)):
        print(line)


@app.command()
def fuzz(
    out: Annotated[Path, Option("-o", "--out", help="report to write (.json)")] = Path("fuzz.json"),
    count: Annotated[int, Option(help="number of damaged files")] = 10_000,
    seed: Annotated[int, Option(help="random seed of the damage")] = 0,
    minutes: Annotated[float, Option(help="stop after this time, and report on the files so far [min]")] = math.inf,
    as_json: AsJson = False,
) -> None:
    """Fuzz the readers: read randomly damaged files of every format, and keep those that raise unexpected errors."""
    from stages.lab.fuzz.campaign import run

    print_results(lambda path: run(path, count, seed, minutes), out, as_json)


@app.command("estimate-materials")
def estimate_materials(
    video: Annotated[Path, Argument(metavar="VIDEO.mp4", help="video of moving objects")],
    out: MaterialsOut = Path("materials.json"),
    objects: Annotated[
        str, Option(help="names, such as duck,ball, or a scene.ply that has them; default: chosen by the model")
    ] = EstimateOptions.objects,
    model: Annotated[
        str, Option(help="name of a model that accepts images; default: $OPENAI_MODEL")
    ] = EstimateOptions.model,
    timeout: Annotated[float, Option(help="maximum waiting time for a reply [s]")] = EstimateOptions.timeout,
) -> None:
    """Estimate the materials of the objects in a video with a vision-language model.

    Works with any endpoint that implements OpenAI's protocol: $OPENAI_BASE_URL, and $OPENAI_API_KEY if it needs a key.
    """
    from stages.lab.bench.estimate_materials import run

    for line in run(video, out, EstimateOptions(objects=objects, model=model, timeout=timeout)):
        print(line)


@app.command()
def fit(
    scene: SceneIn,
    motion: Annotated[
        list[Path],
        Argument(
            metavar="TRACK.h5|FILM.mp4",
            help="trajectory of the scene's objects, or films of its cameras, each named as its camera; "
            "the first frame is the scene",
        ),
    ],
    out: MaterialsOut = Path("materials.json"),
    engine: Annotated[str, Option(help="engine that simulates the candidates: auto | rigid | mpm | ngff")] = "auto",
    quality: Annotated[str, Option(help="of --engine mpm: draft | normal | high")] = MaterialFitOptions.quality,
    material: Annotated[
        list[str],
        Option(help="OBJECT=MATERIAL: initial values, kept where the motion does not determine them; repeatable"),
    ] = MaterialFitOptions.material,
    align: Annotated[
        bool,
        Option("--align", help="the track has another frame of reference: align it by shared cameras or objects"),
    ] = MaterialFitOptions.align,
    rest: Annotated[
        bool, Option(help="objects of a scene of photos are at rest until something disturbs them")
    ] = MaterialFitOptions.rest,
    keypoints: Annotated[int, Option(help="keypoints compared per object")] = MaterialFitOptions.keypoints,
    frames: Annotated[int, Option(help="frames of the motion; 0: all")] = MaterialFitOptions.frames,
    resolution: Annotated[
        int, Option(help="longest side to which films are reduced [px]")
    ] = MaterialFitOptions.resolution,
    noise: Annotated[
        float, Option(help="standard deviation of the track's errors [scene units]; 0: estimated from it")
    ] = MaterialFitOptions.noise,
    evaluations: Annotated[int, Option(help="largest number of simulations")] = MaterialFitOptions.evaluations,
    minutes: Annotated[float, Option(help="longest time of the search [min]")] = MaterialFitOptions.minutes,
    workers: Annotated[int, Option(help="processes")] = MaterialFitOptions.workers,
    seed: Seed = MaterialFitOptions.seed,
    device: Device = MaterialFitOptions.device,
) -> None:
    """Estimate materials and initial velocities of objects from a tracked motion, or from films: SCENE.ply and TRACK.h5
    or FILM.mp4... -> MATERIALS.json.

    Films are of fixed cameras that the scene has, and named as these: camera03.mp4, or IMG_3.mp4 of a photo IMG_3.jpg.
    They start with the scene, and have one frame rate; those of `ngff reconstruct CAMERAS/ --sequence` start when the
    scene says. Several films are better than one, which hardly shows how far away a thing is.
    """
    from stages.lab.fit.fit import run

    options = MaterialFitOptions(
        engine=engine, quality=quality, material=tuple(material), align=align, rest=rest, keypoints=keypoints,
        frames=frames, resolution=resolution, noise=noise, evaluations=evaluations, minutes=minutes, workers=workers,
        seed=seed, device=device,
    )  # fmt: skip
    for line in run(scene, motion, out, options):
        print(line)


@app.command()
def track(
    scene: SceneIn,
    films: Annotated[Path, Argument(metavar="CAMERAS/", help="folder of the films that the scene was made from")],
    out: Annotated[Path, Option("-o", "--out", help="trajectory to write (.h5)")] = Path("truth.h5"),
    resolution: Annotated[
        int, Option(help="longest side at which frames and renderings are compared [px]")
    ] = TrackOptions.resolution,
    frames: Annotated[int, Option(help="frames from the release on; 0: until everything rests")] = TrackOptions.frames,
    masks: Annotated[
        Path | None, Option(help="folder with a folder of label images for each film, one for each frame")
    ] = TrackOptions.masks,
    soft: Annotated[
        str, Option(help="names of objects that deform, separated by commas; others are rigid")
    ] = TrackOptions.soft,
    keypoints: Annotated[int, Option(help="keypoints per object, in the trajectory")] = TrackOptions.keypoints,
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
        Argument(
            metavar="FOLDER",
            help="folder of films, one folder for each model, in it "
            "one for each split if there are several; with --answers: a study",
        ),
    ],
    out: Annotated[
        Path | None,
        Option(
            "-o",
            "--out",
            help="folder of the study to write, default: study; with --answers: JSON file to write the table to",
        ),
    ] = None,
    answers: Annotated[
        list[Path], Option(help="file that a participant returned, or a folder of them; repeatable")
    ] = [],  # noqa: B006
    participants: Annotated[int, Option(help="number of pages")] = StudyOptions.participants,
    films: Annotated[int, Option(help="films per page")] = StudyOptions.films,
    seed: Seed = StudyOptions.seed,
) -> None:
    """Write the pages of a user study on which people rate videos, or with --answers the table of their ratings."""
    from stages.lab.questionnaire import answers as table
    from stages.lab.questionnaire import study

    options = StudyOptions(participants=participants, films=films, seed=seed)
    lines = table.run(folder, answers, out, seed) if answers else study.run(folder, out or Path("study"), options)
    print("\n".join(lines))


app.add_typer(training.app)
app.add_typer(data.app)
app.add_typer(bench.app, name="bench")


def main() -> None:
    """Entry point of the script `ngff-lab`."""
    run_command_line(app)


if __name__ == "__main__":
    main()
