"""Commands of `ngff` that make and change scenes: reconstruct, segment, refine."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option
from typer.models import OptionInfo

from ngff_cli.options import QUALITY_HELP, Device, SceneIn, Seed
from stages.core.backends import describe, load
from stages.reconstruct.options import BACKENDS as RECONSTRUCT
from stages.reconstruct.options import FEATURE_EXTRACTORS as MATCHERS
from stages.reconstruct.options import SYNCHRONISATIONS, ReconstructOptions
from stages.refine.options import BACKENDS as REFINE
from stages.refine.options import GENERATORS, UPSCALERS, RefineOptions
from stages.refine.options import MATCHERS as REFINE_MATCHERS
from stages.segment.options import BACKENDS as SEGMENT
from stages.segment.options import NETWORKS, SegmentOptions


def photos_option(backends: str) -> OptionInfo:
    """The option --photos of a command, of which these backends read photos."""
    return Option(help=f"for {backends}: folder of the scene's photos; default: rendered images")


def download_option(backends: str) -> OptionInfo:
    """The option --download of a command, of which these backends have published weights."""
    return Option("--download", help=f"for {backends}: download missing weights, after logging size and licence")


def reconstruct(
    imgs: Annotated[
        Path,
        Argument(
            metavar="PHOTOS", help="folder of photos, or a video; with --sequence a folder of films", show_default=False
        ),
    ],
    out: Annotated[Path, Option("-o", "--out", help="scene to write (.ply)")] = Path("scene.ply"),
    sequence: Annotated[
        bool,
        Option(
            "--sequence",
            help="PHOTOS has a video, or a folder of frames, for each of several fixed cameras: "
            "reconstruct the moment at which the objects are released",
        ),
    ] = ReconstructOptions.sequence,
    sync: Annotated[
        str, Option(help="with --sequence, how films are aligned in time: " + " | ".join(SYNCHRONISATIONS))
    ] = ReconstructOptions.sync,
    offsets: Annotated[
        str,
        Option(help='with --sequence, in place of --sync: the frame of each film at one moment, "A.mp4=0,B.mp4=3.33"'),
    ] = ReconstructOptions.offsets,
    fps: Annotated[
        float, Option(help="with --sequence: frames a second of folders of frames")
    ] = ReconstructOptions.fps,
    backend: Annotated[str, Option(help=" | ".join(RECONSTRUCT))] = ReconstructOptions.backend,
    matcher: Annotated[
        str,
        Option(
            help="features matched between photos: " + " | ".join(MATCHERS) + "; the learned ones match photos "
            "with little overlap"
        ),
    ] = ReconstructOptions.matcher,
    cameras: Annotated[
        Path | None, Option(help="known cameras: transforms.json or a COLMAP model folder; default: estimated")
    ] = ReconstructOptions.cameras,
    holdout: Annotated[
        int, Option(help="hold out every N-th photo and report PSNR and SSIM on it; 0: none")
    ] = ReconstructOptions.holdout,
    quality: Annotated[str, Option(help=QUALITY_HELP)] = ReconstructOptions.quality,
    resolution: Annotated[
        int | None, Option(help="longest side to which photos are resized [px]; default: set by --quality")
    ] = ReconstructOptions.resolution,
    up: Annotated[
        str, Option(help="side of the photos that is up: auto (by the table or floor) | top | right | bottom | left")
    ] = ReconstructOptions.up,
    scale_reference: Annotated[
        str,
        Option(
            help='a known length [m]: "photos=A.jpg,B.jpg distance=0.5" between two cameras, or "distance=0.6" '
            "from the cameras to the point they look at"
        ),
    ] = ReconstructOptions.scale_reference,
    resume: Annotated[
        bool, Option("--resume", help="continue an interrupted run after its last finished step")
    ] = ReconstructOptions.resume,
    weights: Annotated[
        Path | None,
        Option(
            help="weights of pi3 or pi3-splat (.safetensors, .pth); default: searched in $NGFF_WEIGHTS "
            "and ~/.cache/ngff"
        ),
    ] = ReconstructOptions.weights,
    download: Annotated[
        bool, Option("--download", help="download missing weights (CC BY-NC; needs the extra hub)")
    ] = ReconstructOptions.download,
    iterations: Annotated[
        int | None, Option(help="photometric optimisation steps, 0 for none; default: set by --quality")
    ] = ReconstructOptions.iterations,
    seed: Seed = ReconstructOptions.seed,
    device: Device = ReconstructOptions.device,
) -> None:
    """Reconstruct a scene of 3D Gaussians from photos: PHOTOS -> SCENE.ply.

    Cameras are estimated from the photos unless given; the scene is rotated upright with its floor at z = 0.
    """
    options = ReconstructOptions(
        sequence=sequence, sync=sync, offsets=offsets, fps=fps, backend=backend, matcher=matcher, cameras=cameras,
        holdout=holdout, quality=quality, resolution=resolution, up=up, scale_reference=scale_reference,
        resume=resume, weights=weights, download=download, iterations=iterations, seed=seed, device=device,
    )  # fmt: skip
    load("stages.reconstruct.stage:run")(imgs, out, options)


def segment(
    scene: SceneIn,
    out: Annotated[Path, Option("-o", "--out", help="labelled scene to write (.ply)")] = Path("labelled.ply"),
    backend: Annotated[str, Option(help=describe(SEGMENT))] = SegmentOptions.backend,
    masks: Annotated[
        Path | None,
        Option(
            help="folder of label images named as the photos: 0 background, 1... objects; 255 is "
            "ignored where its names.json does not name it"
        ),
    ] = SegmentOptions.masks,
    boxes: Annotated[
        Path | None, Option(help=f"prompts.json: boxes in the first photo [px] and names; for {NETWORKS} also points")
    ] = SegmentOptions.boxes,
    points: Annotated[
        list[str] | None,
        Option(
            help='a point on an object in a photo [px]: "view=IMG.jpg xy=310,220 name=duck"; '
            "repeatable; points of one name are on one object"
        ),
    ] = None,
    photos: Annotated[Path | None, photos_option(NETWORKS)] = SegmentOptions.photos,
    undistorted: Annotated[
        bool,
        Option(
            "--undistorted", help="masks, boxes and photos are of undistorted views; default: of the photos as taken"
        ),
    ] = SegmentOptions.undistorted,
    weights: Annotated[
        Path | None,
        Option(
            help=f"for {NETWORKS}: file or folder of its weights; default: the folder of its name in "
            "$NGFF_WEIGHTS and ~/.cache/ngff; for learned: segmenter.safetensors, by default ours"
        ),
    ] = SegmentOptions.weights,
    download: Annotated[bool, download_option(NETWORKS)] = SegmentOptions.download,
    names: Annotated[str, Option(help='object names: "1=duck,2=bowl"')] = SegmentOptions.names,
    max_objects: Annotated[int, Option(help="maximum number of objects")] = SegmentOptions.max_objects,
    min_size: Annotated[
        float, Option(help="ignore objects whose longest side is below this fraction of the camera distance")
    ] = SegmentOptions.min_size,
    detail: Annotated[
        float, Option(help="backend geometric: merge threshold of regions, 0 to 2; lower values give more objects")
    ] = SegmentOptions.detail,
    scale_reference: Annotated[
        str, Option(help='a length measured on an object [m]: "object=1 height=0.12" (or length=)')
    ] = SegmentOptions.scale_reference,
    seed: Seed = SegmentOptions.seed,
    device: Device = SegmentOptions.device,
) -> None:
    """Label the Gaussians of each object: SCENE.ply -> LABELLED.ply (object_id: 0 background, 1... objects)."""
    options = SegmentOptions(
        backend=backend, masks=masks, boxes=boxes, points=tuple(points or ()), photos=photos, undistorted=undistorted,
        weights=weights, download=download, names=names, max_objects=max_objects, min_size=min_size, detail=detail,
        scale_reference=scale_reference, seed=seed, device=device,
    )  # fmt: skip
    load("stages.segment.stage:run")(scene, out, options)


def refine(
    scene: SceneIn,
    out: Annotated[Path, Option("-o", "--out", help="refined scene to write (.ply)")] = Path("refined.ply"),
    completer: Annotated[str, Option(help=describe(REFINE))] = RefineOptions.completer,
    library: Annotated[
        Path | None, Option(help="folder of complete objects (.ply); the best match replaces a partial object")
    ] = RefineOptions.library,
    photos: Annotated[Path | None, photos_option(GENERATORS)] = RefineOptions.photos,
    weights: Annotated[
        Path | None, Option(help=f"for {GENERATORS}: folder of its weights; default: searched in $NGFF_WEIGHTS")
    ] = RefineOptions.weights,
    download: Annotated[bool, download_option(GENERATORS)] = RefineOptions.download,
    upscale: Annotated[
        str, Option(help=f"for {GENERATORS}, super-resolution of the object's image; {describe(UPSCALERS)}")
    ] = RefineOptions.upscale,
    matcher: Annotated[
        str, Option(help=f"to register whole objects, by a photo and renderings: {' | '.join(REFINE_MATCHERS)}")
    ] = RefineOptions.matcher,
    keep_raw: Annotated[
        bool, Option("--keep-raw", help="also keep the K objects unrefined, with ids K+1 to 2K")
    ] = RefineOptions.keep_raw,
    outliers: Annotated[
        float, Option(help="outlier threshold [robust standard deviations]; 0 keeps all Gaussians")
    ] = RefineOptions.outliers,
    background: Annotated[bool, Option(help="fill the table under and behind objects")] = RefineOptions.background,
    resolution: Annotated[
        int, Option(help="voxels along an object's longest side when unseen surfaces are closed")
    ] = RefineOptions.resolution,
    seed: Seed = RefineOptions.seed,
    device: Device = RefineOptions.device,
) -> None:
    """Complete the objects and fill the table beneath them: LABELLED.ply -> REFINED.ply."""
    options = RefineOptions(
        completer=completer, library=library, photos=photos, weights=weights, download=download, upscale=upscale,
        matcher=matcher, keep_raw=keep_raw, outliers=outliers, background=background, resolution=resolution, seed=seed,
        device=device,
    )  # fmt: skip
    load("stages.refine.stage:run")(scene, out, options)
