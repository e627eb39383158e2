"""Training of the segmentation network on reconstructed clutter."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from stages.core.backends import pick_device
from stages.core.models.segmenter.network import OFFSET_UNIT, SCORES, Prediction, Segmenter, pyramid
from stages.core.models.segmenter.segment import load_segmenter
from stages.core.models.segmenter.voxels import VOXEL, unique_cells
from stages.core.scene.files import replacing, sha256
from stages.lab.clutter.examples import read_example
from stages.lab.training.distributed import ProcessGroup, process_group
from stages.lab.training.options import SegmenterTraining
from stages.lab.training.segmenter_data import (
    Targets,
    augmented,
    find_examples,
    joined,
    targets,
    with_pairs,
)
from stages.lab.training.segmenter_scores import fit_scores

CLASS_WEIGHTS = torch.tensor([0.5, 1.0, 0.5])  # weights of surface, object and clutter in the class loss
REPORT_STEPS = 50  # steps between progress reports


def losses(model: Segmenter, t: Targets) -> dict[str, Tensor]:
    """Class, offset and affinity losses on one scene."""
    device = next(model.parameters()).device
    levels = pyramid(t.grid.cells.to(device), len(model.config["widths"]))
    with torch.autocast(device.type, torch.bfloat16):
        found = model(t.grid.features.to(device), levels)
    found = Prediction(*(getattr(found, name).float() for name in found.__dataclass_fields__))
    classes = t.classes.to(device)
    kind = cross_entropy(found.logits, classes, CLASS_WEIGHTS.to(device))
    own = classes == 1
    apart = (found.offsets - t.offsets.to(device))[own].norm(dim=1) / OFFSET_UNIT
    offset = torch.nn.functional.smooth_l1_loss(apart, torch.zeros_like(apart)) if own.any() else 0 * kind
    if not len(t.pairs):
        return {"class": kind, "offset": offset, "pair": 0 * kind}
    same = (t.labels[t.pairs[:, 0]] == t.labels[t.pairs[:, 1]]).float().to(device)
    odds = model.affinity(found, t.grid.points.to(device), t.pairs.to(device))
    pair = binary_cross_entropy_with_logits(odds, same)
    return {"class": kind, "offset": offset, "pair": pair}


class Crops(IterableDataset):
    """Endless batches of targets: augmented examples of random files, cropped to about `voxels` around an object.

    Every worker of a `DataLoader` and every process `rank` draws different ones.
    """

    def __init__(self, files: Sequence[Path], voxels: int, batch: int, seed: int, rank: int = 0):
        self.files, self.voxels, self.batch, self.seed, self.rank = list(files), voxels, batch, seed, rank

    def __iter__(self) -> Iterator[Targets]:
        worker = get_worker_info()
        rng = np.random.default_rng([self.seed, 0 if worker is None else worker.id, self.rank])
        torch.set_num_threads(1 if worker is not None else torch.get_num_threads())
        while True:
            yield joined([self._crop(rng) for _ in range(self.batch)])

    def _crop(self, rng: np.random.Generator) -> Targets:
        surfels, labels = augmented(read_example(self.files[rng.integers(len(self.files))]), rng)
        shift = VOXEL * torch.from_numpy(rng.uniform(0, 1, 3)).float()
        own = torch.nonzero(labels > 0)[:, 0]
        middle = surfels.points[own[int(rng.integers(len(own)))]] if len(own) else torch.zeros(3)
        cells, owner, _ = unique_cells((surfels.points / VOXEL).floor().long())
        distance = (cells * VOXEL - middle)[:, :2].norm(dim=1)
        reach = distance.kthvalue(self.voxels).values if len(cells) > self.voxels else torch.inf
        near = distance[owner] < reach
        return with_pairs(targets(surfels[near], labels[near], shift), rng)


def run(
    folders: Sequence[Path],
    out: Path,
    options: SegmenterTraining,
    start: Path | None = None,
    score_folders: Sequence[Path] = (),
) -> Iterator[str]:
    """Train on the scenes of `folders`, write OUT (.safetensors) and its card; yields a line per REPORT_STEPS steps.

    `score_folders` are scenes whose candidates train the scores, instead of `folders`: on scenes that the network was
    trained on, candidates fit better than on others. `start` holds initial weights, with the widths and blocks of their
    card; scores based on other candidate features than the current ones are initialised anew. Under `torchrun` every
    process draws its own crops, and the gradients are averaged.
    """
    torch.manual_seed(options.seed)
    files, score_files = find_examples(folders), find_examples(score_folders or folders)
    model = Segmenter(options.widths, options.blocks) if start is None else load_segmenter(start, new_scores=True)
    curve: list[dict] = []
    with process_group(pick_device(options.device)) as group:
        model = model.to(group.device).train()
        for line in fit_network(model, files, options, group, curve):
            if group.is_main:
                yield line
                _save(out, model, options, len(files), curve)
        if not group.is_main:
            return
    scores = fit_scores(model, score_files, options.score_scenes, options.score_steps, options.seed, options.workers)
    yield ", ".join(f"{k} {v}" for k, v in scores.items())
    _save(out, model, options, len(files), curve, scores)


def fit_network(
    model: Segmenter,
    files: Sequence[Path],
    options: SegmenterTraining,
    group: ProcessGroup,
    curve: list[dict],
    change: Callable[[Targets], Targets] = lambda t: t,
) -> Iterator[str]:
    """Train everything but the scores, in place; append to `curve` and yield a line every REPORT_STEPS steps.

    `change` is applied to each batch before its losses, for ablations.
    """
    trained = [p for name, p in model.named_parameters() if not name.startswith(SCORES)]
    optimiser = torch.optim.AdamW(trained, options.rate, weight_decay=0.01)
    dataset = Crops(files, options.voxels, options.batch, options.seed, group.rank)
    crops = iter(DataLoader(dataset, batch_size=None, num_workers=options.workers))
    begun, step, mean = time.monotonic(), 0, {}
    yield f"{len(files)} files, {sum(p.numel() for p in model.parameters())} parameters"
    while (part := group.broadcast(_progress(options, step, begun))) < 1:
        for settings in optimiser.param_groups:
            warm, decay = min(1, (step + 1) / 50), 0.5 * (1 + math.cos(math.pi * part))
            settings["lr"] = options.rate * warm * (0.02 + 0.98 * decay)
        found = losses(model, change(next(crops)))
        gradients = torch.autograd.grad(sum(found.values()), trained, materialize_grads=True)
        for p, gradient in zip(trained, group.mean(list(gradients)), strict=True):
            p.grad = gradient
        torch.nn.utils.clip_grad_norm_(trained, 1.0)
        optimiser.step()
        step += 1
        for name, value in found.items():
            mean[name] = mean.get(name, 0.0) + float(value.detach()) / REPORT_STEPS
        if step % REPORT_STEPS == 0:
            curve.append(
                {"step": step, "seconds": round(time.monotonic() - begun), **{k: round(v, 4) for k, v in mean.items()}}
            )
            yield ", ".join(f"{k} {v}" for k, v in curve[-1].items())
            mean = {}


def _progress(options: SegmenterTraining, step: int, begun: float) -> float:
    """Completed fraction of the training."""
    if not options.minutes:
        return 1.0
    return step / options.steps if options.steps else (time.monotonic() - begun) / (60 * options.minutes)


def _save(
    out: Path, model: Segmenter, options: SegmenterTraining, files: int, curve: list[dict], scores: dict | None = None
) -> None:
    """Write the weights in half precision, and their card."""
    with replacing(Path(out)) as part:
        save_file({k: v.detach().cpu().contiguous().half() for k, v in model.state_dict().items()}, part)
    card = {"model": "segmenter", "config": model.config, "sha256": sha256(out), "training": asdict(options),
            "files": files, "scores": scores or {}, "curve": curve}  # fmt: skip
    with replacing(Path(out).with_suffix(".json")) as part:
        part.write_text(json.dumps(card, indent=1))
