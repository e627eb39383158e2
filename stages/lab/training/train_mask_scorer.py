"""Training of the mask scorer of the segmentation network, whose other weights stay as they are."""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.models.segmenter.candidates import find_candidates
from stages.core.models.segmenter.crops import Boxes, Surroundings, boxes, corrected, crops, plausible, surroundings
from stages.core.models.segmenter.network import Segmenter, pyramid
from stages.core.models.segmenter.segment import (
    MAX_VOXELS,
    SIZE_POWER,
    ScoredCandidates,
    SegmenterOptions,
    find,
    load_segmenter,
)
from stages.core.models.segmenter.voxels import SCALES, VoxelGrid, voxelise
from stages.core.scene.files import replacing, sha256
from stages.lab.clutter import scenes
from stages.lab.clutter.examples import Example, read_example
from stages.lab.training.segmenter_scores import true_iou

log = logging.getLogger(__name__)
RATE = 2e-3
SIDE_RANGE, SHAKE = (0.85, 1.2), 0.06  # of crops, and their shift in sides of the candidate
COLOUR, COLOUR_RANGE, NOISE = slice(14, 17), (0.5, 1.3), 0.03  # channels, their factors, and noise of all channels
KNOWN_NOISE = 0.05
COPY_SCALES = (0.8, 1.25)  # of turned copies
HELD_OUT = 0.15  # share of the scenes
EXAMPLES = "masks_{}_{}.pt"  # beside the observation, of its name and the number of the copy
REPORT_STEPS = 100


@dataclass(frozen=True)
class MaskTraining:
    """Settings of the training."""

    scene_minutes: float = 0.0  # in which scenes are made and reconstructed; 0: only those that are there
    minutes: float = 10.0  # of the training itself
    steps: int = 0  # of the training; 0: as many as fit in `minutes`
    workers: int = 0  # processes that make scenes and their examples, in turn on each GPU; 0: this one
    copies: int = 1  # turned ones of each scene
    batch: tuple[int, int] = (12, 40)  # scenes of a step, and candidates of each
    seed: int = 0
    device: str = "auto"

    def __post_init__(self):
        if self.scene_minutes < 0 or not self.minutes > 0 or min(self.steps, self.workers, *self.batch) < 0:
            raise InputError("--minutes must be above 0, --scene-minutes, --steps and --workers 0 or more")
        if self.batch[0] < 1 or self.batch[1] < 2:
            raise InputError("--batch must be at least 1 scene and 2 candidates")


@dataclass(frozen=True)
class MaskExamples:
    """Plausible candidates of a scene at one scale, and how well each fits a true object."""

    seen: Surroundings
    boxes: Boxes
    ious: Float[Tensor, "k"]  # true
    weights: Float[Tensor, "k"]  # in the choice of objects: surfels ** SIZE_POWER

    def to(self, device: torch.device | str) -> MaskExamples:
        """The same on a device."""
        return MaskExamples(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


def run(
    folders: Sequence[Path], out: Path, options: MaskTraining, meshes: Sequence[Path] = (), weights: Path | None = None
) -> Iterator[str]:
    """Make scenes in the first of `folders`, train on those in all, write OUT (.safetensors) and its card.

    Yields a line per REPORT_STEPS steps, and last the losses on scenes held out of the training. `weights`: of the
    network. Scenes and examples that are there are kept.
    """
    device, start = pick_device(options.device), find(weights)
    load_segmenter(start)  # errors are raised here, not in each process
    _prepare(folders, options, meshes, start, device)
    files = sorted(p for folder in folders for p in Path(folder).glob(f"*/{EXAMPLES.format('*', '*')}"))
    names = sorted({p.parent for p in files})
    held = set(names[len(names) - round(HELD_OUT * len(names)) :])
    trained = [m for p in files if p.parent not in held for m in read_masks(p, device)]
    if not trained:
        raise InputError(f"{folders[0]}: its scenes have no candidates to train on; make more with --scene-minutes")
    model = load_segmenter(start, device)
    model.add_mask_scorer()
    yield f"{len(names)} scenes, {len(held)} held out, {sum(len(m.boxes) for m in trained)} candidates"
    yield from train_masks(model, trained, options)
    judged = [m for p in files if p.parent in held and p.match(EXAMPLES.format("*", 0)) for m in read_masks(p, device)]
    losses = held_out_losses(model, judged)
    _save(out, model, options, len(names), start, losses)
    yield "held out: " + ", ".join(f"{name} {loss}" for name, loss in losses.items())


def _prepare(folders: Sequence[Path], options: MaskTraining, meshes: Sequence[Path], start: Path, device: str) -> None:
    """Scenes and examples by processes of their own, which share the GPUs."""
    until = time.time() + 60 * options.scene_minutes
    if not options.workers:
        return _work(0, folders, options, meshes, start, device, until)
    os.environ.setdefault("PYTORCH_CUDA_ALLOC_CONF", "expandable_segments:True")  # sizes vary from scene to scene
    context = multiprocessing.get_context("spawn")  # a GPU cannot be used in a forked process
    gpus = torch.cuda.device_count() if device == "cuda" else 0
    workers = []
    for k in range(options.workers):
        own = f"cuda:{k % gpus}" if gpus else device
        workers.append(context.Process(target=_work, args=(k, folders, options, meshes, start, own, until)))
        workers[-1].start()
    for worker in workers:
        worker.join()
        if worker.exitcode:
            log.warning("a process that made scenes ended with exit status %d; its scenes are missing", worker.exitcode)


def _work(
    number: int, folders: Sequence[Path], options: MaskTraining, meshes: Sequence[Path], start: Path, device: str,
    until: float,
) -> None:  # fmt: skip
    """Examples of every `options.workers`-th scene that is there, then of new scenes until the time `until`."""
    if options.workers:
        torch.set_num_threads(1)
    model = load_segmenter(start, device)
    there = [p for folder in folders for p in sorted(Path(folder).glob(f"*/{scenes.OBSERVED.format('*')}"))]
    stride = max(1, options.workers)
    for file in there[number::stride]:
        write_masks(model, file, options)
    index = number
    while time.time() < until:
        made = scenes.ClutterOptions(count=1, first=index, reconstruct=True, seed=options.seed, device=device)
        try:
            list(scenes.run(folders[0], made, meshes))
            write_masks(
                model, Path(folders[0]) / f"{index:04d}" / scenes.OBSERVED.format(scenes.RECONSTRUCTED), options
            )
        except (InputError, torch.OutOfMemoryError) as error:
            log.warning("scene %d: %s", index, error)
        if device.startswith("cuda"):
            torch.cuda.empty_cache()
        index += stride


def write_masks(model: Segmenter, file: Path, options: MaskTraining) -> None:
    """Write the examples of an observation and of turned copies of it beside it, those that are missing."""
    example = read_example(file)
    for copy in range(1 + options.copies):
        path = file.parent / EXAMPLES.format(file.stem, copy)
        if path.exists():
            continue
        rng = np.random.default_rng([options.seed, copy, int(sha256(file)[:8], 16)])
        own = turned(example, rng) if copy else example
        found = [item for scale in SCALES if (item := mask_examples(model, own, scale)) is not None]
        with replacing(path) as part:
            torch.save([{**vars(m), "seen": vars(m.seen), "boxes": vars(m.boxes)} for m in found], part)


def read_masks(path: Path, device: torch.device | str) -> list[MaskExamples]:
    """Examples of a file."""
    rows = torch.load(path, map_location=device, weights_only=True)
    return [
        MaskExamples(**{**row, "seen": Surroundings(**row["seen"]), "boxes": Boxes(**row["boxes"])}) for row in rows
    ]


def turned(example: Example, rng: np.random.Generator) -> Example:
    """The example turned about the vertical, mirrored, and at another scale."""
    angle = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    R = torch.from_numpy(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.diag([rng.choice([-1, 1]), 1, 1])).float()
    scale, surfels = float(np.exp(rng.uniform(*np.log(COPY_SCALES)))), example.surfels
    moved = {name: getattr(surfels, name) @ R.mT for name in ("points", "normals", "toward")}
    return Example(replace(surfels, **moved).enlarged(scale), example.labels)


@torch.no_grad()
def mask_examples(model: Segmenter, example: Example, scale: float) -> MaskExamples | None:
    """Examples of the scene enlarged by `scale`; None without candidates.

    At most MAX_VOXELS are used, as in `ngff segment`, which bounds the memory.
    """
    device = model.input_projection.weight.device
    surfels, labels = example.surfels.enlarged(scale).to(device), example.labels
    grid = voxelise(surfels)
    if len(grid) > MAX_VOXELS:
        distance = grid.points.norm(dim=1)
        near = (distance <= distance.kthvalue(MAX_VOXELS).values)[grid.owner]
        grid, labels = voxelise(surfels[near]), labels[near.cpu()]
    levels = pyramid(grid.cells, len(model.config["widths"]))
    found = model(grid.features, levels)
    candidates = find_candidates(grid, levels, found, model)
    ious = model.score(candidates.features.to(device)).sigmoid().cpu()
    owner = grid.owner.cpu()
    scored = ScoredCandidates(candidates, ious, candidates.extents / scale, owner, found.logits.cpu()[owner])
    nodes = plausible(candidates, ious, scored.usable(SegmenterOptions.min_size))
    if not len(nodes):
        return None
    seen = surroundings(grid, found, candidates)
    weights = candidates.sums(torch.bincount(owner, minlength=len(grid))[:, None])[:, 0]
    here = VoxelGrid(*(getattr(grid, name).cpu() for name in VoxelGrid.__dataclass_fields__))
    small = replace(seen.to("cpu", torch.float16), points=seen.points.cpu())
    placed = boxes(candidates, seen, nodes, model, scale).to("cpu")
    true = true_iou(candidates, here, labels)[nodes]
    return MaskExamples(small, placed, true, torch.from_numpy(weights).float()[nodes] ** SIZE_POWER)


def train_masks(model: Segmenter, examples: Sequence[MaskExamples], options: MaskTraining) -> Iterator[str]:
    """Train `model.mask_scorer` in place on examples on its device; yields a line every REPORT_STEPS steps."""
    torch.manual_seed(options.seed)
    rng, scorer = np.random.default_rng([options.seed, 3]), model.mask_scorer.train()
    on_gpu = model.feature_mean.is_cuda
    optimiser = torch.optim.AdamW(scorer.parameters(), RATE, weight_decay=0.01)
    begun, step, losses = time.monotonic(), 0, []
    while (part := step / options.steps if options.steps else (time.monotonic() - begun) / (60 * options.minutes)) < 1:
        warm, decay = min(1, (step + 1) / 100), 0.5 * (1 + np.cos(np.pi * part))
        optimiser.param_groups[0]["lr"] = RATE * warm * (0.01 + 0.99 * decay)
        batch = [
            sampled(examples[k], options.batch[1], rng) for k in rng.integers(len(examples), size=options.batch[0])
        ]
        x, known, odds, true = (torch.cat(column) for column in zip(*batch, strict=True))
        with torch.autocast(x.device.type, torch.bfloat16, enabled=on_gpu):
            found = scorer(x.contiguous(memory_format=torch.channels_last_3d), known, odds)
        loss = binary_cross_entropy_with_logits(found.float(), true)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(scorer.parameters(), 1.0)
        optimiser.step()
        step += 1
        losses.append(loss.detach())
        if step % REPORT_STEPS == 0:
            mean = float(torch.stack(losses[-REPORT_STEPS:]).mean())
            yield f"step {step}, {time.monotonic() - begun:.0f} s, loss {mean:.4f}"
    scorer.eval()


def sampled(of: MaskExamples, count: int, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Augmented crops, what is known, present log odds and true IoUs of `count` random candidates.

    Half of them are drawn by their weight times the present score. Only what the network knows decides what is drawn,
    so that it learns the expected IoU.
    """
    device = of.ious.device
    weight = (of.weights * of.boxes.odds.sigmoid()).cpu().double().numpy()
    rows = np.concatenate([rng.integers(len(weight), size=count // 2),
                           rng.choice(len(weight), count - count // 2, p=weight / weight.sum())])  # fmt: skip
    rows = torch.from_numpy(rows).to(device)
    turn = int(rng.choice([-1, 1])), int(rng.choice([-1, 1])), bool(rng.integers(2))
    picked = of.boxes[rows]
    side = picked.side * float(np.exp(rng.uniform(*np.log(SIDE_RANGE))))
    middle = picked.middle + SHAKE * side[:, None] * torch.randn_like(picked.middle)
    moved = replace(picked, middle=middle, side=side).mirrored(*turn)
    x = crops(of.seen.to(device, torch.float32).mirrored(*turn), moved)
    x[:, COLOUR] *= float(rng.uniform(*COLOUR_RANGE))
    x = x + NOISE * x[:, :1] * torch.randn_like(x)
    return x, picked.known + KNOWN_NOISE * torch.randn_like(picked.known), picked.odds, of.ious[rows]


def held_out_losses(model: Segmenter, examples: Sequence[MaskExamples]) -> dict[str, float]:
    """Cross-entropy of the IoU over all candidates by the scores without and with masks, and by the mean of both.

    `least`: that of the true IoU, which no score can be better than.
    """
    if not examples:
        return {}
    before, true = torch.cat([m.boxes.odds for m in examples]).cpu(), torch.cat([m.ious for m in examples]).cpu()
    device = model.feature_mean.device
    after = torch.cat([corrected(m.seen.to(device, torch.float32), m.boxes, model) for m in examples])
    best = true.clamp(1e-6, 1 - 1e-6).logit()
    scores = {"before": before, "masks": after, "mean": (before + after) / 2, "least": best}
    return {name: round(float(binary_cross_entropy_with_logits(x, true)), 4) for name, x in scores.items()}


def _save(
    out: Path, model: Segmenter, options: MaskTraining, count: int, start: Path, losses: dict[str, float]
) -> None:
    """Weights in half precision, and their card."""
    with replacing(Path(out)) as part:
        save_file({k: v.detach().cpu().contiguous().half() for k, v in model.state_dict().items()}, part)
    card = {"model": "segmenter", "config": model.config, "sha256": sha256(out), "from": sha256(start),
            "training": asdict(options), "scenes": count, "held_out": losses}  # fmt: skip
    with replacing(Path(out).with_suffix(".json")) as part:
        part.write_text(json.dumps(card, indent=1))
