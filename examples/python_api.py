"""The stages called from Python: python python_api.py OUT

Builds a small scene (two blocks on a table, with cameras, as `ngff reconstruct` would give it), then segments, refines,
simulates, renders and evaluates it. Every stage is a function `run(inputs, output, options)` that reads and writes
files; its options are a frozen dataclass with the defaults of the command line. The asserts check the outcome of each.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import torch

from stages.core.geometry.cameras import intrinsics, orbit
from stages.core.geometry.harmonics import rgb_to_sh
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.trajectory import read_trajectory
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.stage import run as evaluate
from stages.refine.options import RefineOptions
from stages.refine.stage import run as refine
from stages.render.options import RenderOptions
from stages.render.stage import run as render
from stages.segment.options import SegmentOptions
from stages.segment.stage import run as segment
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run as simulate

SPACING = 0.012  # distance between Gaussians on a surface [m]
LIFT = 0.3  # height from which the objects are dropped [m]


def surface(points: torch.Tensor, rgb: tuple, object_id: int) -> Gaussians:
    """Opaque isotropic Gaussians of one colour, with slight noise as in photos."""
    n = len(points)
    rng = torch.Generator().manual_seed(object_id)
    colours = torch.tensor(rgb) + 0.03 * torch.randn(n, 3, generator=rng)
    return Gaussians(
        means=points, quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), scales=torch.full((n, 3), 0.6 * SPACING),
        opacities=torch.full((n,), 0.95), sh=rgb_to_sh(colours), object_id=torch.full((n,), object_id),
    )  # fmt: skip


def grid(*sides: float) -> torch.Tensor:
    """Points of a regular grid with these side lengths [m], centred in x and y."""
    axes = [torch.arange(0, side, SPACING) for side in sides]
    points = torch.cartesian_prod(*axes, *([torch.zeros(1)] * (3 - len(sides))))
    return points - torch.tensor([sides[0] / 2, sides[1] / 2, 0.0])


def block(x: float, y: float, side: float, rgb: tuple, object_id: int) -> Gaussians:
    """The surface of a cube that stands on the table, without its bottom."""
    points = grid(side, side, side)
    low, high = points.amin(0), points.amax(0)
    outside = (points <= low)[:, :2].any(1) | (points >= high).any(1)
    return surface(points[outside] + torch.tensor([x, y, 0.5 * SPACING]), rgb, object_id)


def build_scene() -> Scene:
    """Two blocks on a table with their true labels, and eight cameras around them."""
    parts = [surface(grid(0.9, 0.9), (0.55, 0.4, 0.25), 0), block(-0.15, 0.0, 0.12, (0.8, 0.1, 0.1), 1),
             block(0.15, 0.05, 0.1, (0.1, 0.2, 0.8), 2)]  # fmt: skip
    viewmats = orbit(8, torch.tensor([0.0, 0.0, 0.05]), 1.0, 35.0)
    K = intrinsics(160, 160, 220.0).expand(8, 3, 3).clone()
    cameras = Cameras(viewmats, K, torch.full((8, 2), 160), tuple(f"{i}.jpg" for i in range(8)))
    return Scene(concatenate(parts), (SceneObject(1, "red block"), SceneObject(2, "blue block")), cameras, floor=0.0)


def main(out: Path) -> dict:
    """Run every stage in `out`; returns the metrics of the last comparison."""
    out.mkdir(parents=True, exist_ok=True)
    truth = build_scene()
    unlabelled = replace(truth.gaussians, object_id=torch.zeros_like(truth.gaussians.object_id))
    write_scene(out / "truth.ply", truth)
    write_scene(out / "scene.ply", replace(truth, gaussians=unlabelled, objects=()))

    exact = SegmentOptions(backend="geometric", names="1=red block,2=blue block")  # suits clean shapes
    segment(out / "scene.ply", out / "labelled.ply", exact)
    labels = evaluate(out / "labelled.ply", out / "truth.ply", out / "labels.json", EvaluateOptions())
    assert labels["overall"]["IoU"] > 0.9

    refine(out / "labelled.ply", out / "refined.ply", RefineOptions(resolution=24))
    assert len(read_scene(out / "refined.ply").objects) == 2

    common = SimulateOptions(steps=6, lift=(str(LIFT),), quality="draft", keypoints=128)
    for engine in ("mpm", "ngff"):
        simulate(out / "refined.ply", out / f"{engine}.h5", replace(common, engine=engine))
        com = read_trajectory(out / f"{engine}.h5").com[:, :, 2]
        fallen = 9.81 * (5 * 0.02) ** 2 / 2  # free fall for 5 frames of 0.02 s, before the objects reach the table
        assert ((com[0] - com[-1]) / fallen - 1).abs().max() < 0.1

    video = render(out / "mpm.h5", out / "mpm.mp4", RenderOptions(view="orbit", resolution=96))
    assert json.loads(video.with_name("mpm.mp4.json").read_text())["frames"] == 6
    white = RenderOptions(view="novel", resolution=96, background="#ffffff", shadows="off")
    render(out / "mpm.h5", out / "sheet.png", white)

    metrics = evaluate(out / "ngff.h5", out / "mpm.h5", out / "metrics.json", EvaluateOptions())
    assert metrics["overall"]["FPE"] < 0.02  # both engines predict the same free fall [m]
    return metrics


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all files, created if absent")
    main(parser.parse_args().out)
