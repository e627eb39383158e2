"""How well objects are found without labels, on scenes whose truth is known: intersection over union of each object.

The scenes are five of the ten objects on one of the eight tables, apart or touching; `segment` gets the true Gaussians
without their labels, and the cameras.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from tqdm import tqdm

from stages.errors import InputError
from stages.lab import bench
from stages.lab.tabletops import KINDS, tabletop
from stages.physics.grouping import group
from stages.scene.files import replacing
from stages.scene.scene import Scene


@dataclass(frozen=True)
class BenchOptions:
    """Two scenes show all ten objects."""

    scenes: int = 4  # of each kind
    photos: int = 24  # whose cameras the scene has

    def __post_init__(self):
        if not 1 <= self.scenes <= 100 or not 8 <= self.photos <= 200:
            raise InputError("--scenes 1 to 100, --photos 8 to 200")


def overlaps(found: Int[torch.Tensor, "n"], truth: Int[torch.Tensor, "n"]) -> dict[int, float]:
    """For each true object the intersection over union with the found object that fits it best; 0 is no object.

    `found` and `truth` number the same Gaussians.
    """
    table = torch.zeros(int(truth.max()) + 1, int(found.max()) + 1)
    table.view(-1).index_add_(0, truth * table.shape[1] + found, torch.ones(len(truth)))
    union = table.sum(1, keepdim=True) + table.sum(0) - table
    best = (table / union.clamp_min(1))[:, 1:]
    return {i: float(best[i].max()) if best.shape[1] else 0.0 for i in truth.unique().tolist() if i > 0}


def measure(scene: Scene) -> tuple[dict[int, float], Scene]:
    """Overlaps of the Gaussians of each object, and the scene as `segment` labels it."""
    truth = scene.gaussians.object_id
    blank = replace(scene, gaussians=replace(scene.gaussians, object_id=torch.zeros_like(truth)), objects=())
    found = group(blank)
    return overlaps(found.gaussians.object_id, truth), found


def run(out: Path | None = None, options: BenchOptions = BenchOptions()) -> Iterator[str]:  # noqa: B008 -- frozen
    """Lines of the report; all numbers as JSON in `out`."""
    yield bench.machine("cpu")
    rows, means = [], {}
    for kind in KINDS:
        mine = []
        for i in tqdm(range(options.scenes), desc=kind, unit="scene"):
            scene = tabletop(kind, i, options.photos)
            start = time.perf_counter()
            best, found = measure(scene)
            took = time.perf_counter() - start
            named = {scene.name_of(number): round(value, 3) for number, value in best.items()}
            mine.append(float(np.mean(list(named.values()))))
            row = {"kind": kind, "scene": i, "iou": named, "found": len(found.objects), "seconds": round(took, 1)}
            rows.append(row)
            yield f"{kind} {i}: mean {mine[-1]:.3f}; " + ", ".join(f"{n} {v:.2f}" for n, v in named.items())
        means[kind] = round(float(np.mean(mine)), 3)
        yield f"{kind}: mean IoU {means[kind]:.3f}"
    if out is not None:
        facts = {"command": "ngff-lab bench segment", "machine": bench.machine("cpu")}
        with replacing(out) as part:
            part.write_text(json.dumps({**facts, "mean_iou": means, "scenes": rows}, indent=1) + "\n")
