"""Automatic mask generation: masks of a photo from a regular grid of point prompts, filtered by predicted quality.

Source: Kirillov et al. 2023, "Segment Anything", section 5 and appendix B; thresholds as published with SAM 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from transformers import Sam2VideoModel

from stages.core.models.promptable import FOREGROUND_POINT
from stages.core.models.sam2.network import input_side


@dataclass(frozen=True)
class MaskGenerationOptions:
    """Density of the point grid and the quality thresholds of masks."""

    grid: int = 16  # points along each side; 32 as published, but here several photos of one scene are searched
    batch: int = 16  # points decoded together, about 30 MB each
    min_iou: float = 0.8  # smallest IoU that the network predicts for a mask
    min_stability: float = 0.95  # smallest IoU of a mask thresholded at a higher and at a lower value
    max_iou: float = 0.7  # masks with a larger IoU are duplicates


@dataclass(frozen=True)
class MaskProposals:
    """Candidate masks of objects or parts of objects, highest score first."""

    masks: Bool[Tensor, "m l l"]
    scores: Float[Tensor, "m"]  # predicted intersection over union


@torch.no_grad()
def propose_masks(
    model: Sam2VideoModel, pixels: Float[Tensor, "3 s s"], options: MaskGenerationOptions = MaskGenerationOptions()
) -> MaskProposals:
    """Return masks of a photo, at a quarter of the network's input size; up to three of different extent per point.

    Peak memory is that of `batch` points, plus 1 byte per pixel of each mask that is kept.
    """
    embeddings = model.get_image_embeddings(pixels[None].to(model.device))
    position = model.get_image_wide_positional_embeddings()
    masks, scores = [], []
    for grid_points in _grid(options.grid).split(options.batch):
        points = grid_points[None, :, None].to(model.device) * input_side(model)
        labels = torch.full(points.shape[:-1], FOREGROUND_POINT, dtype=torch.int32, device=model.device)
        sparse, dense = model.get_prompt_embeddings(points, labels)
        logits, predicted, _, _ = model.mask_decoder(
            image_embeddings=embeddings[-1], image_positional_embeddings=position, sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense, multimask_output=True, high_resolution_features=embeddings[:-1],
        )  # fmt: skip
        logits, predicted = logits.flatten(0, 2).float(), predicted.flatten().float()
        good = (predicted >= options.min_iou) & (mask_stability(logits) >= options.min_stability)
        masks.append((logits[good] > 0).cpu())
        scores.append(predicted[good].cpu())
    masks, scores = torch.cat(masks), torch.cat(scores)
    kept = suppress_duplicates(masks, scores, options.max_iou)
    return MaskProposals(masks[kept], scores[kept])


def _grid(side: int) -> Float[Tensor, "k 2"]:
    """Centres x, y of side x side equal cells, as fractions of the photo."""
    middles = (torch.arange(side) + 0.5) / side
    return torch.stack(torch.meshgrid(middles, middles, indexing="xy"), -1).reshape(-1, 2)


def mask_stability(logits: Float[Tensor, "m h w"], offset: float = 1.0) -> Float[Tensor, "m"]:
    """Intersection over union of each mask thresholded at +`offset` and at -`offset`; 0 for an empty mask."""
    inner, outer = (logits > offset).sum((1, 2)), (logits > -offset).sum((1, 2))
    return inner / outer.clamp_min(1)


def suppress_duplicates(masks: Bool[Tensor, "m h w"], scores: Float[Tensor, "m"], max_iou: float) -> Int[Tensor, "k"]:
    """Non-maximum suppression: indices, best score first, of masks whose IoU with each better mask is <= `max_iou`.

    Masks are compared instead of bounding boxes, so that a ring and an object inside it are both kept. Empty masks are
    dropped.
    """
    flat = masks.flatten(1)
    areas = flat.sum(1)
    kept: list[int] = []
    for i in scores.argsort(descending=True, stable=True).tolist():
        if kept:
            shared = (flat[kept] & flat[i]).sum(1)
            if bool((shared > max_iou * (areas[kept] + areas[i] - shared)).any()):
                continue
        if areas[i]:
            kept.append(i)
    return torch.tensor(kept, dtype=torch.int64)
