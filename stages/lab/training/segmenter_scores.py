"""Training of the scores of candidate objects, after the rest of the segmentation network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.models.segmenter.candidates import MIN_VOXELS, Candidates, find_candidates
from stages.core.models.segmenter.network import Segmenter, pyramid
from stages.core.models.segmenter.voxels import SCALES, VoxelGrid, voxelise
from stages.lab.clutter.examples import read_example
from stages.lab.training.segmenter_data import augmented

BATCH, RATE = 512, 3e-3  # candidates of each kind per step, and maximum learning rate
# Candidates with at least this many voxels, and with at least this IoU, each make up a third of a batch, since most
# candidates are small and bad.
LARGE, GOOD = 20, 0.3
MIN_SURFELS = 60  # smallest number of surfels of a true object
FLOATER_WEIGHT = 0.3  # weight of surfels without a true label in the size of a candidate
MAX_SURFELS = 160_000  # largest number of surfels of an example
JITTER = 0.05  # standard deviation of noise added to the normalised features


class _Candidates(Dataset):
    """Features and true IoUs of all candidates in `scenes` augmented examples; None if their size is unsuitable."""

    def __init__(self, model: Segmenter, files: Sequence[Path], scenes: int, seed: int):
        self.model, self.files, self.scenes, self.seed = model, list(files), scenes, seed

    def __len__(self) -> int:
        return self.scenes

    @torch.no_grad()
    def __getitem__(self, k: int) -> tuple[Tensor, Tensor] | None:
        rng = np.random.default_rng([self.seed, 1, k])
        surfels, labels = augmented(read_example(self.files[k % len(self.files)]), rng)
        if not LARGE <= len(surfels) <= MAX_SURFELS:
            return None
        grid = voxelise(surfels.enlarged(float(rng.choice(SCALES))))
        levels = pyramid(grid.cells, len(self.model.config["widths"]))
        found = find_candidates(grid, levels, self.model(grid.features, levels), self.model)
        keep = found.sizes > MIN_VOXELS - 0.5
        return found.features[keep], true_iou(found, grid, labels)[keep]


def fit_scores(
    model: Segmenter, files: Sequence[Path], scenes: int, steps: int, seed: int, workers: int = 0
) -> dict[str, float]:
    """Train `model.score` in place on the candidates in `scenes` augmented examples; return figures for the card.

    The examples are prepared by `workers` processes; the result does not depend on their number.
    """
    torch.manual_seed(seed)
    model = model.cpu().eval()
    examples = DataLoader(_Candidates(model, files, scenes, seed), batch_size=None, num_workers=workers)
    found = [item for item in tqdm(examples, total=scenes, desc="candidates", unit="scene") if item is not None]
    if not found:
        raise InputError(f"none of {scenes} examples has {LARGE} to {MAX_SURFELS} surfels; increase --score-scenes")
    x, y = (torch.cat(column) for column in zip(*found, strict=True))
    model.feature_mean.copy_(x.mean(0))
    model.feature_scale.copy_(x.std(0) + 1e-6)
    loss = _train(model, x, y, steps)
    return {"scenes": len(found), "candidates": len(x), "loss": round(loss, 4)}


def _train(model: Segmenter, x: Float[Tensor, "k f"], y: Float[Tensor, "k"], steps: int) -> float:
    """Train the score head; return the mean loss of the last hundred steps."""
    optimiser = torch.optim.AdamW(model.candidate_head.parameters(), RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    groups = [torch.arange(len(x)), torch.nonzero(x[:, 0].exp() >= LARGE)[:, 0], torch.nonzero(y > GOOD)[:, 0]]
    losses = []
    for _ in tqdm(range(steps), desc="scores", unit="step"):
        rows = torch.cat([group[torch.randint(len(group), (BATCH,))] for group in groups if len(group)])
        noisy = x[rows] + JITTER * model.feature_scale * torch.randn(len(rows), x.shape[1])
        loss = binary_cross_entropy_with_logits(model.score(noisy), y[rows])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()))
    return float(np.mean(losses[-100:]))


def true_iou(found: Candidates, grid: VoxelGrid, labels: Int[Tensor, "n"]) -> Float[Tensor, "k"]:
    """IoU of each candidate with the best-fitting true object, in surfels."""
    count = int(labels.max()) + 1 if len(labels) else 1
    judged, total = labels >= 0, torch.bincount(grid.owner, minlength=len(grid)).double()
    known = torch.bincount(grid.owner[judged], minlength=len(grid)).double()
    size = found.sums((known + FLOATER_WEIGHT * (total - known))[:, None])
    true = torch.bincount(labels[judged], minlength=count).double()
    objects = [k for k in range(1, count) if true[k] >= MIN_SURFELS]
    if not objects:
        return torch.zeros(len(found.tree))
    owned = torch.stack([torch.bincount(grid.owner[labels == k], minlength=len(grid)) for k in objects], 1)
    both = found.sums(owned)
    return torch.from_numpy((both / (size + true[objects].numpy() - both)).max(1)).float()
