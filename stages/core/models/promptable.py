"""Interface of promptable video segmentation networks, such as SAM 2.1.

A network that offers `PromptableSegmenter` can be used by `ngff segment`; see stages/segment/README.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

# labels of the points of a prompt, numbered as in the public code of SAM; a box is given by two corners
BACKGROUND_POINT, FOREGROUND_POINT, BOX_TOP_LEFT, BOX_BOTTOM_RIGHT = 0, 1, 2, 3


@dataclass(frozen=True)
class PointPrompts:
    """Points that mark one object in one photo."""

    points: Float[Tensor, "k 2"]  # x, y as fractions of the photo's width and height
    labels: Int[Tensor, "k"]  # BACKGROUND_POINT or FOREGROUND_POINT; or BOX_TOP_LEFT and BOX_BOTTOM_RIGHT

    @classmethod
    def box(cls, corners: Float[Tensor, "4"]) -> PointPrompts:
        """A bounding box x0 y0 x1 y1 around the object."""
        return cls(corners.reshape(2, 2), torch.tensor([BOX_TOP_LEFT, BOX_BOTTOM_RIGHT]))

    @classmethod
    def inside(cls, point: Float[Tensor, "2"]) -> PointPrompts:
        """A single point on the object."""
        return cls(point[None], torch.tensor([FOREGROUND_POINT]))


Prompts = Sequence[PointPrompts] | Bool[Tensor, "o l l"]  # each marks one object, by points or by its mask
FrameReader = Callable[[int], Float[Tensor, "3 s s"]]  # the network input of a frame
MaskLogits = Iterator[tuple[int, Float[Tensor, "o l l"]]]  # a frame, and the logits of each object in it


class PromptableSegmenter(Protocol):
    """A network that segments a photo from prompts and propagates masks through a sequence of photos.

    Masks and logits are square, of any side l; they cover the whole photo.
    """

    def preprocess(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "3 s s"]:
        """Return the network input for a photo (RGB, 0..1)."""
        ...

    def propose_masks(self, pixels: Float[Tensor, "3 s s"]) -> Bool[Tensor, "m l l"]:
        """Return masks of all regions of a photo, without prompts; they may overlap, and include parts of objects."""
        ...

    def propagate(self, frame: FrameReader, count: int, prompts: Prompts, start: int = 0) -> MaskLogits:
        """Yield mask logits (positive inside) of all objects for each of `count` frames, in any order of frames.

        Each of the `prompts` marks one object in frame `start`.
        """
        ...
