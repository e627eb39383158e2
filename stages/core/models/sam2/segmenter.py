"""SAM 2.1 behind the interface `PromptableSegmenter`."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor
from transformers import Sam2VideoModel

from stages.core.models.promptable import FrameReader, MaskLogits, Prompts
from stages.core.models.sam2.mask_generation import propose_masks
from stages.core.models.sam2.network import input_side, pixel_values, propagate_masks


@dataclass(frozen=True)
class Sam2Segmenter:
    """A loaded SAM 2.1 network; see `PromptableSegmenter` for the methods."""

    model: Sam2VideoModel

    def preprocess(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "3 s s"]:
        """The network input for a photo."""
        return pixel_values(image, input_side(self.model))

    def propose_masks(self, pixels: Float[Tensor, "3 s s"]) -> Bool[Tensor, "m l l"]:
        """Automatic masks of a photo, highest predicted IoU first."""
        return propose_masks(self.model, pixels).masks

    def propagate(self, frame: FrameReader, count: int, prompts: Prompts, start: int = 0) -> MaskLogits:
        """Mask logits of all objects for each frame, from `start` to the end, then backwards to the first."""
        return propagate_masks(self.model, frame, count, prompts, start)
