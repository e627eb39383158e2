"""Prompts in one view become label images of all views, by SAM 2.1's memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from tqdm import tqdm
from transformers import Sam2VideoModel

from stages.core.models.sam2.network import PointPrompts, input_side, pixel_values, propagate_masks
from stages.core.scene.scene import Scene
from stages.segment.view_images import ViewImages
from stages.segment.voting import voting_intrinsics


@dataclass(frozen=True)
class MaskTracker:
    """A network, and the sequence of pictures that it follows objects through."""

    model: Sam2VideoModel
    scene: Scene
    shown: ViewImages

    def pixels(self, row: int) -> Float[Tensor, "3 s s"]:
        """What the network is fed of a picture."""
        return pixel_values(self.shown.image(self.shown.views[row]), input_side(self.model))

    def labels(
        self, prompts: Sequence[PointPrompts] | Bool[Tensor, "o l l"], start: int = 0
    ) -> Iterator[tuple[int, Int[Tensor, "h w"]]]:
        """Each camera with its label image (1... in the order of the prompts), at the size that votes are counted at.

        `start` is the picture that the prompts are about.
        """
        count = len(self.shown)
        found = propagate_masks(self.model, self.pixels, count, prompts, start)
        for row, logits in tqdm(found, total=count, desc=f"following {len(prompts)} objects", unit="photo"):
            view = self.shown.views[row]
            yield view, label_image(logits, *voting_intrinsics(self.scene, view)[:2])


def label_image(logits: Float[Tensor, "o l l"], width: int, height: int) -> Int[Tensor, "h w"]:
    """The object whose mask is surest of each pixel, counted from 1; 0 where no logit is positive."""
    best, index = resize_logits(logits, width, height).max(0)
    return torch.where(best > 0, index + 1, 0)


def resize_logits(logits: Float[Tensor, "o l l"], width: int, height: int) -> Float[Tensor, "o h w"]:
    """From the network's square back to the proportions of the picture."""
    size = (height, width)
    return torch.nn.functional.interpolate(logits[None].float(), size, mode="bilinear", align_corners=False)[0]
