"""`ngff`: six commands from photos to video, each reading and writing files."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ngff_cli.options import Commands, Device, SceneIn, Seed, Threads, limit_threads, set_up_logging
from stages.evaluate.options import EvaluateOptions
from stages.reconstruct.options import BACKENDS as RECONSTRUCT
from stages.reconstruct.options import FEATURE_EXTRACTORS as MATCHERS
from stages.reconstruct.options import QUALITY_PRESETS, ReconstructOptions
from stages.refine.options import BACKENDS as REFINE
from stages.refine.options import RefineOptions
from stages.render.options import VIEWS, RenderOptions
from stages.segment.options import BACKENDS as SEGMENT
from stages.segment.options import SegmentOptions
from stages.simulate.options import SimulateOptions

app = typer.Typer(
    cls=Commands, no_args_is_help=True, rich_markup_mode=None, add_completion=False, pretty_exceptions_enable=False
)
QUALITY_HELP = " | ".join(QUALITY_PRESETS)


def _version(wanted: bool) -> None:
    if wanted:
        from stages.core.scene.files import ngff_version

        print(f"ngff {ngff_version()}")
        raise typer.Exit


@app.callback()
def ngff(
    verbose: Annotated[bool, Option("-v", "--verbose", help="say more about what is done")] = False,
    version: Annotated[bool, Option("--version", callback=_version, is_eager=True, help="print the version")] = False,
    threads: Threads = None,
) -> None:
    """From a folder of photos to a video of what happens next.

    ngff reconstruct photos/ -o scene.ply; ngff simulate scene.ply -o traj.h5; ngff render traj.h5
    """
    set_up_logging(verbose)
    limit_threads(threads)


@app.command()
def reconstruct(
    imgs: Annotated[Path, Argument(metavar="PHOTOS", help="folder of photos, or a video", show_default=False)],
    out: Annotated[Path, Option("-o", "--out", help="scene to write (.ply)")] = Path("scene.ply"),
    backend: Annotated[str, Option(help=" | ".join(RECONSTRUCT))] = ReconstructOptions.backend,
    matcher: Annotated[
        str, Option(help=" | ".join(MATCHERS) + ": how photos are compared; the second finds more in few photos")
    ] = ReconstructOptions.matcher,
    cameras: Annotated[
        Path | None, Option(help="known cameras: transforms.json or a COLMAP model folder")
    ] = ReconstructOptions.cameras,
    holdout: Annotated[
        int, Option(help="keep every N-th photo out and report PSNR and SSIM on it")
    ] = ReconstructOptions.holdout,
    quality: Annotated[str, Option(help=QUALITY_HELP)] = ReconstructOptions.quality,
    resolution: Annotated[
        int | None, Option(help="longest side the photos are worked at [px]")
    ] = ReconstructOptions.resolution,
    scale_reference: Annotated[
        str, Option(help='a length in metres: "photos=A.jpg,B.jpg distance=0.5" between two cameras, or "distance=0.6" '
                         "from the cameras to what they look at")
    ] = ReconstructOptions.scale_reference,
    resume: Annotated[
        bool, Option("--resume", help="go on from the finished steps of a run that was cut off")
    ] = ReconstructOptions.resume,
    weights: Annotated[
        Path | None, Option(help="weights of pi3 or pi3-splat (.safetensors, .pth); by default looked for in "
                            "$NGFF_WEIGHTS and ~/.cache/ngff")
    ] = ReconstructOptions.weights,
    download: Annotated[
        bool, Option("--download", help="fetch those weights if they are not here (CC BY-NC; needs the extra hub)")
    ] = ReconstructOptions.download,
    iterations: Annotated[
        int | None, Option(help="photometric steps, 0 for none; by default the quality's")
    ] = ReconstructOptions.iterations,
    seed: Seed = ReconstructOptions.seed,
    device: Device = ReconstructOptions.device,
) -> None:
    """Gaussians of what photos show: PHOTOS -> SCENE.ply.

    Cameras are found from the photos unless given; the scene is turned upright, its floor at z = 0.
    """
    from stages.reconstruct.stage import run

    run(imgs, out, ReconstructOptions(
        backend, matcher, cameras, holdout, quality, resolution, scale_reference, resume, weights, download, iterations,
        seed, device,
    ))  # fmt: skip


@app.command()
def segment(
    scene: SceneIn,
    out: Annotated[Path, Option("-o", "--out", help="labelled scene to write (.ply)")] = Path("labelled.ply"),
    backend: Annotated[str, Option(help=" | ".join(SEGMENT))] = SegmentOptions.backend,
    masks: Annotated[
        Path | None, Option(help="folder of label images named as the photos (0 background, 1... objects)")
    ] = SegmentOptions.masks,
    boxes: Annotated[
        Path | None, Option(help="prompts.json: boxes in view 0 [px] and names; for sam2 also points")
    ] = SegmentOptions.boxes,
    photos: Annotated[
        Path | None, Option(help="of sam2: folder of the scene's photos, else the scene is drawn from its cameras")
    ] = SegmentOptions.photos,
    weights: Annotated[
        Path | None, Option(help="of sam2: folder with config.json and model.safetensors; by default sam2/ in "
                            "$NGFF_WEIGHTS and ~/.cache/ngff")
    ] = SegmentOptions.weights,
    download: Annotated[
        bool, Option("--download", help="fetch the weights of sam2 if they are not here (0.9 GB, Apache-2.0)")
    ] = SegmentOptions.download,
    names: Annotated[str, Option(help='names of your own: "1=duck,2=bowl"')] = SegmentOptions.names,
    max_objects: Annotated[int, Option(help="most objects to find")] = SegmentOptions.max_objects,
    min_size: Annotated[
        float, Option(help="smallest object, along its longest side [distance of the cameras]")
    ] = SegmentOptions.min_size,
    detail: Annotated[
        float, Option(help="how unlike two regions may be and still be one object; smaller gives more objects")
    ] = SegmentOptions.detail,
    scale_reference: Annotated[
        str, Option(help='a length measured on an object, which gives metres: "object=1 height=0.12" (or length=)')
    ] = SegmentOptions.scale_reference,
    seed: Seed = SegmentOptions.seed,
    device: Device = SegmentOptions.device,
) -> None:
    """Which Gaussians are one object: SCENE.ply -> LABELLED.ply (object_id: 0 background, 1... objects)."""
    from stages.segment.stage import run

    run(scene, out, SegmentOptions(
        backend, masks, boxes, photos, weights, download, names, max_objects, min_size, detail, scale_reference, seed,
        device,
    ))  # fmt: skip


@app.command()
def refine(
    scene: SceneIn,
    out: Annotated[Path, Option("-o", "--out", help="refined scene to write (.ply)")] = Path("refined.ply"),
    completer: Annotated[str, Option(help=" | ".join(REFINE))] = RefineOptions.completer,
    library: Annotated[
        Path | None, Option(help="folder of whole objects (.ply); the one that fits is put in a seen part's place")
    ] = RefineOptions.library,
    photos: Annotated[
        Path | None, Option(help="of diffsplat: folder of the scene's photos, else objects are drawn as Gaussians")
    ] = RefineOptions.photos,
    weights: Annotated[
        Path | None, Option(help="of diffsplat: folder of its weights; by default looked for in $NGFF_WEIGHTS")
    ] = RefineOptions.weights,
    download: Annotated[
        bool, Option("--download", help="of diffsplat: fetch those weights if they are not here (MIT, OpenRAIL-M)")
    ] = RefineOptions.download,
    keep_raw: Annotated[
        bool, Option("--keep-raw", help="of K objects, keep them as they were too: ids K+1 to 2K")
    ] = RefineOptions.keep_raw,
    outliers: Annotated[
        float, Option(help="robust deviations beyond which a Gaussian is a floater; 0 keeps all")
    ] = RefineOptions.outliers,
    background: Annotated[bool, Option(help="fill the table under and behind objects")] = RefineOptions.background,
    resolution: Annotated[
        int, Option(help="cells along an object's longest side when its unseen sides are closed")
    ] = RefineOptions.resolution,
    seed: Seed = RefineOptions.seed,
    device: Device = RefineOptions.device,
) -> None:
    """Whole objects on a whole table: LABELLED.ply -> REFINED.ply."""
    from stages.refine.stage import run

    run(scene, out, RefineOptions(
        completer, library, photos, weights, download, keep_raw, outliers, background, resolution, seed, device,
    ))  # fmt: skip


@app.command()
def simulate(
    scene: SceneIn,
    out: Annotated[Path, Option("-o", "--out", help="trajectory to write (.h5)")] = Path("traj.h5"),
    steps: Annotated[int, Option(help="frames, the first being the start")] = SimulateOptions.steps,
    dt: Annotated[float, Option(help="time between frames [s]")] = SimulateOptions.dt,
    engine: Annotated[
        str, Option(help="ngff: the learned force field, for elastic bodies | mpm: a solver, for any material")
    ] = SimulateOptions.engine,
    gravity: Annotated[float, Option(help="downwards [m/s^2]")] = SimulateOptions.gravity,
    quality: Annotated[str, Option(help=QUALITY_HELP)] = SimulateOptions.quality,
    material: Annotated[list[str] | None, Option(help="OBJECT=MATERIAL, such as duck=rubber; repeatable")] = None,
    materials: Annotated[
        Path | None, Option(help="JSON: object name or id to a material's name or {E, nu, density, friction}")
    ] = SimulateOptions.materials,
    force: Annotated[
        list[str] | None, Option(help='"object=2 force=0,0,8 from=0.1 to=0.3" [N, s]; also torque= and at=x,y,z')
    ] = None,
    forces: Annotated[Path | None, Option(help="JSON of force prompts in the public format")] = SimulateOptions.forces,
    pin: Annotated[list[str] | None, Option(help="object that stays where it is; repeatable")] = None,
    velocity: Annotated[list[str] | None, Option(help='start velocity: "object=1 0,0,2" [units/s]; repeatable')] = None,
    lift: Annotated[list[str] | None, Option(help="HEIGHT for all, or OBJECT=HEIGHT [units]; repeatable")] = None,
    floor: Annotated[float | None, Option(help="height of the floor; by default the scene's")] = SimulateOptions.floor,
    friction: Annotated[
        float | None, Option(help="Coulomb coefficient at floor and walls; by default each material's")
    ] = SimulateOptions.friction,
    box: Annotated[
        str | None, Option(help="floor, walls and ceiling: x0,y0,z0,x1,y1,z1; by default around the objects")
    ] = SimulateOptions.box,
    keypoints: Annotated[int, Option(help="most keypoints an object")] = SimulateOptions.keypoints,
    weights: Annotated[
        Path | None, Option(help="of a learned engine (.safetensors with its card, or a public .pth); by default ours")
    ] = SimulateOptions.weights,
    seed: Seed = SimulateOptions.seed,
    device: Device = SimulateOptions.device,
) -> None:
    """Roll the objects of a scene forward in time: SCENE.ply -> TRAJ.h5."""
    from stages.simulate.stage import run

    lists = [tuple(given or ()) for given in (material, force, pin, velocity, lift)]
    run(scene, out, SimulateOptions(
        steps, dt, engine, gravity, quality, lists[0], materials, lists[1], forces, lists[2], lists[3], lists[4],
        floor, friction, box, keypoints, weights, seed, device,
    ))  # fmt: skip


@app.command()
def render(
    source: Annotated[
        list[Path], Argument(metavar="TRAJ.h5|SCENE.ply", help="what to draw; several with --side-by-side",
                             show_default=False)
    ],
    out: Annotated[
        Path | None, Option("-o", "--out", help=".mp4, .png or .jpg; by default beside the input, and printed")
    ] = None,
    view: Annotated[str, Option(help=VIEWS)] = RenderOptions.view,
    resolution: Annotated[int, Option(help="longest side [px]")] = RenderOptions.resolution,
    fps: Annotated[float | None, Option(help="frames a second; motion keeps its speed")] = RenderOptions.fps,
    background: Annotated[
        str | None, Option(help="scene.ply, #rrggbb or a photo in place of the scene's own")
    ] = RenderOptions.background,
    depth: Annotated[bool, Option("--depth", help="draw depth: colours in MP4, 16 bit in PNG")] = RenderOptions.depth,
    ids: Annotated[bool, Option("--ids", help="draw each object in a flat colour")] = RenderOptions.ids,
    show_forces: Annotated[
        bool, Option("--show-forces", help="arrows where force prompts act")
    ] = RenderOptions.show_forces,
    frame: Annotated[
        int | None, Option(help="stop the motion at this frame; -1 is the last")
    ] = RenderOptions.frame,
    side_by_side: Annotated[
        bool, Option("--side-by-side", help="several files in one picture, with the same camera")
    ] = RenderOptions.side_by_side,
    device: Device = RenderOptions.device,
) -> None:
    """Film a trajectory or a scene: TRAJ.h5 or SCENE.ply -> MP4 or PNG."""
    from stages.render.stage import run

    run(source, out, RenderOptions(
        view, resolution, fps, background, depth, ids, show_forces, frame, side_by_side, device,
    ))  # fmt: skip


@app.command()
def evaluate(
    prediction: Annotated[
        Path, Argument(metavar="PREDICTION", help=".h5, .ply, .mp4 or a folder of PNGs", show_default=False)
    ],
    against: Annotated[Path, Option("--against", help="the truth, of the same kind", show_default=False)],
    out: Annotated[
        Path | None, Option("-o", "--out", help="metrics.json to write; by default beside the prediction")
    ] = None,
    align: Annotated[
        bool, Option("--align", help="bring the prediction into the truth's world first, by shared cameras or objects")
    ] = EvaluateOptions.align,
    frames: Annotated[int | None, Option(help="compare only the first N frames")] = EvaluateOptions.frames,
    resample: Annotated[
        bool, Option("--resample", help="interpolate the predicted motion at the truth's times")
    ] = EvaluateOptions.resample,
    objects: Annotated[str, Option(help="compare only these of the truth: duck,ball")] = EvaluateOptions.objects,
    report: Annotated[
        Path | None, Option(help="also write an HTML page with curves and pictures")
    ] = EvaluateOptions.report,
) -> None:
    """How near a prediction comes to the truth: a table, and METRICS.json."""
    from stages.evaluate.stage import run

    run(prediction, against, out, EvaluateOptions(align, frames, resample, objects, report))


def main() -> None:
    app()
