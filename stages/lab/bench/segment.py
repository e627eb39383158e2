"""Benchmark of `segment` on synthetic scenes: intersection over union (IoU) with each true object.

A scene has five of the ten objects on one of the eight tables, apart or touching; `segment` receives the true Gaussians
without labels, and the cameras. Label images are the true ones or corrupted; voting over views is compared with labels
without voting. SAM 2.1 is included if its weights are installed. Optionally, rendered photos of each scene are also
reconstructed and segmented by the backends that need no prompts, with the IoU measured in pixels.
"""

from __future__ import annotations

import json
import logging
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import load
from stages.core.errors import InputError
from stages.core.perception.voting import ViewFootprint, add_votes, apply_votes, damp_votes
from stages.core.scene.scene import Scene
from stages.lab.assets.tabletops import ARRANGEMENTS, tabletop
from stages.lab.bench import common as bench
from stages.lab.bench.reconstructed_scene import reconstruct_from_renders, visible_labels
from stages.lab.bench.scene_options import SegmentBenchOptions
from stages.segment.boxes import segment as boxes_segment
from stages.segment.options import BACKENDS, SegmentOptions

log = logging.getLogger(__name__)
ERROR_RATES = (0.0, 0.2, 0.4)  # fraction of wrong objects and of wrong pixels in each label image
AUTOMATIC = ("geometric", "learned")  # backends that need no prompts and no additional weights
MASK_SHIFT = 20  # standard deviation of the random shift of masks, per unit of error rate [px]


def best_ious(found: Int[torch.Tensor, "n"], truth: Int[torch.Tensor, "n"]) -> dict[int, float]:
    """IoU of each true object with the best-fitting found object.

    `found` and `truth` are labels of the same Gaussians, or of the same pixels; 0 is the background.
    """
    table = torch.zeros(int(truth.max()) + 1, int(found.max()) + 1)
    table.view(-1).index_add_(0, truth * table.shape[1] + found, torch.ones(len(truth)))
    union = table.sum(1, keepdim=True) + table.sum(0) - table
    best = (table / union.clamp_min(1))[:, 1:]
    return {i: float(best[i].max()) if best.shape[1] else 0.0 for i in truth.unique().tolist() if i > 0}


def corrupt_labels(
    labels: Int[Tensor, "h w"], rate: float, objects: int, rng: np.random.Generator
) -> Int[Tensor, "h w"]:
    """A shifted label image with a fraction of its objects missing or swapped, and of its pixels random."""
    chance = rng.uniform(size=objects)
    taken = [0, *(0 if u < rate / 2 else int(rng.integers(1, objects + 1)) if u < rate else i
                  for i, u in enumerate(chance, start=1))]  # fmt: skip
    out = torch.tensor(taken)[labels]
    out = out.roll(tuple(int(step) for step in rng.normal(0, rate * MASK_SHIFT, 2).round()), (0, 1))
    noise = torch.from_numpy(rng.uniform(size=out.shape) < rate)
    return torch.where(noise, torch.from_numpy(rng.integers(0, objects + 1, out.shape)), out)


def segment_by_masks(scene: Scene, truth: Int[Tensor, "n"], seed: int) -> dict[str, Callable[[], Int[Tensor, "n"]]]:
    """Segmentations from label images of all views, by error rate, with and without voting.

    `scene` has no labels. A fraction of half the error rate of the images is also missing.
    """
    objects, rng = int(truth.max()), np.random.default_rng(seed)
    votes = {rate: torch.zeros(len(truth), 1) for rate in ERROR_RATES}
    last = {rate: torch.zeros_like(truth) for rate in ERROR_RATES}
    for view in tqdm(range(len(scene.cameras)), desc="masks", unit="view", leave=False):
        footprint = ViewFootprint.of(scene, view)
        seen = footprint.front >= 0
        labels = torch.where(seen, truth[footprint.front.clamp_min(0).long()], 0)
        for rate in ERROR_RATES:
            if rng.uniform() < rate / 2:
                continue
            given = corrupt_labels(labels, rate, objects, rng)
            votes[rate] = add_votes(votes[rate], damp_votes(footprint.votes(given)))
            last[rate][footprint.front[seen].long()] = given[seen]
    out: dict[str, Callable[[], Tensor]] = {}
    for rate in ERROR_RATES:
        name = f"masks, {rate:.0%} wrong" if rate else "masks"
        out[name] = lambda v=votes[rate]: apply_votes(scene, v, {}, "masks").gaussians.object_id
        out[f"{name}, no vote"] = lambda ids=last[rate]: ids
    return out


def segment_by_boxes(scene: Scene, truth: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
    """Object numbers from tight boxes, in the view in which the least visible object has the most pixels."""

    def shown(view: int) -> Int[Tensor, "h w"]:
        front = ViewFootprint.of(scene, view).front
        return torch.where(front >= 0, truth[front.clamp_min(0).long()], 0)

    count, views = int(truth.max()) + 1, range(len(scene.cameras))
    seen = [shown(view) for view in views]
    best = max(views, key=lambda v: int(seen[v].flatten().bincount(minlength=count).min()))
    labels, size = seen[best], scene.cameras.sizes[best]
    scale = size / torch.tensor([labels.shape[1], labels.shape[0]])
    boxes = []
    for i in range(1, count):
        pixels = (labels == i).nonzero().flip(1)
        boxes.append([*(pixels.amin(0) * scale).tolist(), *((pixels.amax(0) + 1) * scale).tolist()])
    scene = replace(scene, cameras=scene.cameras[[best, *(v for v in views if v != best)]])
    with tempfile.TemporaryDirectory() as folder:
        prompts = Path(folder) / "prompts.json"
        prompts.write_text(json.dumps({"bbox": boxes}))
        return boxes_segment(scene, SegmentOptions(boxes=prompts)).gaussians.object_id


def segment_by_network(scene: Scene, name: str, options: SegmentBenchOptions) -> Int[Tensor, "n"]:
    """Object ids found by a network backend without prompts in rendered views of the scene."""
    chosen = SegmentOptions(backend=name, weights=options.weights, device=options.device)
    return load(BACKENDS[name].entry)(scene, chosen).gaussians.object_id


def segment_without_prompts(scene: Scene, name: str, device: str) -> Scene:
    """The scene with the objects that a backend of AUTOMATIC finds with default options."""
    return load(BACKENDS[name].entry)(scene, SegmentOptions(backend=name, device=device))


def available_networks(options: SegmentBenchOptions) -> tuple[list[str], list[str]]:
    """Names of the network backends whose weights are available, and a message for each of the others.

    Raises InputError if `options.weights` is not accepted by any backend.
    """
    found, absent = [], []
    for name, row in BACKENDS.items():
        if not row.find_weights:
            continue
        try:
            load(row.find_weights)(options.weights)
            found.append(name)
        except InputError as error:
            absent.append(f"without {name}: {error}")
    if options.weights is not None and not found:
        raise InputError(absent[0].partition(": ")[2])
    return found, absent


def measure(kind: str, index: int, networks: list[str], options: SegmentBenchOptions) -> list[dict]:
    """A row for each method on one scene: IoU of each object, and time without rendering label images [s]."""
    scene = tabletop(kind, index, options.views)
    truth = scene.gaussians.object_id
    blank = replace(scene, gaussians=replace(scene.gaussians, object_id=torch.zeros_like(truth)), objects=())
    methods = {name: lambda name=name: segment_without_prompts(blank, name, options.device).gaussians.object_id
               for name in AUTOMATIC}  # fmt: skip
    methods |= {"boxes": lambda: segment_by_boxes(blank, truth), **segment_by_masks(blank, truth, index)}
    for name in networks:
        methods[name] = lambda name=name: segment_by_network(blank, name, options)
    rows = []
    for method, find in methods.items():
        start = time.perf_counter()
        found = find()
        rows.append({"kind": kind, "scene": index, "way": method, **_scores(scene, found, truth, start)})
    return rows


def measure_reconstructed(kind: str, index: int, options: SegmentBenchOptions) -> list[dict]:
    """A row for each backend of AUTOMATIC on one reconstruction: IoU in the pixels of the placed photos.

    The time excludes the reconstruction. The IoU is 0 if no camera could be estimated or nothing was segmented.
    """
    scene, made, names = tabletop(kind, index, options.views), None, ()
    try:
        with tempfile.TemporaryDirectory() as folder:
            made = reconstruct_from_renders(scene, Path(folder))
        names = made.cameras.names
    except InputError as error:
        log.warning("%s %d: %s", kind, index, error)
    truth = visible_labels(scene, names) if names else scene.gaussians.object_id
    rows = []
    for name in AUTOMATIC:
        start, labels = time.perf_counter(), torch.zeros_like(truth)
        try:
            if made is not None:
                labels = visible_labels(segment_without_prompts(made, name, options.device), names)
        except InputError as error:
            log.warning("%s %d, %s: %s", kind, index, name, error)
        scores = _scores(scene, labels, truth, start)
        rows.append({"kind": kind, "scene": index, "way": f"reconstructed, {name}", **scores, "placed": len(names)})
    return rows


def _scores(scene: Scene, found: Tensor, truth: Tensor, start: float) -> dict:
    """IoU of each object and their mean, number of objects found, and time since `start` [s]."""
    named = {scene.name_of(i): round(value, 3) for i, value in best_ious(found, truth).items()}
    return {"iou": named, "found": len(found.unique()) - 1, "mean": float(np.mean(list(named.values()))),
            "seconds": round(time.perf_counter() - start, 1)}  # fmt: skip


def run(out: Path | None, options: SegmentBenchOptions) -> Iterator[str]:
    """Yield the lines of the report; all results go to `out` as JSON."""
    yield bench.machine("cpu")
    networks, absent = available_networks(options)
    yield from absent
    rows = []
    for kind in ARRANGEMENTS:
        for i in tqdm(range(options.scenes), desc=kind, unit="scene"):
            rows += measure(kind, i, networks, options)
            rows += measure_reconstructed(kind, i, options) if options.reconstruct else []
            for row in rows[-len({r["way"] for r in rows}) :]:
                listed = ", ".join(f"{n} {v:.2f}" for n, v in row["iou"].items())
                yield f"{kind} {i}, {row['way']}: mean {row['mean']:.3f}; {listed}"
    means = {kind: _means([row for row in rows if row["kind"] == kind]) for kind in ARRANGEMENTS}
    yield f"{'mean IoU':<28}" + "".join(f"{kind:>10}" for kind in ARRANGEMENTS)
    for method in means[ARRANGEMENTS[0]]:
        yield f"{method:<28}" + "".join(f"{means[kind][method]:>10.3f}" for kind in ARRANGEMENTS)
    bench.write_results(out, "segment", "cpu", {"mean_iou": means, "scenes": rows})


def _means(rows: list[dict]) -> dict[str, float]:
    methods = dict.fromkeys(row["way"] for row in rows)
    return {
        method: round(float(np.mean([row["mean"] for row in rows if row["way"] == method])), 3) for method in methods
    }
