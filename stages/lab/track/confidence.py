"""Confidence of poses: to what extent images agree with renderings of the objects."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from stages.lab.track.alignment import Observation
from stages.lab.track.poses import Poses
from stages.lab.track.synthesis import Synthesiser

MIN_PIXELS = 12  # smallest visible area of an object for an image to count [px]
MIN_SCALE = 0.1  # smallest scale of residuals [colours from 0 to 1]
SCALE_FACTOR = 3.0  # scale of residuals relative to their median where the poses are known
CHANCE = 0.25  # fraction of the pixels of an object at a wrong pose that may agree with the image by chance
CONFIRMED = 0.6  # fraction of agreeing pixels from which an image confirms an object
MIN_VIEWS = 2  # number of images that must confirm an object


def differences(
    synthesiser: Synthesiser, observations: Sequence[Observation], poses: Poses
) -> list[list[Float[Tensor, "p"]]]:
    """Colour difference of the pixels that show each object, by image and object."""
    rows = range(len(synthesiser.rest))
    found = []
    for seen in observations:
        drawn = seen.draw(synthesiser, poses)
        off = seen.difference(drawn).square().mean(-1).sqrt()
        found.append([off[drawn.label == i] for i in rows])
    return found


def scales(right: list[list[Tensor]]) -> list[float]:
    """Residual scale of each object, from differences at known poses."""
    joined = [torch.cat(parts) for parts in zip(*right, strict=True)]
    return [max(SCALE_FACTOR * float(d.median()), MIN_SCALE) if len(d) else MIN_SCALE for d in joined]


def tolerances(wrong: list[list[Tensor]], scale: Sequence[float]) -> list[float]:
    """Largest difference at which a pixel still confirms each object.

    It is the CHANCE quantile of the differences at wrong poses, but at least the residual scale. Residuals at the
    release would be too small: the scene was fitted to these images, and sides of an object seen later are known less
    well.
    """
    joined = [torch.cat(parts) for parts in zip(*wrong, strict=True)]
    return [max(float(d.quantile(CHANCE)), s) if len(d) else s for d, s in zip(joined, scale, strict=True)]


def confidences(found: list[list[Tensor]], tolerance: Sequence[float]) -> tuple[Float[Tensor, "o"], Float[Tensor, "o"]]:
    """Fraction of confirming pixels of each object (0 if fewer than MIN_VIEWS images confirm it), and number of pixels.

    If there is only one image, it is enough.
    """
    shares, pixels = [], []
    for parts, limit in zip(zip(*found, strict=True), tolerance, strict=True):
        counted = [d for d in parts if len(d) >= MIN_PIXELS]
        share = [float((d < limit).float().mean()) for d in counted]
        confirmed = sum(s >= CONFIRMED for s in share)
        number = sum(len(d) for d in counted)
        mean = sum(s * len(d) for s, d in zip(share, counted, strict=True)) / max(number, 1)
        shares.append(mean if confirmed >= min(MIN_VIEWS, len(found)) else 0.0)
        pixels.append(float(number))
    return torch.tensor(shares), torch.tensor(pixels)
