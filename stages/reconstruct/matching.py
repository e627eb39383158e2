"""Matching of photos: a COLMAP database with features, matches and verified two-view geometry."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import load
from stages.reconstruct import features
from stages.reconstruct.epipolar import EpipolarLines
from stages.reconstruct.options import FEATURE_EXTRACTORS, FEATURE_MATCHERS
from stages.reconstruct.photos import Photos
from stages.reconstruct.step_cache import StepCache

FOCAL_STARTS = 1.2, 0.8  # initial focal lengths without EXIF [longer side]: COLMAP's, and of the main cameras of phones
MAX_EPIPOLAR_ERROR = 0.006  # largest epipolar error of a match for given cameras [photo size]: 4 px of 640
MatchedPair = tuple[int, int, np.ndarray, np.ndarray]  # indices of two photos, and matching pixels (k, 2) in each


class MatchingOptions(NamedTuple):
    """Options of matching."""

    matcher: str = "sift"  # key of FEATURE_MATCHERS
    seed: int = 0
    device: str = "cpu"


def build_database(
    photos: Photos, cameras: list, steps: StepCache, matching: MatchingOptions,
    viewmats: Float[Tensor, "c 4 4"] | None = None,
) -> Path:  # fmt: skip
    """Match the photos; returns the path of a COLMAP database with verified matches.

    `cameras` are pycolmap cameras, one per photo. If the poses `viewmats` are known, matches are verified by their
    distance from epipolar lines. Otherwise a two-view geometry is fitted to the matches, which repeated patterns may
    mislead.
    """
    extract = load(FEATURE_EXTRACTORS[matching.matcher])

    def write(path: Path) -> None:
        found = steps.cached("features", lambda: extract(photos, matching.device))
        with steps.timed("matches"), features.writing_database(path.parent):
            _write_database(path, photos, cameras, found, matching, viewmats)

    return steps.cached_file("matches.db", write)


def initial_cameras(photos: Photos) -> list:
    """Initial pycolmap camera of each photo, shared by photos of the same size and EXIF focal length.

    Without EXIF the focal length is FOCAL_STARTS[0] times the longer side. The camera model is SIMPLE_RADIAL, which is
    sufficient for phones and most lenses; sharing it stabilises weak geometry.
    """
    import pycolmap

    kinds = [(photos.size(i), round(photos.focals[i])) for i in range(len(photos))]
    cameras = {}
    for k, (size, focal) in enumerate(dict.fromkeys(kinds)):
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL", width=size[0], height=size[1],
            params=[focal or FOCAL_STARTS[0] * max(size), size[0] / 2, size[1] / 2, 0.0], camera_id=k + 1,
        )  # fmt: skip
        camera.has_prior_focal_length = focal > 0
        cameras[size, focal] = camera
    return [cameras[kind] for kind in kinds]


def set_unknown_focals(database: Path, factor: float) -> None:
    """Set the focal lengths that are unknown from EXIF to `factor` times the longer side."""
    import pycolmap

    file = pycolmap.Database.open(database)
    for camera in file.read_all_cameras():
        if not camera.has_prior_focal_length:
            camera.params = [factor * max(camera.width, camera.height), *camera.params[1:]]
            file.update_camera(camera)
    file.close()


def verified_pairs(database: Path) -> list[MatchedPair]:
    """The pairs of photos with verified matches; photos are numbered from 0 in the order of the database."""
    return _pairs(
        database,
        lambda file: ((pair, g.inlier_matches) for pair, g in zip(*file.read_two_view_geometries(), strict=True)),
    )


def all_pairs(database: Path) -> list[MatchedPair]:
    """The pairs of photos with matches, verified or not; numbered as by `verified_pairs`."""
    return _pairs(database, lambda file: zip(*file.read_all_matches(), strict=True))


def _pairs(database: Path, read: Callable) -> list[MatchedPair]:
    import pycolmap

    file = pycolmap.Database.open(database)
    pixels = {image.image_id: file.read_keypoints(image.image_id)[:, :2] for image in file.read_all_images()}
    out = []
    for pair, matches in read(file):
        i, j = pycolmap.pair_id_to_image_pair(pair)
        rows = np.asarray(matches)
        if len(rows):
            out.append((i - 1, j - 1, pixels[i][rows[:, 0]], pixels[j][rows[:, 1]]))
    file.close()
    return out


def _write_database(
    path: Path, photos: Photos, cameras: list, found: list[features.Feature], matching: MatchingOptions,
    viewmats: Float[Tensor, "c 4 4"] | None,
) -> None:  # fmt: skip
    """Write cameras, photos, keypoints, matches and two-view geometries."""
    import pycolmap

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
        database.write_keypoints(i + 1, found[i][0].numpy())
    for i, j, matches, geometry in _match_and_verify(found, cameras, matching, viewmats):
        database.write_matches(i + 1, j + 1, matches)
        database.write_two_view_geometry(i + 1, j + 1, geometry)
    database.close()


def _match_and_verify(
    found: list[features.Feature], cameras: list, matching: MatchingOptions, viewmats: Float[Tensor, "c 4 4"] | None
) -> list[tuple]:
    """Matches and two-view geometry of the selected pairs, verified in other threads while more pairs are matched."""
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = matching.seed
    options.ransac.max_num_trials = 3000  # pairs that need more have too few inliers
    pixels = [table[:, :2].double().numpy() for table, *_ in found]
    vectors = [features.normalise(descriptors) for _, descriptors, *_ in found]
    match = load(FEATURE_MATCHERS[matching.matcher])(found, [(c.width, c.height) for c in cameras], matching.device)

    def guided(i: int, j: int, matches: np.ndarray) -> tuple:
        """Match again along epipolar lines, which excludes most other repetitions of a pattern."""
        lines = EpipolarLines(cameras[i], cameras[j], viewmats[[i, j]], pixels[i], pixels[j])
        near = lines.distances() < MAX_EPIPOLAR_ERROR * max(cameras[i].width, cameras[i].height)
        rows = match(i, j, near)
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.inlier_matches = rows[near[rows[:, 0], rows[:, 1]]].numpy().astype(np.uint32)
        return i, j, matches, geometry

    def verify(i: int, j: int, matches: np.ndarray) -> tuple:
        geometry = pycolmap.estimate_two_view_geometry(cameras[i], pixels[i], cameras[j], pixels[j], matches, options)
        return i, j, matches, geometry

    pending = []
    with ThreadPoolExecutor(max(1, torch.get_num_threads() - 1)) as background:
        for i, j in tqdm(features.select_pairs(vectors), desc="matching photos", unit="pair", leave=False):
            matches = match(i, j).numpy().astype(np.uint32)
            if len(matches) >= options.min_num_inliers:
                pending.append(background.submit(verify if viewmats is None else guided, i, j, matches))
        return [job.result() for job in pending]
