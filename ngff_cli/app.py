"""`ngff`: six commands from photos to video, each reading and writing files; the first three are in scene_commands."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ngff_cli.options import QUALITY_HELP, AsJson, Device, SceneIn, Seed, Threads, new_app, run_command_line, set_up
from ngff_cli.scene_commands import reconstruct, refine, segment
from stages.core.backends import load
from stages.evaluate.options import EvaluateOptions
from stages.render.options import OUTPUT_FORMATS, VIEWS, RenderOptions
from stages.simulate.options import DEFAULT_KEYPOINTS, ENGINE_HELP, LIVE_KEYPOINTS, SimulateOptions

app = new_app()


def _version(wanted: bool) -> None:
    if wanted:
        from stages.core.scene.files import ngff_version

        print(f"ngff {ngff_version()}")
        raise typer.Exit


@app.callback()
def ngff(
    verbose: Annotated[bool, Option("-v", "--verbose", help="log more detail")] = False,
    version: Annotated[bool, Option("--version", callback=_version, is_eager=True, help="print the version")] = False,
    threads: Threads = None,
) -> None:
    """From a folder of photos to a video of a physics simulation of the scene.

    ngff reconstruct photos/ -o scene.ply; ngff simulate scene.ply -o traj.h5; ngff render traj.h5
    """
    set_up(threads, verbose)


for _command in (reconstruct, segment, refine):
    app.command()(_command)


@app.command()
def simulate(
    context: typer.Context,
    scene: SceneIn,
    out: Annotated[Path, Option("-o", "--out", help="trajectory to write (.h5)")] = Path("traj.h5"),
    steps: Annotated[int, Option(help="number of frames, including the initial state")] = SimulateOptions.steps,
    dt: Annotated[float, Option(help="time between frames [s]")] = SimulateOptions.dt,
    engine: Annotated[str, Option(help=ENGINE_HELP)] = SimulateOptions.engine,
    gravity: Annotated[float, Option(help="downward acceleration [m/s^2]")] = SimulateOptions.gravity,
    quality: Annotated[str, Option(help=QUALITY_HELP)] = SimulateOptions.quality,
    material: Annotated[list[str] | None, Option(help="OBJECT=MATERIAL, such as duck=rubber; repeatable")] = None,
    materials: Annotated[
        Path | None, Option(help="JSON: object name or id to a material's name or {E, nu, density, friction}")
    ] = SimulateOptions.materials,
    force: Annotated[
        list[str] | None, Option(help='"object=2 force=0,0,8 from=0.1 to=0.3" [N, s]; also torque= and at=x,y,z')
    ] = None,
    forces: Annotated[
        Path | None,
        Option(
            help="JSON of forces {scene: [{obj_id, start, end, force}]}; or a trajectory (.h5), or "
            "JSON saved by a playable page, whose forces, changes and options are repeated"
        ),
    ] = SimulateOptions.forces,
    pin: Annotated[list[str] | None, Option(help="object held fixed; repeatable")] = None,
    velocity: Annotated[
        list[str] | None, Option(help='initial velocity: "object=1 0,0,2" [scene units/s]; repeatable')
    ] = None,
    lift: Annotated[
        list[str] | None, Option(help="initial lift: HEIGHT for all, or OBJECT=HEIGHT [scene units]; repeatable")
    ] = None,
    floor: Annotated[
        float | None, Option(help="height of the floor [scene units]; default: the scene's")
    ] = SimulateOptions.floor,
    friction: Annotated[
        float | None, Option(help="Coulomb coefficient at floor and walls; default: each material's")
    ] = SimulateOptions.friction,
    box: Annotated[
        str | None, Option(help="floor, walls and ceiling x0,y0,z0,x1,y1,z1 [scene units]; default: only a floor")
    ] = SimulateOptions.box,
    keypoints: Annotated[
        int | None,
        Option(
            help=f"maximum number of keypoints per object; default: {DEFAULT_KEYPOINTS}, with --live {LIVE_KEYPOINTS}"
        ),
    ] = SimulateOptions.keypoints,
    weights: Annotated[
        Path | None,
        Option(
            help="weights of the learned engine (.safetensors with its card, or a published .pth); "
            "default: those in the package"
        ),
    ] = SimulateOptions.weights,
    integrator: Annotated[
        str, Option(help="learned engine: step (the model's own) or an ODE solver: euler | rk4 | dopri5")
    ] = SimulateOptions.integrator,
    contact: Annotated[
        str,
        Option(help="engine ngff: learned, for soft bodies | solved, with the materials' friction and rebound | auto"),
    ] = SimulateOptions.contact,
    rest: Annotated[
        bool,
        Option(
            "--rest/--no-rest",
            help="engines rigid and ngff: hold objects of photos until something acts on them, or let them fall from "
            "where they are, as in photos of a moment",
        ),
    ] = SimulateOptions.rest,
    live: Annotated[
        bool,
        Option(
            "--live",
            help="simulate in real time and open a page to drag, push, lift and pin the objects; "
            "Ctrl-C ends and writes what was recorded",
        ),
    ] = SimulateOptions.live,
    browser: Annotated[
        bool, Option("--browser/--no-browser", help="with --live: open the page, or only print its address")
    ] = SimulateOptions.browser,
    port: Annotated[int, Option(help="with --live: port on 127.0.0.1; 0: any free one")] = SimulateOptions.port,
    seed: Seed = SimulateOptions.seed,
    device: Device = SimulateOptions.device,
) -> None:
    """Simulate the motion of the objects of a scene: SCENE.ply -> TRAJ.h5."""
    options = SimulateOptions(
        steps=steps, dt=dt, engine=engine, gravity=gravity, quality=quality, material=tuple(material or ()),
        materials=materials, force=tuple(force or ()), forces=forces, pin=tuple(pin or ()),
        velocity=tuple(velocity or ()), lift=tuple(lift or ()), floor=floor, friction=friction, box=box,
        keypoints=keypoints, weights=weights, integrator=integrator, contact=contact, rest=rest, live=live,
        browser=browser, port=port, seed=seed, device=device,
    )  # fmt: skip
    given = {name for name in context.params if context.get_parameter_source(name).name == "COMMANDLINE"}
    load("stages.simulate.stage:run")(scene, out, options, given)


@app.command()
def render(
    source: Annotated[
        list[Path],
        Argument(metavar="TRAJ.h5|SCENE.ply", help="file to render; several with --side-by-side", show_default=False),
    ],
    out: Annotated[
        Path | None,
        Option(
            "-o",
            "--out",
            help=f"file to write ({' '.join(OUTPUT_FORMATS)}); default: named after the input and the view",
        ),
    ] = None,
    view: Annotated[str, Option(help=f"camera: {VIEWS}")] = RenderOptions.view,
    resolution: Annotated[int, Option(help="longest side of a view [px]")] = RenderOptions.resolution,
    fps: Annotated[
        float | None,
        Option(help="frames per second, at unchanged speed of motion; default: the trajectory's, 30 for a scene"),
    ] = RenderOptions.fps,
    background: Annotated[
        str | None, Option(help="scene.ply, #rrggbb or a photo that replaces the scene's own background")
    ] = RenderOptions.background,
    depth: Annotated[
        bool, Option("--depth", help="render depth: colour-coded in MP4, 16 bit in PNG")
    ] = RenderOptions.depth,
    ids: Annotated[
        bool, Option("--ids", help="render each object in one flat colour, with its number and a legend")
    ] = RenderOptions.ids,
    shadows: Annotated[str, Option(help="soft shadows of objects that moved: on | off")] = RenderOptions.shadows,
    show_forces: Annotated[
        bool, Option("--show-forces", help="draw an arrow for each active force prompt")
    ] = RenderOptions.show_forces,
    playable: Annotated[
        bool,
        Option(
            "--playable",
            help="with -o film.html: objects can be dragged, pushed and lifted in the page, "
            "which computes their motion (trajectories of --engine ngff --contact learned)",
        ),
    ] = RenderOptions.playable,
    frame: Annotated[
        int | None, Option(help="render this frame only, from 0; -1 is the last; default: all")
    ] = RenderOptions.frame,
    side_by_side: Annotated[
        bool, Option("--side-by-side", help="render several files in one image, with the same camera")
    ] = RenderOptions.side_by_side,
    device: Device = RenderOptions.device,
) -> None:
    """Render a trajectory or a scene: TRAJ.h5 or SCENE.ply -> MP4 or PNG."""
    options = RenderOptions(
        view=view, resolution=resolution, fps=fps, background=background, depth=depth, ids=ids,
        shadows=shadows, show_forces=show_forces, playable=playable, frame=frame, side_by_side=side_by_side,
        device=device,
    )  # fmt: skip
    load("stages.render.stage:run")(source, out, options)


@app.command()
def evaluate(
    prediction: Annotated[
        list[Path],
        Argument(
            metavar="PREDICTION",
            help=".h5, .ply, .mp4 or a folder of PNGs; with --judge one film or several, or folders of films",
            show_default=False,
        ),
    ],
    against: Annotated[
        Path | None,
        Option(
            "--against",
            help="ground truth, of the same kind; for a .ply also a folder of label "
            "images named as its photos, with names.json",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None, Option("-o", "--out", help="JSON file to write; default: metrics.json next to the prediction")
    ] = None,
    align: Annotated[
        bool, Option("--align", help="first align the prediction with the truth, by shared cameras or objects")
    ] = EvaluateOptions.align,
    frames: Annotated[
        int | None, Option(help="compare the first N frames only; default: all, equal in number")
    ] = EvaluateOptions.frames,
    resample: Annotated[
        bool, Option("--resample", help="interpolate the predicted motion at the frame times of the truth")
    ] = EvaluateOptions.resample,
    objects: Annotated[
        str, Option(help="names of the objects to compare, such as duck,ball; default: all")
    ] = EvaluateOptions.objects,
    undistorted: Annotated[
        bool, Option("--undistorted", help="label images are of undistorted views; default: of the photos as taken")
    ] = EvaluateOptions.undistorted,
    photos: Annotated[
        Path | None, Option(help="folder of the photos, for the report of a trajectory or of label images")
    ] = EvaluateOptions.photos,
    report: Annotated[
        Path | None, Option(help="HTML report with curves and images to write (.html)")
    ] = EvaluateOptions.report,
    judge: Annotated[
        bool,
        Option(
            "--judge",
            help="score films from 0 to 1 by a vision-language model: PhysR and PhotoR. Sends ten "
            "frames of each film (JPEG, at most 512 px) and nothing else, no names, to $OPENAI_BASE_URL with "
            "$OPENAI_API_KEY; without --judge nothing is sent anywhere",
        ),
    ] = EvaluateOptions.judge,
    model: Annotated[
        str, Option(help="with --judge: name of a model that accepts images; default: $OPENAI_MODEL")
    ] = EvaluateOptions.model,
    base_url: Annotated[
        str,
        Option(
            help="with --judge: address of a server with OpenAI's protocol; default: $OPENAI_BASE_URL, else "
            "OpenAI's own"
        ),
    ] = EvaluateOptions.base_url,
    repeats: Annotated[
        int, Option(help="with --judge: how often each film is scored; mean and standard deviation are given")
    ] = EvaluateOptions.repeats,
    films_per_question: Annotated[
        int, Option(help="with --judge: most films in one question, in random order under letters")
    ] = EvaluateOptions.films_per_question,
    timeout: Annotated[
        float, Option(help="with --judge: maximum waiting time for an answer [s]")
    ] = EvaluateOptions.timeout,
    resume: Annotated[
        bool, Option("--resume", help="with --judge: continue an interrupted run, from the answers it has written")
    ] = EvaluateOptions.resume,
    seed: Annotated[int, Option(help="with --judge: random seed of the order of the films")] = EvaluateOptions.seed,
    as_json: AsJson = False,
) -> None:
    """Compare a prediction with the ground truth: PREDICTION and TRUTH -> a table and METRICS.json.

    With --judge and without a truth: films -> PhysR and PhotoR, as rated by a vision-language model.
    """
    options = EvaluateOptions(
        align=align, frames=frames, resample=resample, objects=objects, undistorted=undistorted, photos=photos,
        report=report, judge=judge, model=model, base_url=base_url, repeats=repeats,
        films_per_question=films_per_question, timeout=timeout, resume=resume, seed=seed,
    )  # fmt: skip
    load("stages.evaluate.stage:run")(prediction, against, out, options, as_json=as_json)


def main() -> None:
    """Entry point of the script `ngff`."""
    run_command_line(app)


if __name__ == "__main__":
    main()
