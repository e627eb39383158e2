"""Structure from motion: photos -> cameras and sparse points, by COLMAP's incremental mapper.

The same seed gives the same result on the same machine: features and matches are free of chance, the
random searches are seeded, and verification and mapping run on one thread, because the order in which
threads finish would change the sums.
"""

from __future__ import annotations

import logging
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.scene.cameras import Cameras, LensDistortion
from stages.reconstruct import matching
from stages.reconstruct.matching import MatchedPair
from stages.reconstruct.photos import Photos
from stages.reconstruct.step_cache import StepCache

log = logging.getLogger(__name__)
MAX_EPIPOLAR_ERROR = 0.006  # share of the photo's width by which given cameras may miss the matches (4 px of 640)
MIN_IMAGE_MOTION = 0.005  # fraction of the photo's width; below it the camera is stationary
CAPTURE_ADVICE = "take 10 or more sharp photos, each showing at least two thirds of what the one before it shows"


@dataclass(frozen=True)
class SparseModel:
    """Registered cameras and the points they share."""

    cameras: Cameras
    lenses: LensDistortion
    points: Float[Tensor, "m 3"]
    point_index: Int[Tensor, "k"]  # observation: this point ...
    view_index: Int[Tensor, "k"]  # ... is seen by this camera
    dropped: dict[str, str] = field(default_factory=dict)  # photos left out, and why


def estimate_cameras(
    photos: Photos, seed: int = 0, device: str = "cpu", steps: StepCache | None = None, matcher: str = "sift"
) -> SparseModel:
    """Cameras of as many photos as can be connected."""
    steps = steps or StepCache()
    _configure_pycolmap(seed)
    database = matching.build_database(photos, matching.initial_cameras(photos), steps, seed, device, matcher)
    return steps.cached("model", lambda: _run_mapper(photos, database, seed), (SparseModel, Cameras, LensDistortion))


def _run_mapper(photos: Photos, database: Path, seed: int) -> SparseModel:
    """The largest model that the verified matches in the database allow."""
    import pycolmap

    pairs = matching.verified_pairs(database)
    if not pairs:
        raise InputError(f"{photos.source}: no two photos show the same things clearly enough; {CAPTURE_ADVICE}")
    if _is_stationary(pairs, photos):
        raise InputError(
            f"{photos.source}: the camera hardly moved between the photos; walk around the things, or, if they turn on "
            "a turntable, put it before a plain backdrop without pattern, so that only the things are matched"
        )
    options = _mapper_options(photos, seed)
    with tempfile.TemporaryDirectory() as folder, tqdm(
        total=len(photos), desc="placing photos", unit="photo", leave=False
    ) as bar:
        models = pycolmap.incremental_mapping(
            database, folder, folder, options,
            initial_image_pair_callback=lambda: bar.update(2), next_image_callback=lambda: bar.update(1),
        )  # fmt: skip
    best = max(models.values(), key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)
    if best is None or best.num_reg_images() < 2 or best.num_points3D() < 50:
        raise InputError(f"{photos.source}: {_failure_reason(len(photos), len(pairs))}")
    model = _from_colmap(best, _drop_reasons(photos, pairs, best, models))
    log.info(
        "placed %d of %d photos, %d points, mean reprojection error %.2f px",
        len(model.cameras), len(photos), len(model.points), best.compute_mean_reprojection_error(),
    )  # fmt: skip
    return model


def _mapper_options(photos: Photos, seed: int):
    """COLMAP's defaults, on one thread, and for very few photos too."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=1, extract_colors=False)
    options.min_model_size = min(3, len(photos))
    options.triangulation.ignore_two_view_tracks = len(photos) > 3  # few photos have no others
    return options


def _failure_reason(photos: int, pairs: int) -> str:
    """Why no cameras were found for photos of which so many pairs match: too few do, or what they match misleads."""
    if pairs < 2 * photos:
        return f"the photos overlap too little to find where they were taken from; {CAPTURE_ADVICE}"
    return (
        f"{pairs} pairs of photos match, but from no places would the camera see all that; where a pattern repeats "
        "(tiles, a checked cloth) each piece is taken for another: cover it, with newspaper for instance"
    )


def _is_stationary(pairs: list[MatchedPair], photos: Photos) -> bool:
    """Whether the matches of most pairs stay where they are in the photo."""
    moved = [np.median(np.linalg.norm(a - b, axis=1)) / max(photos.size(i)) for i, j, a, b in pairs]
    return float(np.median(moved)) < MIN_IMAGE_MOTION


def _drop_reasons(photos: Photos, pairs: list[MatchedPair], best, models: dict) -> dict[str, str]:
    """What is known about why each photo that is not in the best model is not."""
    placed = {best.images[i].name for i in best.reg_image_ids()}
    others = [{m.images[i].name for i in m.reg_image_ids()} for m in models.values() if m is not best]
    common = np.zeros((len(photos), len(photos)), int)
    for i, j, a, _ in pairs:
        common[i, j] = common[j, i] = len(a)
    inside = [i for i, name in enumerate(photos.names) if name in placed]
    why = {}
    for i, name in enumerate(photos.names):
        if name in placed:
            continue
        most = int(common[i, inside].max())
        together = next((group - placed for group in others if name in group), set())
        if len(together) > 1:
            why[name] = f"is one of {len(together)} photos that go with each other but not with the rest"
        elif most == 0:
            why[name] = "shows nothing that was recognised in the other photos, or is blurred, dark or plain"
        else:
            why[name] = f"has at most {most} points in common with any placed photo, too few or too much in line"
    return why


def triangulate(
    photos: Photos, cameras: Cameras, lenses: LensDistortion, seed: int = 0, steps: StepCache | None = None,
    matcher: str = "sift",
) -> SparseModel:
    """Sparse points for cameras that are known; `photos` and `cameras` in the same order, K in their pixels."""
    import pycolmap

    steps = steps or StepCache()
    _configure_pycolmap(seed)
    known = []
    for i in range(len(photos)):
        K, k = cameras.Ks[i].tolist(), lenses.coefficients[i].tolist()
        width, height = photos.size(i)
        params = [K[0][0], K[1][1], K[0][2], K[1][2], *k[:4], k[4], 0, 0, 0]
        known.append(pycolmap.Camera(model="FULL_OPENCV", width=width, height=height, params=params, camera_id=i + 1))
    database = matching.build_database(photos, known, steps, seed, "cpu", matcher)
    pairs = matching.verified_pairs(database)
    if not pairs:
        raise InputError(f"{photos.source}: no two photos show the same things clearly enough; {CAPTURE_ADVICE}")
    error = epipolar_error(cameras, known, pairs)
    if error > MAX_EPIPOLAR_ERROR * max(photos.size(0)):
        raise InputError(
            f"{photos.source}: the given cameras are {error:.0f} px off what the photos show; check that they "
            "belong to these photos (OpenGL axes and pixels of the stored photos in transforms.json)"
        )
    model = pycolmap.Reconstruction()
    for i, (name, viewmat) in enumerate(zip(photos.names, cameras.viewmats, strict=True)):
        model.add_camera_with_trivial_rig(known[i])
        image = pycolmap.Image(name=name, keypoints=np.zeros((0, 2)), camera_id=i + 1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3].double().numpy()))
    options = _mapper_options(photos, seed)
    with tempfile.TemporaryDirectory() as folder, steps.timed("model"):
        done = pycolmap.triangulate_points(model, database, folder, folder, options=options)
    if done.num_points3D() < 50:
        raise InputError(f"{photos.source}: the photos overlap too little to find depth; {CAPTURE_ADVICE}")
    log.info("%d points found with the given cameras, which fit the photos to %.2f px", done.num_points3D(), error)
    found = _from_colmap(done)
    return SparseModel(cameras, lenses, found.points, found.point_index, found.view_index)


def epipolar_error(cameras: Cameras, models: list, pairs: list[MatchedPair]) -> float:
    """Median distance of matches from where the cameras' relative pose allows them [px] (Sampson's first order)."""
    errors = []
    for i, j, a, b in pairs:
        a, b = _rays(models[i], a), _rays(models[j], b)
        motion = (cameras.viewmats[j].double() @ torch.linalg.inv(cameras.viewmats[i].double())).numpy()
        E = np.cross(motion[:3, 3], motion[:3, :3], axisb=0, axisc=0)
        line_b, line_a = a @ E.T, b @ E
        slope = np.sqrt((line_b[:, :2] ** 2).sum(1) + (line_a[:, :2] ** 2).sum(1))
        errors.append(np.abs((b * line_b).sum(1)) / slope.clip(1e-12) * models[i].mean_focal_length())
    return float(np.median(np.concatenate(errors)))


def _rays(camera, pixels: np.ndarray) -> np.ndarray:
    """Undistorted directions (k, 3), z = 1, of pixels (k, 2)."""
    return np.pad(np.asarray(camera.cam_from_img(pixels.astype(np.float64))), ((0, 0), (0, 1)), constant_values=1)


def _configure_pycolmap(seed: int) -> None:
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    pycolmap.set_random_seed(seed)


def _from_colmap(model, dropped: dict[str, str] | None = None) -> SparseModel:
    """Ours from COLMAP's objects, photos in order of name."""
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
    for point in model.points3D.values():
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
