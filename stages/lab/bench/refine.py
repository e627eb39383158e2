"""Benchmark of hole filling under objects on synthetic scenes, evaluated from novel views.

The table under five objects is removed where no camera sees it, and filled by `refine`. Then the objects are removed
and the table is compared with the true one in the pixels of the holes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from tqdm import tqdm

from stages.core.geometry.cameras import orbit
from stages.core.perception.visibility import downscaled_views
from stages.core.raster.rasterise import rasterise, visibility
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.lab.assets.backgrounds import TABLE_HEIGHT
from stages.lab.assets.tabletops import CAMERA_DISTANCE, tabletop
from stages.lab.bench import common as bench
from stages.lab.bench.scene_options import RefineBenchOptions
from stages.refine.options import RefineOptions
from stages.refine.stage import refine

NOVEL_VIEWS = 4  # number of views from above the cameras of the photos
MAX_HIDDEN_WEIGHT = 0.02  # largest total weight in any photo of a table Gaussian that counts as unseen [px]
MIN_TABLE_ALPHA = 0.9  # smallest alpha of a pixel that shows the table


@torch.no_grad()
def remove_unseen_background(scene: Scene) -> Scene:
    """The scene without background Gaussians that are invisible in all cameras."""
    g = scene.gaussians
    weight = torch.zeros(len(g))
    for viewmat, K, width, height in downscaled_views(scene.cameras):
        weight = torch.maximum(weight, visibility(g, viewmat, K, width, height).weight)
    return replace(scene, gaussians=g[(g.object_id > 0) | (weight > MAX_HIDDEN_WEIGHT)])


@torch.no_grad()
def render_background(g: Gaussians, views: Float[Tensor, "c 4 4"], scene: Scene) -> tuple[Tensor, Tensor]:
    """Images (c, h, w, 3) and alpha (c, h, w) of the background alone, with the scene's intrinsics."""
    width, height = (int(side) for side in scene.cameras.sizes[0])
    Ks = scene.cameras.Ks[:1].expand(len(views), 3, 3)
    drawn = rasterise(g[g.object_id == 0], views, Ks, width, height)
    return drawn.rgb.clamp(0, 1), drawn.alpha


def masked_psnr(one: Float[Tensor, "c h w 3"], two: Float[Tensor, "c h w 3"], where: Bool[Tensor, "c h w"]) -> float:
    """PSNR over the masked pixels [dB]."""
    return -10 * math.log10(max(float((one - two)[where].square().mean()), 1e-10))


def measure(index: int, views: int) -> dict:
    """Metrics of one scene, using the true object labels."""
    scene = tabletop("apart", index, views)
    seen = remove_unseen_background(scene)
    start = time.perf_counter()
    refined = refine(seen, RefineOptions(completer="none"))  # objects are removed before the comparison
    took = time.perf_counter() - start
    views = orbit(NOVEL_VIEWS, torch.tensor([0.0, 0, TABLE_HEIGHT]), CAMERA_DISTANCE, 60.0, azimuth=10.0)
    true, _ = render_background(scene.gaussians, views, scene)
    before, _ = render_background(seen.gaussians, views, scene)
    after, _ = render_background(refined.gaussians, views, scene)
    # the floor is visible through a hole, so holes are found as transparent pixels of the table top alone
    tops = (g[g.means[:, 2] > TABLE_HEIGHT - 0.02] for g in (scene.gaussians, seen.gaussians))
    whole, left = (render_background(top, views, scene)[1] for top in tops)
    hole = (whole > MIN_TABLE_ALPHA) & (left < MIN_TABLE_ALPHA)
    return {
        "scene": index, "pixels": int(hole.sum()), "before_db": round(masked_psnr(before, true, hole), 2),
        "after_db": round(masked_psnr(after, true, hole), 2),
        "elsewhere_db": round(masked_psnr(after, before, ~hole), 2),
        "seconds": round(took, 1),
    }  # fmt: skip


def run(out: Path | None, options: RefineBenchOptions) -> Iterator[str]:
    """Yield the lines of the report; all results go to `out` as JSON."""
    yield bench.machine("cpu")
    rows = []
    for i in tqdm(range(options.scenes), unit="scene"):
        rows.append(measure(i, options.views))
        r = rows[-1]
        yield (
            f"scene {i}: PSNR of the holes from new views {r['before_db']:.1f} dB open, {r['after_db']:.1f} dB filled; "
            f"elsewhere unchanged to {r['elsewhere_db']:.1f} dB; {r['seconds']:.0f} s"
        )
    bench.write_results(out, "refine", "cpu", {"scenes": rows})
