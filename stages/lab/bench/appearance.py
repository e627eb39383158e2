"""Photos kept out, as our Gaussians show them and as those of gsplat's default recipe do, after the same seconds.

Both start from the same cameras and sparse points, learn from the same undistorted photos at the same size, and are
judged by the same code on the photos kept out; where there is nothing to see, ours is the photos' mean colour, theirs
black or that, whichever suits it. Our time is that of all that follows structure from motion: depth maps,
first Gaussians, and their fit. gsplat's schedule of 30,000 steps does not fit in it, so it is scaled to as many steps
as do. How many is guessed from the speed of its first 100, and, when a run of so many ends far from the time, as
Gaussians multiplied less or more than guessed, once more from that run; finding out is not counted as its time.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import depths, project
from stages.core.geometry.similarity import Similarity
from stages.core.scene.files import replacing
from stages.core.scene.gaussians import Gaussians
from stages.lab.bench import appearance_gsplat as peer
from stages.lab.bench.common import machine
from stages.lab.bench.reconstruct import photo_folder
from stages.reconstruct import classic, sfm
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.photo_reader import read_photos
from stages.reconstruct.photometric import score_views
from stages.reconstruct.photos import Photos, Reconstruction, Views
from stages.reconstruct.step_cache import StepCache, fingerprint

log = logging.getLogger(__name__)
T = TypeVar("T")
BLACK = (0.0, 0.0, 0.0)
WARMUP_STEPS = 100  # steps by which gsplat's first speed is told
SPEED_FRACTION = 0.5  # share of it that is left on the whole, as Gaussians multiply; a first guess
MAX_TIME_RATIO = (
    1.15  # share of our time after which gsplat's first run is cut off; one below the inverse is repeated too
)


@dataclass(frozen=True)
class AppearanceBenchOptions:
    """What the sets are reconstructed with."""

    quality: str = "high"
    holdout: int = 8
    models: Path | None = None  # folder that keeps each set's cameras and sparse points; found anew without it

    def __post_init__(self):
        if self.holdout < 2:
            raise InputError(f"--holdout {self.holdout}: give 2 or more, to keep every N-th photo out")
        self.reconstruction()

    def reconstruction(self) -> ReconstructOptions:
        return ReconstructOptions(quality=self.quality, holdout=self.holdout)


@dataclass(frozen=True)
class MethodScore:
    """How one of the two did."""

    seconds: float  # wall time
    steps: int  # photometric, on one photo each
    gaussians: int
    psnr: float  # on the photos kept out, mean [dB]
    ssim: float
    psnr_exposed: float  # with the exposure of each photo fitted [dB]

    def __str__(self) -> str:
        shown = f"{self.psnr:6.2f} ({self.psnr_exposed:5.2f}) dB {self.ssim:.3f}"
        return f"{shown} {self.gaussians:9,} {self.steps:7,} {self.seconds:5.0f} s"


def run(sets: list[Path], out: Path, options: AppearanceBenchOptions) -> Iterator[str]:
    """A line a set, and all figures in a JSON file, which keeps the rows of sets that are not measured now."""
    if not sets:
        raise InputError("name one or more photo sets: a folder of photos, or one with images/")
    if pick_device("auto") != "cuda":
        raise InputError("gsplat needs an NVIDIA GPU, and PyTorch sees none here (see `ngff-lab doctor`)")
    folders = {folder: photo_folder(folder) for folder in map(Path, sets)}
    rows = json.loads(out.read_text())["sets"] if out.exists() else {}
    yield f"{machine('cuda')}; quality {options.quality}, every {options.holdout}th photo kept out"
    head = f"{'held-out (exposed)':>23s} {'Gaussians':>9s} {'steps':>7s} {'time':>7s}"
    yield f"{'set':14s}   ours: {head}   gsplat: {head}"
    for folder, images in folders.items():
        name = folder.resolve().name
        row = measure(name, images, options)
        rows[f"{name}, {options.quality}"] = {**row, "machine": machine("cuda")}
        with replacing(out) as part:
            part.write_text(json.dumps({"sets": rows}, indent=1) + "\n")
        yield f"{name:14s}         {MethodScore(**row['ours'])}           {MethodScore(**row['gsplat'])}"


def measure(
    name: str, images: Path, options: AppearanceBenchOptions, device: str = "cuda", draw: Callable | None = None
) -> dict:
    """One set, by both; `draw` stands for gsplat.rasterization."""
    wanted = options.reconstruction()
    photos = read_photos(images, wanted.max_side)
    steps = camera_steps(name, photos, options.models)
    model = sfm.estimate_cameras(photos, steps=steps)
    (steps.folder / "depth.pt").unlink(missing_ok=True)  # of an earlier run: making it is part of our time
    made, seconds = timed(lambda: classic.reconstruct(photos, wanted, steps))
    count = wanted.iteration_count(len(made.trained), device)
    ours = judged(made.scene.gaussians, made, made.scene.background, seconds, count, device)
    log.info("%s: ours %s; %s", name, ours, {k: round(v, 1) for k, v in steps.seconds.items()})
    theirs = gsplat_result(made, model, seconds, device, draw)
    facts = {"photos": len(photos), "trained": len(made.trained), "held_out": len(made.held_out)}
    return {**facts, "seconds": steps.seconds, "ours": asdict(ours), "gsplat": asdict(theirs)}


def camera_steps(name: str, photos: Photos, models: Path | None) -> StepCache:
    """Where the cameras are kept, or will be. Photos of the same names and sizes are taken to be the same."""
    if models is None:
        return StepCache()
    models.mkdir(parents=True, exist_ok=True)
    key = fingerprint(photos.names, [photos.size(i) for i in range(len(photos))])
    return StepCache(models / name, key, resume=True)


def gsplat_result(
    made: Reconstruction, model: sfm.SparseModel, seconds: float, device: str = "cuda", draw: Callable | None = None
) -> MethodScore:
    """The other recipe, from the same points, moved to where our scene is, for about the same seconds."""
    views, world = made.views[made.trained], made.scene.provenance["upright"]
    move = Similarity(world["scale"], torch.tensor(world["rotation"]), torch.tensor(world["translation"]))

    def train(steps: int, going: Callable[[int], bool]) -> tuple[Gaussians, int]:
        return peer.train(views, *coloured_points(model, move, views, made.trained), steps, device, draw, going)

    for _ in range(2):  # the first warms up
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


def coloured_points(
    model: sfm.SparseModel, move: Similarity, views: Views, trained: list[int]
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """The sparse points that photos learned from show, moved, with the mean of their colours there (0..1)."""
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
    return points[seen], total[seen] / count[seen, None]


def judged(
    gaussians: Gaussians, made: Reconstruction, background: Sequence[float], seconds: float, steps: int,
    device: str = "cuda",
) -> MethodScore:  # fmt: skip
    """With what to paint where there are no Gaussians."""
    raw, fitted = (
        score_views(gaussians, made.views, made.held_out, device, exposed, background) for exposed in (False, True)
    )
    return MethodScore(seconds, steps, len(gaussians), *raw, fitted[0])


def timed(make: Callable[[], T]) -> tuple[T, float]:
    """What is made, and the wall time until it is in the CPU's memory [s]."""
    start = time.perf_counter()
    return make(), time.perf_counter() - start
