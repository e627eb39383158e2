"""Benchmark of object completion on scenes observed from one side only, compared with the true scenes.

A few objects stand on a table; ten cameras look from the front, and only the Gaussians visible to them are kept, with
noise. Each completer of `refine` is evaluated by surface (Chamfer distance), views from behind (PSNR), and motion of
the dropped objects (RMSE).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from stages.core.geometry.cameras import depths, intrinsics, orbit, project
from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.raster.rasterise import rasterise, visibility
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.evaluate import trajectories
from stages.evaluate.images import psnr
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.scenes import chamfer, nearest_neighbours
from stages.lab.assets.objects import OBJECTS, make_object
from stages.lab.assets.shapes import sheet, to_gaussians
from stages.lab.bench import common as bench
from stages.lab.bench.scene_options import CompleteBenchOptions
from stages.lab.names import chosen_names
from stages.refine.library import transformed
from stages.refine.options import RefineOptions
from stages.refine.stage import refine
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run as simulate

OBJECT_SIZE = 0.3  # longest side of an object [m]
IMAGE_SIZE, REAR_VIEWS = 320, 6  # side of the images [px], and number of novel views compared with the truth
FRONT_AZIMUTH, REAR_AZIMUTH = -45.0, 135.0  # azimuth of the middle camera of each arc [degrees]
SURFACE_DEPTH = 0.03 * OBJECT_SIZE  # depth behind the rendered surface up to which a Gaussian belongs to it [m]
COMPLETERS = ("none", "close", "library")
METRICS = ("chamfer_mm", "psnr_behind_db", "motion_rmse_mm")


def true_scene(object_names: str, options: CompleteBenchOptions) -> Scene:
    """The objects side by side, rotated randomly about the vertical, on a grey table with its top at z = 0."""
    rng = torch.Generator().manual_seed(options.seed)
    names = chosen_names(object_names, OBJECTS, "--scene")
    table = sheet(1.6, 1.6, 0.012)
    parts = [to_gaussians(table, torch.full((len(table.points), 3), 0.55), 0, 0.9)]
    for i, name in enumerate(names):
        half = torch.pi * torch.rand(1, generator=rng)  # half the rotation angle [rad]
        rotation = matrix(torch.cat([half.cos(), torch.zeros(2), half.sin()]))
        g = subsample(make_object(name), options.thin)
        low = float((OBJECT_SIZE * g.means[:, 2]).min())
        pose = Similarity(
            OBJECT_SIZE, rotation, torch.tensor([1.2 * OBJECT_SIZE * (i - (len(names) - 1) / 2), 0.0, -low])
        )
        parts.append(replace(transformed(g, pose), object_id=torch.full((len(g),), i + 1)))
    objects = tuple(SceneObject(i + 1, name) for i, name in enumerate(names))
    return Scene(concatenate(parts), objects, camera_arc(10, FRONT_AZIMUTH, 28.0), 0.0)


def subsample(g: Gaussians, step: int) -> Gaussians:
    """Every `step`-th Gaussian, enlarged to cover the same area."""
    few = g[torch.arange(0, len(g), step)]
    return replace(few, scales=few.scales * step**0.5)


def camera_arc(count: int, azimuth: float, elevation: float, sweep: float = 120.0) -> Cameras:
    """Cameras on an arc of `sweep` degrees around the middle of the table."""
    viewmats = orbit(count, torch.tensor([0.0, 0, 0.12]), 1.1, elevation, azimuth - sweep / 2, sweep)
    K = intrinsics(IMAGE_SIZE, IMAGE_SIZE, 1.4 * IMAGE_SIZE).expand(count, 3, 3).clone()
    return Cameras(viewmats, K, torch.full((count, 2), IMAGE_SIZE), tuple(f"{i:02d}.jpg" for i in range(count)))


def visible_scene(scene: Scene, options: CompleteBenchOptions) -> Scene:
    """The Gaussians of the objects that are visible in a camera, with noise, and the complete table."""
    g = scene.gaussians
    seen = g[visible(scene) | (g.object_id == 0)]
    error = (
        OBJECT_SIZE
        * options.noise
        * torch.randn(seen.means.shape, generator=torch.Generator().manual_seed(options.seed))
    )
    return replace(scene, gaussians=replace(seen, means=torch.where(seen.object_id[:, None] > 0, seen.means + error,
                                                                     seen.means)))  # fmt: skip


@torch.no_grad()
def visible(scene: Scene) -> Bool[Tensor, "n"]:
    """Whether each Gaussian's centre lies on a surface that is visible in some camera, regardless of its size."""
    g = scene.gaussians
    out = torch.zeros(len(g), dtype=torch.bool)
    for viewmat, K in zip(scene.cameras.viewmats, scene.cameras.Ks, strict=True):
        surface = rasterise(g, viewmat[None], K[None], IMAGE_SIZE, IMAGE_SIZE).depth[0]
        pixel = project(g.means, viewmat, K).floor().long()
        inside = ((pixel >= 0) & (pixel < IMAGE_SIZE)).all(1)
        x, y = pixel[inside].T
        out[inside] |= depths(g.means[inside], viewmat) < surface[y, x] + SURFACE_DEPTH
    return out


def chamfer_mm(scene: Scene, true: Scene) -> float:
    """Chamfer distance between the objects of two scenes [mm], averaged over both directions."""
    a, b = (s.gaussians.means[s.gaussians.object_id > 0] for s in (scene, true))
    return 1000 * chamfer(nearest_neighbours(a, b), nearest_neighbours(b, a))["chamfer"]


@torch.no_grad()
def psnr_behind(scene: Scene, true: Scene) -> float:
    """Mean PSNR of views from behind [dB], over the pixels covered by the true objects."""
    views, values = camera_arc(REAR_VIEWS, REAR_AZIMUTH, 20.0), []
    for viewmat, K in zip(views.viewmats, views.Ks, strict=True):
        mine, real = (rasterise(s.gaussians, viewmat[None], K[None], IMAGE_SIZE, IMAGE_SIZE).rgb for s in (scene, true))
        index = visibility(true.gaussians, viewmat, K, IMAGE_SIZE, IMAGE_SIZE).index
        on = (index >= 0) & (true.gaussians.object_id[index.clamp_min(0)] > 0)
        values.append(psnr(mine[:, on].clamp(0, 1), real[:, on].clamp(0, 1)))
    return sum(values) / len(values)


def run(out: Path | None, options: CompleteBenchOptions) -> Iterator[str]:
    """Yield a line for each scene and completer, and for the means over scenes; `out` receives the results as JSON."""
    yield f"{'scene':16}{'completer':12}{'Chamfer [mm]':>14}{'PSNR behind [dB]':>18}{'RMSE of motion [mm]':>21}"
    scenes = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _library(folder / "library", options)
        for object_names in options.scenes:
            scenes[object_names] = {}
            for completer, row in measure(object_names, folder, options):
                scenes[object_names][completer] = row
                yield _line(object_names, completer, row)
    means = {
        completer: {f: sum(s[completer][f] for s in scenes.values()) / len(scenes) for f in METRICS}
        for completer in COMPLETERS
    }
    yield from (_line("mean", completer, row) for completer, row in means.items())
    bench.write_results(out, "complete", "cpu", {"options": asdict(options), "scenes": scenes, "mean": means})


def measure(object_names: str, folder: Path, options: CompleteBenchOptions) -> Iterator[tuple[str, dict[str, float]]]:
    """Metrics of each completer on one scene."""
    true = true_scene(object_names, options)
    seen = visible_scene(true, options)
    _fall(true, folder / "truth", options)
    for completer in COMPLETERS:
        scene = refine(
            seen, RefineOptions(completer, folder / "library" if completer == "library" else None, background=False)
        )
        _fall(scene, folder / completer, options)
        motion = trajectories.compare(folder / f"{completer}.h5", folder / "truth.h5", EvaluateOptions())
        row = chamfer_mm(scene, true), psnr_behind(scene, true), 1000 * motion.overall["RMSE"]
        yield completer, {name: round(value, 3) for name, value in zip(METRICS, row, strict=True)}


def _line(scene: str, completer: str, row: dict[str, float]) -> str:
    return (
        f"{scene:16}{completer:12}{row['chamfer_mm']:14.2f}{row['psnr_behind_db']:18.2f}{row['motion_rmse_mm']:21.1f}"
    )


def _library(folder: Path, options: CompleteBenchOptions) -> None:
    folder.mkdir()
    for name in chosen_names(options.known, OBJECTS, "--known"):
        write_scene(folder / f"{name}.ply", Scene(make_object(name)))


def _fall(scene: Scene, path: Path, options: CompleteBenchOptions) -> None:
    """Simulate the objects dropped from a height; writes the trajectory to PATH.h5."""
    write_scene(path.with_suffix(".ply"), scene)
    chosen = SimulateOptions(
        steps=options.frames, engine="mpm", quality="draft", lift=(str(options.lift),), keypoints=256
    )
    simulate(path.with_suffix(".ply"), path.with_suffix(".h5"), chosen)
