"""How far pictures confirm that objects are where they are drawn."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from stages.lab.track.alignment import Observation
from stages.lab.track.poses import Poses
from stages.lab.track.synthesis import Synthesiser

MIN_PIXELS = 12  # of an object in a picture that says something about it
MIN_SCALE = 0.1  # smallest scale of residuals: difference of a colour
SCALE_FACTOR = 3.0  # of that difference to the median where the objects are known to be
CHANCE = 0.25  # share of the pixels of an object at a wrong pose that may confirm it
CONFIRMED = 0.6  # share of such pixels above which a picture confirms an object
MIN_VIEWS = 2  # pictures that must confirm an object


def differences(
    synthesiser: Synthesiser, observations: Sequence[Observation], poses: Poses
) -> list[list[Float[Tensor, "p"]]]:
    """Difference in colour of the pixels that show each object, by picture and object."""
    rows = range(len(synthesiser.rest))
    found = []
    for seen in observations:
        drawn = seen.draw(synthesiser, poses)
        off = seen.difference(drawn).square().mean(-1).sqrt()
        found.append([off[drawn.label == i] for i in rows])
    return found


def scales(right: list[list[Tensor]]) -> list[float]:
    """For each object the scale of its residuals, from differences where its pose is known."""
    joined = [torch.cat(parts) for parts in zip(*right, strict=True)]
    return [max(SCALE_FACTOR * float(d.median()), MIN_SCALE) if len(d) else MIN_SCALE for d in joined]


def tolerances(wrong: list[list[Tensor]], scale: Sequence[float]) -> list[float]:
    """For each object the difference up to which a pixel confirms it: that which CHANCE of its pixels have at wrong
    poses, but at least the scale of its residuals.

    Residuals at the release do not tell: the scene was fitted to these pictures. Other sides of an object, seen later,
    are known less well.
    """
    joined = [torch.cat(parts) for parts in zip(*wrong, strict=True)]
    return [max(float(d.quantile(CHANCE)), s) if len(d) else s for d, s in zip(joined, scale, strict=True)]


def confidences(found: list[list[Tensor]], tolerance: Sequence[float]) -> tuple[Float[Tensor, "o"], Float[Tensor, "o"]]:
    """Share of the pixels of each object that confirm it, 0 where fewer than MIN_VIEWS pictures do; and their number.

    With one camera a single picture is enough.
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
