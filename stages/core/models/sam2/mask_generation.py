"""Masks of whatever is in a photo, without a word or a click: a grid of clicks, and the masks that are sure.

Source: Kirillov et al. 2023, "Segment Anything", section 5 and appendix B; thresholds as published with SAM 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from transformers import Sam2VideoModel

from stages.core.models.sam2.network import INSIDE, input_side


@dataclass(frozen=True)
class MaskGenerationOptions:
    """How many clicks, and what a mask must reach."""

    grid: int = 16  # clicks along each side; published is 32, but here several photos are asked about one scene
    at_once: int = 16  # clicks decoded together, each in about 30 MB
    iou: float = 0.8  # that the network itself predicts for the mask
    stability: float = 0.95  # overlap of the mask drawn tighter and drawn looser
    same: float = 0.7  # masks that overlap more than this are one


@dataclass(frozen=True)
class MaskProposals:
    """Masks that may be objects or parts of them, the surest first."""

    masks: Bool[Tensor, "m l l"]
    scores: Float[Tensor, "m"]  # predicted intersection over union


@torch.no_grad()
def propose_masks(
    model: Sam2VideoModel, pixels: Float[Tensor, "3 s s"], options: Automatic = MaskGenerationOptions()  # noqa: B008 -- frozen
) -> MaskProposals:
    """Masks of a photo, at a quarter of the network's size; each click gives up to three: a thing, its part, its whole.

    Memory is that of `at_once` clicks, and a byte a pixel of each mask that is kept.
    """
    embeddings = model.get_image_embeddings(pixels[None].to(model.device))
    where = model.get_image_wide_positional_embeddings()
    masks, scores = [], []
    for clicks in _grid(options.grid).split(options.at_once):
        points = clicks[None, :, None].to(model.device) * input_side(model)
        labels = torch.full(points.shape[:-1], INSIDE, dtype=torch.int32, device=model.device)
        sparse, dense = model.get_prompt_embeddings(points, labels)
        logits, predicted, _, _ = model.mask_decoder(
            image_embeddings=embeddings[-1], image_positional_embeddings=where, sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense, multimask_output=True, high_resolution_features=embeddings[:-1],
        )  # fmt: skip
        logits, predicted = logits.flatten(0, 2).float(), predicted.flatten().float()
        sure = (predicted >= options.iou) & (mask_stability(logits) >= options.stability)
        masks.append((logits[sure] > 0).cpu())
        scores.append(predicted[sure].cpu())
    masks, scores = torch.cat(masks), torch.cat(scores)
    kept = suppress_duplicates(masks, scores, options.same)
    return MaskProposals(masks[kept], scores[kept])


def _grid(side: int) -> Float[Tensor, "k 2"]:
    """Points x, y in the middles of side x side equal cells [share of the photo]."""
    middles = (torch.arange(side) + 0.5) / side
    return torch.stack(torch.meshgrid(middles, middles, indexing="xy"), -1).reshape(-1, 2)


def mask_stability(logits: Float[Tensor, "m h w"], offset: float = 1.0) -> Float[Tensor, "m"]:
    """Intersection over union of each mask cut at `offset` above and below its border; 0 for an empty one."""
    inner, outer = (logits > offset).sum((1, 2)), (logits > -offset).sum((1, 2))
    return inner / outer.clamp_min(1)


def suppress_duplicates(masks: Bool[Tensor, "m h w"], scores: Float[Tensor, "m"], same: float) -> Int[Tensor, "k"]:
    """Non-maximum suppression: indices, best score first, of masks that overlap no better one by more than `same`.

    Masks themselves are compared, not the boxes around them, so a ring and what lies in it both stay.
    """
    flat = masks.flatten(1)
    areas = flat.sum(1)
    kept: list[int] = []
    for i in scores.argsort(descending=True, stable=True).tolist():
        if kept:
            shared = (flat[kept] & flat[i]).sum(1)
            if bool((shared > same * (areas[kept] + areas[i] - shared)).any()):
                continue
        if areas[i]:
            kept.append(i)
    return torch.tensor(kept, dtype=torch.int64)
