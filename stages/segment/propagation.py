"""Propagation of masks in one view to label images of all views, by a promptable network."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from tqdm import tqdm

from stages.core.models.promptable import PromptableSegmenter, Prompts
from stages.core.perception.voting import voting_intrinsics
from stages.core.scene.scene import Scene
from stages.segment.view_images import ViewImages


@dataclass(frozen=True)
class MaskTracker:
    """A network and the sequence of images through which it propagates masks."""

    network: PromptableSegmenter
    scene: Scene
    images: ViewImages

    def pixels(self, row: int) -> Float[Tensor, "3 s s"]:
        """Network input for image `row` of the sequence."""
        return self.network.preprocess(self.images.image(self.images.views[row]))

    def proposals(self, row: int) -> Bool[Tensor, "m l l"]:
        """Masks that the network proposes for image `row` without prompts."""
        return self.network.propose_masks(self.pixels(row))

    def labels(self, prompts: Prompts, start: int = 0) -> Iterator[tuple[int, Int[Tensor, "h w"]]]:
        """Yield the index and label image of each camera, at the resolution of voting.

        Objects have the labels 1... in the order of the prompts. The prompts refer to image `start` of the sequence.
        """
        count = len(self.images)
        found = self.network.propagate(self.pixels, count, prompts, start)
        for row, logits in tqdm(found, total=count, desc=f"tracking {len(prompts)} objects", unit="photo"):
            view = self.images.views[row]
            yield view, label_image(logits, *voting_intrinsics(self.scene, view)[:2])


def label_image(logits: Float[Tensor, "o l l"], width: int, height: int) -> Int[Tensor, "h w"]:
    """Number, from 1, of the object with the largest logit at each pixel; 0 where no logit is positive."""
    best, index = resize_logits(logits, width, height).max(0)
    return torch.where(best > 0, index + 1, 0)


def resize_logits(logits: Float[Tensor, "o l l"], width: int, height: int) -> Float[Tensor, "o h w"]:
    """Resize square logits or masks of the network to the size of an image."""
    size = (height, width)
    return torch.nn.functional.interpolate(logits[None].float(), size, mode="bilinear", align_corners=False)[0]
