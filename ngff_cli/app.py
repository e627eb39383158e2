"""`ngff`: six commands from photos to video, each reading and writing files."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ngff_cli.options import (
    AsJson,
    SceneIn,
    Threads,
    new_app,
    run_command_line,
    set_up,
    with_options,
)
from stages.core.backends import load
from stages.evaluate.options import EvaluateOptions
from stages.reconstruct.options import ReconstructOptions
from stages.refine.options import RefineOptions
from stages.render.options import OUTPUT_FORMATS, RenderOptions
from stages.segment.options import SegmentOptions
from stages.simulate.options import SimulateOptions

app = new_app()


def _version(wanted: bool) -> None:
    if wanted:
        from stages.core.scene.files import ngff_version

        print(f"ngff {ngff_version()}")
        raise typer.Exit


@app.callback()
def ngff(
    verbose: Annotated[bool, Option("-v", "--verbose", help="also log debug messages")] = False,
    version: Annotated[bool, Option("--version", callback=_version, is_eager=True, help="print the version")] = False,
    threads: Threads = None,
) -> None:
    """Reconstruct a scene from photos, simulate the physics of its objects and render the motion as a video.

    ngff reconstruct photos/ -o scene.ply; ngff simulate scene.ply -o traj.h5; ngff render traj.h5
    """
    set_up(threads, verbose)


@app.command()
@with_options
def reconstruct(
    *,
    imgs: Annotated[
        Path,
        Argument(
            metavar="PHOTOS", help="folder of photos, or a video; with --sequence: folder of films", show_default=False
        ),
    ],
    out: Annotated[Path, Option("-o", "--out", help="scene to write (.ply)")] = Path("scene.ply"),
    options: ReconstructOptions,
) -> None:
    """Reconstruct a scene of 3D Gaussians from photos: PHOTOS -> SCENE.ply.

    Cameras are estimated from the photos unless given; the scene is rotated upright with its floor at z = 0.
    """
    load("stages.reconstruct.stage:run")(imgs, out, options)


@app.command()
@with_options
def segment(
    *,
    scene: SceneIn,
    out: Annotated[Path, Option("-o", "--out", help="labelled scene to write (.ply)")] = Path("labelled.ply"),
    options: SegmentOptions,
) -> None:
    """Label the Gaussians of each object: SCENE.ply -> LABELLED.ply (object_id: 0 background, 1... objects)."""
    load("stages.segment.stage:run")(scene, out, options)


@app.command()
@with_options
def refine(
    *,
    scene: SceneIn,
    out: Annotated[Path, Option("-o", "--out", help="refined scene to write (.ply)")] = Path("refined.ply"),
    options: RefineOptions,
) -> None:
    """Complete the objects and fill the table beneath them: LABELLED.ply -> REFINED.ply."""
    load("stages.refine.stage:run")(scene, out, options)


@app.command()
@with_options
def simulate(
    *,
    context: typer.Context,
    scene: SceneIn,
    out: Annotated[Path, Option("-o", "--out", help="trajectory to write (.h5)")] = Path("traj.h5"),
    options: SimulateOptions,
) -> None:
    """Simulate the motion of the objects of a scene: SCENE.ply -> TRAJ.h5."""
    given = {name for name in context.params if context.get_parameter_source(name).name == "COMMANDLINE"}
    load("stages.simulate.stage:run")(scene, out, options, given)


@app.command()
@with_options
def render(
    *,
    source: Annotated[
        list[Path],
        Argument(
            metavar="TRAJ.h5|SCENE.ply", help="file to render; give several with --side-by-side", show_default=False
        ),
    ],
    out: Annotated[
        Path | None,
        Option(
            "-o",
            "--out",
            help=f"file to write ({' '.join(OUTPUT_FORMATS)}); default: a name made of the input and the view",
        ),
    ] = None,
    options: RenderOptions,
) -> None:
    """Render a trajectory or a scene: TRAJ.h5 or SCENE.ply -> MP4 or PNG."""
    load("stages.render.stage:run")(source, out, options)


@app.command()
@with_options
def evaluate(
    *,
    prediction: Annotated[
        list[Path],
        Argument(
            metavar="PREDICTION",
            help=".h5, .ply, .mp4 or a folder of PNGs to evaluate; with --judge: one or more films or folders of films",
            show_default=False,
        ),
    ],
    against: Annotated[
        Path | None,
        Option(
            "--against",
            help="ground truth, of the same kind as PREDICTION; for a .ply also a folder of label "
            "images named like the photos of the scene, with a names.json",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None, Option("-o", "--out", help="JSON file to write; default: metrics.json next to the prediction")
    ] = None,
    options: EvaluateOptions,
    as_json: AsJson = False,
) -> None:
    """Compare a prediction with the ground truth: PREDICTION and TRUTH -> a table and METRICS.json.

    With --judge instead of --against, a vision-language model scores films: the metrics PhysR and PhotoR.
    """
    load("stages.evaluate.stage:run")(prediction, against, out, options, as_json=as_json)


def main() -> None:
    """Run the command in this process's arguments."""
    run_command_line(app)


if __name__ == "__main__":
    main()
