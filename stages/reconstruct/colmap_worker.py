"""The process that runs COLMAP's long steps for colmap.py.

It reads requests from stdin, one JSON array [task, arguments] per line. For each request it writes lines to stdout: any
number of ["progress", number of photos], then ["done", null] or ["error", text]. It exits at the end of stdin, also
when the parent process has been killed.
"""

from __future__ import annotations

import copy
import json
import os
import queue
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from stages.reconstruct.colmap import import_pycolmap

Progress = Callable[[int], None]
MIN_SHARING = 10  # fewest photos of a camera whose principal point is refined
# Smallest relative gain in reprojection error by refined principal points: measured 0 to .012 in four sets of whole
# photos, and .01, .07 and .12 in cropped ones.
MIN_GAIN = 0.03


def extract_features(progress: Progress, folder: str, names: list[str], threads: int) -> None:
    """Write the SIFT features of the images `names` in `folder` to features.db there."""
    pycolmap = import_pycolmap()
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=threads)
    pycolmap.extract_features(Path(folder) / "features.db", folder, names, extraction_options=options,
                              device=pycolmap.Device.cpu)  # fmt: skip


def map_photos(progress: Progress, folder: str, database: str, photos: int, seed: int, min_points: int) -> None:
    """Write the models that COLMAP's incremental mapper finds to the folders 0, 1, ... in `folder`.

    A photo is added if it shows at least `min_points` of the points of the model.

    Principal points are at the centres of the photos. If refined ones explain the best model clearly better, because
    photos were cropped, all photos are mapped again with these, and the cameras in the database are changed.
    """
    pycolmap = import_pycolmap()
    options = _mapper_options(photos, seed)
    options.mapper.abs_pose_min_num_inliers = min_points

    def mapped(show: Progress) -> dict:
        return pycolmap.incremental_mapping(
            database, folder, folder, options, initial_image_pair_callback=lambda: show(2),
            next_image_callback=lambda: show(1),
        )  # fmt: skip

    found = mapped(progress)
    best = max(found.values(), key=lambda model: model.num_reg_images(), default=None)
    if best is not None and (cameras := _off_centre(best)):
        file = pycolmap.Database.open(database)
        for camera in cameras:
            file.update_camera(camera)
        file.close()
        found = mapped(lambda _: None)
    for number, model in found.items():
        (Path(folder) / str(number)).mkdir(exist_ok=True)
        model.write(Path(folder) / str(number))


def _off_centre(model) -> list:
    """The model's cameras with refined principal points, if these lower the reprojection error by MIN_GAIN; else empty.

    Each camera must have at least MIN_SHARING photos, since few photos hardly distinguish an offset of the principal
    point from a tilt of the scene.
    """
    pycolmap = import_pycolmap()
    users = Counter(image.camera_id for image in model.images.values())
    if min(users.values(), default=0) < MIN_SHARING:
        return []
    model, error = copy.deepcopy(model), model.compute_mean_reprojection_error()
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)
    gained = model.compute_mean_reprojection_error() < (1 - MIN_GAIN) * error
    return [model.cameras[i] for i in users] if gained else []


def triangulate(progress: Progress, folder: str, database: str, photos: int, seed: int) -> None:
    """Triangulate points, and replace the model in `folder`, which has only cameras and images, by one with points."""
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction(folder)
    options = _mapper_options(photos, seed)
    pycolmap.triangulate_points(model, database, folder, folder, options=options).write(folder)


def _mapper_options(photos: int, seed: int):
    """COLMAP's defaults on one thread, without minimum model sizes for very few photos."""
    options = import_pycolmap().IncrementalPipelineOptions(random_seed=seed, num_threads=1, extract_colors=False)
    options.min_model_size = min(3, photos)
    options.triangulation.ignore_two_view_tracks = photos > 3  # most tracks of up to 3 photos have two views
    return options


TASKS = {"extract": extract_features, "map": map_photos, "triangulate": triangulate}


def main() -> None:
    """Run tasks until stdin ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # both processes receive Ctrl-C; the parent ends this one
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # send everything that COLMAP prints to stderr

    def say(kind: str, value: object) -> None:
        out.write(json.dumps([kind, value]) + "\n")
        out.flush()

    requests: queue.SimpleQueue = queue.SimpleQueue()
    threading.Thread(target=_read, args=(requests,), daemon=True).start()
    pycolmap = import_pycolmap()
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    while True:
        task, arguments = requests.get()
        try:
            pycolmap.set_random_seed(arguments.get("seed", 0))
            TASKS[task](lambda count: say("progress", count), **arguments)
        except Exception as error:
            say("error", "bad_alloc" if isinstance(error, MemoryError) else str(error))
        else:
            say("done", None)


def _read(requests: queue.SimpleQueue) -> None:
    for line in sys.stdin:
        requests.put(json.loads(line))
    os._exit(0)
