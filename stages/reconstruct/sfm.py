"""Structure from motion: photos -> cameras and sparse points, by COLMAP's incremental mapper.

The same seed gives the same result on the same machine: features and matches are free of chance, the
random searches are seeded, and verification and mapping run on one thread, because the order in which
threads finish would change the sums.
"""

from __future__ import annotations

import logging
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm import tqdm

from stages.errors import InputError
from stages.reconstruct import features
from stages.reconstruct.photos import Photos
from stages.scene.cameras import Cameras, Lenses

log = logging.getLogger(__name__)
MISFIT = 0.006  # share of the photo's width by which given cameras may miss the matches (4 px of 640)
Pair = tuple[int, int, np.ndarray, np.ndarray]  # two photos and the pixels (k, 2) in each that match
ADVICE = "take 10 or more sharp photos, each showing at least two thirds of what the one before it shows"


@dataclass(frozen=True)
class SparseModel:
    """Registered cameras and the points they share."""

    cameras: Cameras
    lenses: Lenses
    points: Float[Tensor, "m 3"]
    seen_point: Int[Tensor, "k"]  # observation: this point ...
    seen_view: Int[Tensor, "k"]  # ... is seen by this camera


def solve(photos: Photos, seed: int = 0, device: str = "cpu") -> SparseModel:
    """Cameras of as many photos as can be connected."""
    import pycolmap

    _quiet(seed)
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        matched = _fill(database, photos, _guessed_cameras(photos), seed, device)
        if not matched:
            raise InputError(f"{photos.source}: no two photos show the same things clearly enough; {ADVICE}")
        options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=1, extract_colors=False)
        options.min_model_size = min(3, len(photos))
        options.multiple_models = True
        with tqdm(total=len(photos), desc="placing photos", unit="photo", leave=False) as bar:
            models = pycolmap.incremental_mapping(
                database, folder, folder, options,
                initial_image_pair_callback=lambda: bar.update(2), next_image_callback=lambda: bar.update(1),
            )  # fmt: skip
    best = max(models.values(), key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)
    if best is None or best.num_reg_images() < 2 or best.num_points3D() < 50:
        raise InputError(f"{photos.source}: the photos overlap too little to find where they were taken from; {ADVICE}")
    model = _from_colmap(best)
    missing = sorted(set(photos.names) - set(model.cameras.names))
    log.info(
        "placed %d of %d photos, %d points, mean reprojection error %.2f px",
        len(model.cameras), len(photos), len(model.points), best.compute_mean_reprojection_error(),
    )  # fmt: skip
    if missing:
        log.info("not placed, and left out: %s", ", ".join(missing))
    return model


def triangulate(photos: Photos, cameras: Cameras, lenses: Lenses, seed: int = 0) -> SparseModel:
    """Sparse points for cameras that are known; `photos` and `cameras` in the same order, K in their pixels."""
    import pycolmap

    _quiet(seed)
    known = []
    for i in range(len(photos)):
        K, k = cameras.Ks[i].tolist(), lenses.coefficients[i].tolist()
        width, height = photos.size(i)
        params = [K[0][0], K[1][1], K[0][2], K[1][2], *k[:4], k[4], 0, 0, 0]
        known.append(pycolmap.Camera(model="FULL_OPENCV", width=width, height=height, params=params, camera_id=i + 1))
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        pairs = _fill(database, photos, known, seed, "cpu")
        if not pairs:
            raise InputError(f"{photos.source}: no two photos show the same things clearly enough; {ADVICE}")
        error = epipolar_error(cameras, known, pairs)
        if error > MISFIT * max(photos.size(0)):
            raise InputError(
                f"{photos.source}: the given cameras are {error:.0f} px off what the photos show; check that they "
                "belong to these photos (OpenGL axes and pixels of the stored photos in transforms.json)"
            )
        model = pycolmap.Reconstruction()
        for i, (name, viewmat) in enumerate(zip(photos.names, cameras.viewmats, strict=True)):
            model.add_camera_with_trivial_rig(known[i])
            image = pycolmap.Image(name=name, keypoints=np.zeros((0, 2)), camera_id=i + 1, image_id=i + 1)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3].double().numpy()))
        options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=1, extract_colors=False)
        done = pycolmap.triangulate_points(model, database, folder, folder, options=options)
    if done.num_points3D() < 50:
        raise InputError(f"{photos.source}: the photos overlap too little to find depth; {ADVICE}")
    log.info("%d points found with the given cameras, which fit the photos to %.2f px", done.num_points3D(), error)
    found = _from_colmap(done)
    return SparseModel(cameras, lenses, found.points, found.seen_point, found.seen_view)


def epipolar_error(cameras: Cameras, models: list, pairs: list[Pair]) -> float:
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


def _quiet(seed: int) -> None:
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    pycolmap.set_random_seed(seed)


def _guessed_cameras(photos: Photos) -> list:
    """One camera for all photos of a size: the median EXIF focal length, else 1.2 times the longer side.

    The k1 of SIMPLE_RADIAL is enough for phones and cameras; one shared camera holds weak geometry together.
    """
    import pycolmap

    groups: dict[tuple[int, int], list[float]] = {}
    for i in range(len(photos)):
        groups.setdefault(photos.size(i), []).append(photos.focals[i])
    cameras = {}
    for k, (size, focals) in enumerate(groups.items()):
        known = [f for f in focals if f > 0]
        focal = float(np.median(known)) if known else 1.2 * max(size)
        cameras[size] = pycolmap.Camera(
            model="SIMPLE_RADIAL", width=size[0], height=size[1],
            params=[focal, size[0] / 2, size[1] / 2, 0.0], camera_id=k + 1,
        )  # fmt: skip
        cameras[size].has_prior_focal_length = bool(known)
    return [cameras[photos.size(i)] for i in range(len(photos))]


def _fill(path: Path, photos: Photos, cameras: list, seed: int, device: str) -> list[Pair]:
    """A COLMAP database with features and verified matches, and the pairs that have enough of them."""
    import pycolmap

    found = features.extract(photos, device)
    database = pycolmap.Database.open(path)
    for camera in {c.camera_id: c for c in cameras}.values():
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=camera.camera_id)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for i, (name, camera) in enumerate(zip(photos.names, cameras, strict=True)):
        image = pycolmap.Image(name=name, keypoints=np.zeros((0, 2)), camera_id=camera.camera_id, image_id=i + 1)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame(frame_id=i + 1, rig_id=camera.camera_id)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
        database.write_keypoints(i + 1, found[i][0])
    connected = []
    for i, j, matches, geometry in _compare(found, cameras, seed):
        database.write_matches(i + 1, j + 1, matches)
        database.write_two_view_geometry(i + 1, j + 1, geometry)
        inlier = np.asarray(geometry.inlier_matches)
        if len(inlier):
            connected.append((i, j, found[i][0][inlier[:, 0], :2], found[j][0][inlier[:, 1], :2]))
    database.close()
    return connected


def _compare(found: list[features.Feature], cameras: list, seed: int) -> list[tuple]:
    """Matches and two-view geometry of all pairs worth comparing, verified in the background while more are matched."""
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    options.ransac.max_num_trials = 3000  # a pair that needs more shares too little to be of use
    pixels = [table[:, :2].astype(np.float64) for table, _ in found]

    def verify(i: int, j: int, matches: np.ndarray) -> tuple:
        geometry = pycolmap.estimate_two_view_geometry(cameras[i], pixels[i], cameras[j], pixels[j], matches, options)
        return i, j, matches, geometry

    pending = []
    with ThreadPoolExecutor(1) as background:
        for i, j in tqdm(features.pairs(found), desc="matching photos", unit="pair", leave=False):
            matches = features.match(found[i][1], found[j][1]).numpy().astype(np.uint32)
            if len(matches) >= options.min_num_inliers:
                pending.append(background.submit(verify, i, j, matches))
        return [job.result() for job in pending]


def _from_colmap(model) -> SparseModel:
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
    points, seen_point, seen_view = [], [], []
    for point in model.points3D.values():
        views = sorted({row[e.image_id] for e in point.track.elements})
        seen_point += [len(points)] * len(views)
        seen_view += views
        points.append(point.xyz)
    cameras = Cameras(
        torch.from_numpy(np.stack(viewmats)).float(), torch.from_numpy(np.stack(Ks)).float(),
        torch.tensor(sizes), tuple(image.name for image in images),
    )  # fmt: skip
    return SparseModel(
        cameras, Lenses(torch.tensor(lenses, dtype=torch.float32)), torch.from_numpy(np.array(points)).float(),
        torch.tensor(seen_point), torch.tensor(seen_view),
    )  # fmt: skip
