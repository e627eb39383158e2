"""Benchmark of appearance: held-out photos, compared with gsplat's default recipe for the same wall time.

Both methods start from the same cameras and sparse points, train on the same undistorted photos at the same size, and
are scored by the same code on held-out photos. Our background is the mean colour of the photos; for gsplat it is black
or that colour, whichever scores better. Our time covers everything after structure from motion: depth maps, initial
Gaussians, and their optimisation. gsplat's schedule of 30,000 steps does not fit into this time, so it is scaled to the
number of steps that do. This number is estimated from the speed of the first 100 steps and, if the run then ends far
from our time, once more from that run. The estimation does not count as gsplat's time.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

import torch

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import depths, project
from stages.core.geometry.similarity import Similarity
from stages.core.scene.gaussians import Gaussians
from stages.lab.bench import appearance_gsplat as peer
from stages.lab.bench.common import earlier_results, machine, write_json
from stages.lab.bench.reconstruct import photo_folder
from stages.lab.bench.scene_options import AppearanceBenchOptions
from stages.reconstruct import classic, sfm
from stages.reconstruct.photo_reader import read_photos
from stages.reconstruct.photometric import score_views
from stages.reconstruct.photos import Photos, Reconstruction, Views
from stages.reconstruct.step_cache import StepCache, fingerprint

log = logging.getLogger(__name__)
T = TypeVar("T")
BLACK = (0.0, 0.0, 0.0)
WARMUP_STEPS = 100  # steps from which gsplat's initial speed is estimated
SPEED_FRACTION = 0.5  # first estimate of mean speed / initial speed, which falls as the number of Gaussians grows
MAX_TIME_RATIO = 1.15  # gsplat's time / ours at which its first run is stopped; below the inverse it is repeated


@dataclass(frozen=True)
class MethodScore:
    """Time, size and scores of one method."""

    seconds: float  # wall time
    steps: int  # photometric steps of one photo each
    gaussians: int
    psnr: float  # mean over held-out photos [dB]
    ssim: float  # mean over held-out photos
    psnr_exposed: float  # like `psnr`, after fitting the exposure of each photo [dB]

    def __str__(self) -> str:
        shown = f"{self.psnr:6.2f} ({self.psnr_exposed:5.2f}) dB {self.ssim:.3f}"
        return f"{shown} {self.gaussians:9,} {self.steps:7,} {self.seconds:5.0f} s"


def run(sets: list[Path], out: Path, options: AppearanceBenchOptions) -> Iterator[str]:
    """Yield a line for each set; all results go to the JSON file `out`, which keeps rows of other sets.

    Raises InputError if there are no photo sets or no NVIDIA GPU.
    """
    if not sets:
        raise InputError("PHOTOSET is missing: name one or more folders of photos, or folders that contain images/")
    if pick_device("auto") != "cuda":
        raise InputError("gsplat needs an NVIDIA GPU, but PyTorch finds none (see `ngff-lab doctor`)")
    folders = {folder: photo_folder(folder) for folder in map(Path, sets)}
    rows = earlier_results(out, "sets")
    yield f"{machine('cuda')}; quality {options.quality}, every {options.holdout}th photo held out"
    head = f"{'held-out (exposed)':>23s} {'Gaussians':>9s} {'steps':>7s} {'time':>7s}"
    yield f"{'set':14s}   ours: {head}   gsplat: {head}"
    for folder, images in folders.items():
        name = folder.resolve().name
        row = measure(name, images, options)
        rows[f"{name}, {options.quality}"] = {**row, "machine": machine("cuda")}
        write_json(out, {"sets": rows})
        yield f"{name:14s}         {MethodScore(**row['ours'])}           {MethodScore(**row['gsplat'])}"


def measure(
    name: str, images: Path, options: AppearanceBenchOptions, device: str = "cuda", draw: Callable | None = None
) -> dict:
    """Measure both methods on one set; `draw` replaces gsplat.rasterization in tests."""
    wanted = options.reconstruction()
    photos = read_photos(images, wanted.max_side)
    steps = camera_steps(name, photos, options.models)
    model = sfm.estimate_cameras(photos, steps=steps)
    (steps.folder / "depth.pt").unlink(missing_ok=True)  # left by an earlier run; computing it is part of our time
    made, seconds = timed(lambda: classic.reconstruct(photos, wanted, steps))
    count = wanted.iteration_count(len(made.trained), device)
    ours = judged(made.scene.gaussians, made, made.scene.background, seconds, count, device)
    log.info("%s: ours %s; %s", name, ours, {k: round(v, 1) for k, v in steps.seconds.items()})
    theirs = gsplat_result(made, model, seconds, device, draw)
    facts = {"photos": len(photos), "trained": len(made.trained), "held_out": len(made.held_out)}
    return {**facts, "seconds": steps.seconds, "ours": asdict(ours), "gsplat": asdict(theirs)}


def camera_steps(name: str, photos: Photos, models: Path | None) -> StepCache:
    """The camera cache in `models`. Photos with the same names and sizes are assumed to be identical."""
    if models is None:
        return StepCache()
    models.mkdir(parents=True, exist_ok=True)
    key = fingerprint(photos.names, [photos.size(i) for i in range(len(photos))])
    return StepCache(models / name, key, resume=True)


def gsplat_result(
    made: Reconstruction, model: sfm.SparseModel, seconds: float, device: str = "cuda", draw: Callable | None = None
) -> MethodScore:
    """Train gsplat's recipe from the same points, in the frame of our scene, for about the same wall time."""
    views, world = made.views[made.trained], made.scene.provenance["upright"]
    move = Similarity(world["scale"], torch.tensor(world["rotation"]), torch.tensor(world["translation"]))

    def train(steps: int, going: Callable[[int], bool]) -> tuple[Gaussians, int]:
        return peer.train(views, coloured_points(model, move, views, made.trained), steps, device, draw, going)

    for _ in range(2):  # the first call is a warm-up
        _, first = timed(lambda: train(peer.FULL_STEPS, lambda done: done < WARMUP_STEPS))
    steps = max(1, int(SPEED_FRACTION * WARMUP_STEPS * seconds / first))
    for longest in (MAX_TIME_RATIO * seconds, math.inf):
        latest = time.perf_counter() + longest
        (gaussians, done), took = timed(lambda: train(steps, lambda _: time.perf_counter() < latest))  # noqa: B023
        log.info("gsplat: %d of %d steps in %.1f s, %d Gaussians", done, steps, took, len(gaussians))
        sides = [judged(gaussians, made, behind, took, done, device) for behind in (BLACK, made.scene.background)]
        side = max(sides, key=lambda side: side.psnr)
        if done == steps and took > seconds / MAX_TIME_RATIO:
            break
        steps = max(1, int(done * seconds / took))
    return side


def coloured_points(model: sfm.SparseModel, move: Similarity, views: Views, trained: list[int]) -> peer.ColouredPoints:
    """Sparse points visible in training photos, transformed, with their mean colours in these photos (0..1)."""
    points, total, count = move(model.points), torch.zeros(len(model.points), 3), torch.zeros(len(model.points))
    for row, view in enumerate(trained):
        index = model.point_index[model.view_index == view]
        viewmat, image = views.cameras.viewmats[row], views.image(row)
        x, y = project(points[index], viewmat, views.cameras.Ks[row]).floor().long().unbind(1)
        inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
        inside &= depths(points[index], viewmat) > 0
        total.index_add_(0, index[inside], image[y[inside], x[inside]])
        count.index_add_(0, index[inside], torch.ones(int(inside.sum())))
    seen = count > 0
    return peer.ColouredPoints(points[seen], total[seen] / count[seen, None])


def judged(
    gaussians: Gaussians, made: Reconstruction, background: Sequence[float], seconds: float, steps: int,
    device: str = "cuda",
) -> MethodScore:  # fmt: skip
    """Score Gaussians on the held-out photos over a background colour."""
    raw, fitted = (
        score_views(gaussians, made.views, made.held_out, device, exposed, background) for exposed in (False, True)
    )
    return MethodScore(seconds, steps, len(gaussians), *raw, fitted[0])


def timed(make: Callable[[], T]) -> tuple[T, float]:
    """The result of a call and its wall time [s]."""
    start = time.perf_counter()
    return make(), time.perf_counter() - start
