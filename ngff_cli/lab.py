"""`ngff-lab`: its commands, most of which are defined in training.py, data.py and bench.py."""

import math
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from ngff_cli import bench, data, training
from ngff_cli.options import (
    AsJson,
    SceneIn,
    Threads,
    new_app,
    print_results,
    run_command_line,
    set_up,
    with_options,
)
from stages.lab.bench.motion_options import EstimateOptions, ReplayOptions
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.questionnaire.options import StudyOptions
from stages.lab.track.options import TrackOptions

app = new_app()

MaterialsOut = Annotated[
    Path, Option("-o", "--out", help="file of materials to write (.json), for `ngff simulate --materials`")
]


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
@with_options
def replay(
    *,
    recording: Annotated[Path, Argument(metavar="RECORDING.npz", help="recorded run of the published MPM solver")],
    out: Annotated[Path, Option("-o", "--out", help="file for our run to write, in the format of RECORDING")] = Path(
        "ours.npz"
    ),
    options: ReplayOptions,
) -> None:
    """Repeat a recorded run of the published MPM solver with our solver and print the differences."""
    from stages.lab.bench.replay import run

    for line in run(recording, out, options):
        print(line)


@app.command()
def fuzz(
    out: Annotated[Path, Option("-o", "--out", help="report to write (.json)")] = Path("fuzz.json"),
    count: Annotated[int, Option(help="number of damaged files to read")] = 10_000,
    seed: Annotated[int, Option(help="random seed of the damage")] = 0,
    minutes: Annotated[
        float, Option(help="stop after this time and report on the files read until then [min]")
    ] = math.inf,
    as_json: AsJson = False,
) -> None:
    """Fuzz the readers: read randomly damaged files of every format, and keep those that raise unexpected errors."""
    from stages.lab.fuzz.campaign import run

    print_results(lambda path: run(path, count, seed, minutes), out, as_json)


@app.command("estimate-materials")
@with_options
def estimate_materials(
    *,
    video: Annotated[Path, Argument(metavar="VIDEO.mp4", help="video of moving objects")],
    out: MaterialsOut = Path("materials.json"),
    options: EstimateOptions,
) -> None:
    """Estimate the materials of the objects in a video with a vision-language model.

    Works with any endpoint that implements OpenAI's protocol: $OPENAI_BASE_URL, and $OPENAI_API_KEY if it needs a key.
    """
    from stages.lab.bench.estimate_materials import run

    for line in run(video, out, options):
        print(line)


@app.command()
@with_options
def fit(
    *,
    scene: SceneIn,
    motion: Annotated[
        list[Path],
        Argument(
            metavar="TRACK.h5|FILM.mp4",
            help="trajectory of the scene's objects, or films of the scene's cameras, each named like its camera; "
            "the first frame must show the state of the scene",
        ),
    ],
    out: MaterialsOut = Path("materials.json"),
    options: MaterialFitOptions,
) -> None:
    """Estimate materials and initial velocities of objects from a tracked motion, or from films: SCENE.ply and TRACK.h5
    or FILM.mp4... -> MATERIALS.json.

    Films must be from fixed cameras of the scene and named like them: camera03.mp4, or IMG_3.mp4 for a photo IMG_3.jpg.
    They must start with the state of the scene and have the same frame rate; for a scene of `ngff reconstruct
    CAMERAS/ --sequence` the start is stored in the scene. Several films are better than one, which hardly shows depth.
    """
    from stages.lab.fit.fit import run

    for line in run(scene, motion, out, options):
        print(line)


@app.command()
@with_options
def track(
    *,
    scene: SceneIn,
    films: Annotated[
        Path, Argument(metavar="CAMERAS/", help="folder of the films from which the scene was reconstructed")
    ],
    out: Annotated[Path, Option("-o", "--out", help="trajectory to write (.h5)")] = Path("truth.h5"),
    options: TrackOptions,
) -> None:
    """Follow the objects of a scene through the films of several cameras: SCENE.ply and CAMERAS/ -> TRUTH.h5.

    Make the scene with `ngff reconstruct CAMERAS/ --sequence` and `ngff segment`; `ngff evaluate` takes the result as
    the ground truth.
    """
    from stages.lab.track.track import run

    for line in run(scene, films, out, options):
        print(line)


@app.command()
@with_options
def questionnaire(
    *,
    folder: Annotated[
        Path,
        Argument(
            metavar="FOLDER",
            help="folder of films with one folder per model, divided into "
            "one folder per split if there are several; with --answers: folder of a study",
        ),
    ],
    out: Annotated[
        Path | None,
        Option(
            "-o",
            "--out",
            help="folder of the study to write, by default study; with --answers: JSON file to write the table to",
        ),
    ] = None,
    answers: Annotated[
        list[Path], Option(help="file of answers returned by a participant, or folder of such files; repeatable")
    ] = [],  # noqa: B006
    options: StudyOptions,
) -> None:
    """Write the pages of a user study in which people rate videos, or with --answers the table of their ratings."""
    from stages.lab.questionnaire import answers as table
    from stages.lab.questionnaire import study

    lines = (
        table.run(folder, answers, out, options.seed) if answers else study.run(folder, out or Path("study"), options)
    )
    print("\n".join(lines))


app.add_typer(training.app)
app.add_typer(data.app)
app.add_typer(bench.app, name="bench")


def main() -> None:
    """Run the command in this process's arguments."""
    run_command_line(app)


if __name__ == "__main__":
    main()
