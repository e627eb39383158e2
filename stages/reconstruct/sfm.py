"""Structure from motion: photos -> cameras and sparse points, by COLMAP's incremental mapper.

Results are reproducible for a seed on the same machine: feature extraction and matching are deterministic, RANSAC is
seeded, and verification and mapping run on one thread, since the order of floating-point sums depends on scheduling.
Self-calibration of few photos may converge to a wrong focal length. If a focal length is unknown, the photos are mapped
from two initial values, and the better model is kept.
Source: Schönberger and Frahm 2016, "Structure-from-motion revisited".
"""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import Popen
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError, MissingPackage
from stages.core.scene.cameras import Cameras, LensDistortion
from stages.reconstruct import features, matching
from stages.reconstruct.colmap import SecondProcess, colmap_process, import_pycolmap, run_colmap, second_process
from stages.reconstruct.epipolar import EpipolarLines
from stages.reconstruct.matching import FOCAL_STARTS, MatchedPair, MatchingOptions
from stages.reconstruct.photos import Photos
from stages.reconstruct.step_cache import StepCache

log = logging.getLogger(__name__)
MIN_FITTING = 0.2  # smallest fraction of the matches that given cameras must explain
MIN_IMAGE_MOTION = 0.005  # smallest median displacement of matches of a moving camera [photo size]
MIN_POINTS = 30, 15  # points of the model that a photo must show to be added; the second if the first leaves out most
MAX_MAPPED_TWICE = 40  # most photos that are mapped twice; another mapping of 50 photos takes half a minute
CAPTURE_ADVICE = "take 10 or more sharp photos, each showing at least two thirds of what the one before it shows"


@dataclass(frozen=True)
class SparseModel:
    """Registered cameras, m sparse points, and k observations of points by cameras."""

    cameras: Cameras
    lenses: LensDistortion
    points: Float[Tensor, "m 3"]
    point_index: Int[Tensor, "k"]  # row of `points` of each observation
    view_index: Int[Tensor, "k"]  # row of `cameras` of each observation
    dropped: dict[str, str] = field(default_factory=dict)  # photos left out -> reason


@colmap_process()
def estimate_cameras(
    photos: Photos,
    options: MatchingOptions = MatchingOptions(),  # noqa: B008 -- frozen
    steps: StepCache | None = None,
) -> SparseModel:
    """Estimate cameras and sparse points, for as many photos as can be registered.

    Raises InputError, with advice, if the photos do not match, the camera is stationary, or mapping fails; and
    MissingPackage without pycolmap.
    """
    steps = steps or StepCache()
    _load_pycolmap(options.seed)
    types = (SparseModel, Cameras, LensDistortion)
    once = all(photos.focals) or len(photos) > MAX_MAPPED_TWICE
    with nullcontext() if once else second_process() as second:  # starts during the matching
        database = matching.build_database(photos, matching.initial_cameras(photos), steps, options)
        return steps.cached("model", lambda: _run_mapper(photos, database, options.seed, second), types)


def _run_mapper(photos: Photos, database: Path, seed: int, second: SecondProcess | None) -> SparseModel:
    """The best model that COLMAP maps from the database; a second process maps it from another focal length."""
    pairs = matching.verified_pairs(database)
    if not pairs:
        raise InputError(f"{photos.source}: no two photos show the same objects clearly enough; {CAPTURE_ADVICE}")
    if _is_stationary(pairs, photos):
        raise InputError(
            f"{photos.source}: the camera hardly moved between the photos; walk around the objects, or, if they are "
            "on a turntable, put it in front of a plain backdrop, so that only features on the objects are matched"
        )
    found = []
    for min_points in MIN_POINTS:
        for models in _mapped_from_starts(photos, database, seed, min_points, second):
            best = max(models, key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)
            if best is not None and best.num_reg_images() >= 2 and best.num_points3D() >= 50:
                found.append((best, models))
        if any(2 * best.num_reg_images() > len(photos) for best, _ in found):
            break
    if not found:
        matches = float(np.median([len(a) for _, _, a, _ in pairs]))
        raise InputError(f"{photos.source}: {_failure_reason(len(photos), len(pairs), matches)}")
    best, models = max(found, key=lambda one: _quality(one[0]))
    model = _from_colmap(best, _drop_reasons(photos, pairs, best, models))
    log.info(
        "cameras of %d of %d photos, %d points, mean reprojection error %.2f px",
        len(model.cameras), len(photos), len(model.points), best.compute_mean_reprojection_error(),
    )  # fmt: skip
    return model


def _quality(model) -> tuple[int, float]:
    """Sort key of models: number of photos, then the mean reprojection error.

    The number of points is not used: with a wrong focal length there are more points, as tracks break.
    """
    return model.num_reg_images(), -model.compute_mean_reprojection_error()


def _mapped_from_starts(
    photos: Photos, database: Path, seed: int, min_points: int, second: SecondProcess | None
) -> list[list]:
    """Models mapped from the first of FOCAL_STARTS and, in parallel in a second process, from the second one."""
    starts = FOCAL_STARTS if second else FOCAL_STARTS[:1]
    with (
        tempfile.TemporaryDirectory() as folder,
        tqdm(total=len(starts) * len(photos), desc="placing photos", unit="photo", leave=False) as bar,
    ):
        copies = [Path(folder) / f"{k}.db" for k in range(len(starts))]
        for copy, factor in zip(copies, starts, strict=True):
            shutil.copyfile(database, copy)
            matching.set_unknown_focals(copy, factor)
        args = seed, min_points, bar.update
        beside = [second.thread.submit(_mapped, photos, copy, *args, second.process) for copy in copies[1:]]
        return [_mapped(photos, copies[0], *args), *(run.result() for run in beside)]


def _mapped(
    photos: Photos, database: Path, seed: int, min_points: int, progress: Callable, process: Popen | None = None
) -> list:
    """Run COLMAP's incremental mapper; returns a pycolmap model for each connected set of photos."""
    import pycolmap

    with tempfile.TemporaryDirectory() as folder:
        with features.writing_database(Path(folder)):
            run_colmap(
                "map", folder, progress, process, database=str(database), photos=len(photos), seed=seed,
                min_points=min_points,
            )  # fmt: skip
        return [pycolmap.Reconstruction(path) for path in sorted(Path(folder).iterdir())]


def _failure_reason(photos: int, pairs: int, matches: float) -> str:
    """The likely reason why mapping failed: little overlap, little detail, or wrong matches.

    `pairs` is the number of matching pairs of photos, `matches` the median number of matches of a pair.
    """
    known = "or give known cameras (--cameras)"
    if pairs < 2 * photos:
        return f"the photos overlap too little to find where they were taken from; {CAPTURE_ADVICE}, {known}"
    if matches < MIN_POINTS[0]:
        return (
            f"{pairs} pairs of photos match, but half of them at {matches:.0f} points or fewer: put patterned, matt "
            f"things (newspaper, a cloth) under and around the objects, use more light, and take more photos, {known}"
        )
    return (
        f"{pairs} pairs of photos match, but no camera positions explain the matches; if a pattern repeats "
        "(tiles, a checked cloth), its parts are confused: cover it, for instance with newspaper; if the cameras "
        "are far "
        "apart, as in a set of few films, give known cameras (--cameras)"
    )


def _is_stationary(pairs: list[MatchedPair], photos: Photos) -> bool:
    """Whether the matches of most pairs have the same position in both photos."""
    moved = [np.median(np.linalg.norm(a - b, axis=1)) / max(photos.size(i)) for i, j, a, b in pairs]
    return float(np.median(moved)) < MIN_IMAGE_MOTION


def _drop_reasons(photos: Photos, pairs: list[MatchedPair], best, models: list) -> dict[str, str]:
    """The likely reason for each photo that is not in the best model."""
    placed = {best.images[i].name for i in best.reg_image_ids()}
    others = [{m.images[i].name for i in m.reg_image_ids()} for m in models if m is not best]
    common = np.zeros((len(photos), len(photos)), int)
    for i, j, a, _ in pairs:
        common[i, j] = common[j, i] = len(a)
    inside = [i for i, name in enumerate(photos.names) if name in placed]
    reasons = {}
    for i, name in enumerate(photos.names):
        if name in placed:
            continue
        matches = int(common[i, inside].max())
        others_in_group = next((group - placed for group in others if name in group), set())
        if len(others_in_group) > 1:
            reasons[name] = f"is one of {len(others_in_group)} photos that match each other but not the rest"
        elif matches == 0:
            reasons[name] = "shows nothing that matches the other photos, or is blurred, dark or plain"
        else:
            reasons[name] = f"has at most {matches} points in common with any placed photo, too few or nearly collinear"
    return reasons


@colmap_process()
def triangulate(
    photos: Photos, cameras: Cameras, lenses: LensDistortion,
    options: MatchingOptions = MatchingOptions(), steps: StepCache | None = None,  # noqa: B008 -- frozen
) -> SparseModel:  # fmt: skip
    """Triangulate sparse points with known cameras, in the order of the photos and with K in their pixels.

    Raises InputError if the cameras do not fit the photos or the photos overlap too little.
    """
    steps = steps or StepCache()
    pycolmap = _load_pycolmap(options.seed)
    known = []
    for i in range(len(photos)):
        K, k = cameras.Ks[i].tolist(), lenses.coefficients[i].tolist()
        width, height = photos.size(i)
        params = [K[0][0], K[1][1], K[0][2], K[1][2], *k[:4], k[4], 0, 0, 0]
        known.append(pycolmap.Camera(model="FULL_OPENCV", width=width, height=height, params=params, camera_id=i + 1))
    database = matching.build_database(photos, known, steps, options, cameras.viewmats)
    pairs = matching.all_pairs(database)
    if not pairs:
        raise InputError(f"{photos.source}: no two photos show the same objects clearly enough; {CAPTURE_ADVICE}")
    lines = [EpipolarLines(known[i], known[j], cameras.viewmats[[i, j]], a, b) for i, j, a, b in pairs]
    errors = torch.cat([pair.of_matches() for pair in lines]).numpy()
    fitting = errors < matching.MAX_EPIPOLAR_ERROR * max(photos.size(0))
    if fitting.mean() < MIN_FITTING:
        raise InputError(
            f"{photos.source}: the median reprojection error of the given cameras is {np.median(errors):.0f} px; "
            "check that "
            "they belong to these photos (OpenGL axes and pixels of the stored photos in transforms.json)"
        )
    model = pycolmap.Reconstruction()
    for i, (name, viewmat) in enumerate(zip(photos.names, cameras.viewmats, strict=True)):
        model.add_camera_with_trivial_rig(known[i])
        image = pycolmap.Image(name=name, keypoints=np.zeros((0, 2)), camera_id=i + 1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3].double().numpy()))
    with tempfile.TemporaryDirectory() as folder, steps.timed("model"), features.writing_database(Path(folder)):
        model.write(folder)
        run_colmap("triangulate", folder, database=str(database), photos=len(photos), seed=options.seed)
        done = pycolmap.Reconstruction(folder)
    if done.num_points3D() < 50:
        raise InputError(f"{photos.source}: the photos overlap too little to estimate depth; {CAPTURE_ADVICE}")
    log.info("%d points triangulated with the given cameras, which fit %.0f %% of the matches, with a median "
             "error of %.2f px", done.num_points3D(),
             100 * fitting.mean(), np.median(errors[fitting]))  # fmt: skip
    found = _from_colmap(done)
    return SparseModel(cameras, lenses, found.points, found.point_index, found.view_index)


def _load_pycolmap(seed: int) -> ModuleType:
    """Import pycolmap, silence its log and seed its random numbers. Raises MissingPackage if it is absent."""
    try:
        pycolmap = import_pycolmap()
    except ImportError as error:
        raise MissingPackage("--backend classic needs the package pycolmap, which is not installed; "
                             "`pip install pycolmap`, or use --backend pi3") from error  # fmt: skip
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    pycolmap.set_random_seed(seed)
    return pycolmap


def _from_colmap(model, dropped: dict[str, str] | None = None) -> SparseModel:
    """Convert a COLMAP model to a SparseModel, with photos sorted by name."""
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    row = {image.image_id: i for i, image in enumerate(images)}
    viewmats, Ks, sizes, lenses = [], [], [], []
    for image in images:
        camera = model.cameras[image.camera_id]
        viewmats.append(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))
        Ks.append(camera.calibration_matrix())
        sizes.append([camera.width, camera.height])
        lenses.append([camera.params[3], 0, 0, 0, 0] if camera.model.name == "SIMPLE_RADIAL" else [0.0] * 5)
    points, point_index, view_index = [], [], []
    for _, point in sorted(model.points3D.items()):  # COLMAP's own order depends on how its table was filled
        views = sorted({row[e.image_id] for e in point.track.elements})
        point_index += [len(points)] * len(views)
        view_index += views
        points.append(point.xyz)
    cameras = Cameras(
        torch.from_numpy(np.stack(viewmats)).float(), torch.from_numpy(np.stack(Ks)).float(),
        torch.tensor(sizes), tuple(image.name for image in images),
    )  # fmt: skip
    return SparseModel(
        cameras, LensDistortion(torch.tensor(lenses, dtype=torch.float32)), torch.from_numpy(np.array(points)).float(),
        torch.tensor(point_index), torch.tensor(view_index), dropped or {},
    )  # fmt: skip
