"""Colours of the sides of objects that are not visible at the release, learned from later images.

A Gaussian not seen at the release gets the median, over the latest frames in which it is seen, of its current colour
plus the difference between image and rendering there. Where several Gaussians share a pixel, this becomes sharper from
frame to frame, and colours that are already right do not change. Colours are learned only while an object has been
tracked without a gap for some frames, and only from images that agree with its known colours.
Source: Irani and Peleg 1991, "Improving resolution by image registration" (iterative back-projection).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.cameras import depths, project
from stages.lab.track.alignment import Observation
from stages.lab.track.confidence import CONFIRMED, MIN_PIXELS
from stages.lab.track.poses import Poses
from stages.lab.track.synthesis import Synthesiser

BEHIND = 0.1  # largest depth of a visible Gaussian behind the rendered surface [object sizes]
LATEST = 9  # number of latest frames over which the median is taken
ENOUGH = 3  # smallest number of the LATEST frames in which a Gaussian must be seen to learn its colour


class Sightings(NamedTuple):
    """Visibility and residual of the Gaussians of all objects in one image."""

    seen: Bool[Tensor, "n"]  # inside the outline of their object, and not occluded
    off: Float[Tensor, "n c"]  # image minus rendering at the pixel of the Gaussian


class LaterColours:
    """Which Gaussians of a synthesiser have known colours, and the colours observed for the others."""

    def __init__(self, synthesiser: Synthesiser, first: Sequence[Observation], tolerance: Sequence[float]):
        self.synthesiser, self.tolerance = synthesiser, torch.tensor(tolerance, device=synthesiser.device)
        rest = synthesiser.at_rest()
        self.known = torch.stack([sightings(synthesiser, o, rest).seen for o in first]).any(0)
        self.unseen = (~self.known).nonzero()[:, 0]  # rows of the Gaussians not seen at the release
        self._latest: deque[Float[Tensor, "m 3"]] = deque(maxlen=LATEST)  # colours of `unseen`, nan where not seen

    def learn(self, pictures: Sequence[Observation], poses: Poses, followed: Bool[Tensor, "o"]) -> None:
        """Learn from the images of a frame the colours of the objects that were `followed` up to it."""
        row = self.synthesiser.row
        if not followed[row[self.unseen]].any():
            return
        views = []
        for picture in pictures:
            found = sightings(self.synthesiser, picture, poses)
            used = found.seen & (followed & self._agrees(found))[row]
            views.append(torch.where(used[:, None], found.off[:, :3], torch.nan)[self.unseen])
        off = torch.stack(views).nanquantile(0.5, dim=0)
        self._latest.append(self.synthesiser.colours[self.unseen] + off)
        latest = torch.stack(tuple(self._latest))
        enough = (~latest[..., 0].isnan()).sum(0) >= ENOUGH
        if enough.any():
            self.known[self.unseen[enough]] = True
            self.synthesiser.recolour(self.unseen[enough], latest[:, enough].nanquantile(0.5, dim=0))

    def _agrees(self, found: Sightings) -> Bool[Tensor, "o"]:
        """Whether an image agrees with the known colours of each object."""
        row, shown = self.synthesiser.row, (found.seen & self.known).float()
        near = shown * (found.off.square().mean(1).sqrt() < self.tolerance[row])
        total, close = (torch.zeros_like(self.tolerance).index_add_(0, row, x) for x in (shown, near))
        return (total >= MIN_PIXELS) & (close >= CONFIRMED * total)


def sightings(synthesiser: Synthesiser, picture: Observation, poses: Poses) -> Sightings:
    """Visibility and residuals of the Gaussians in an image, with the objects at these poses."""
    drawn, row, camera = picture.draw(synthesiser, poses), synthesiser.row, picture.camera
    means = poses.moved(picture.displacement).place(synthesiser.arm, row)
    height, width = drawn.label.shape
    x, y = (project(means, camera.viewmat, camera.K) / picture.reduction).floor().long().unbind(1)
    depth = depths(means, camera.viewmat)
    inside = (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    at = y.clamp(0, height - 1), x.clamp(0, width - 1)
    front = depth < drawn.depth[at] + BEHIND * synthesiser.sizes[row]
    return Sightings(inside & front & (_inner(drawn.label)[at] == row), picture.difference(drawn)[at])


def _inner(label: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
    """The labels, with -1 in pixels on outlines."""
    high, low = (sign * F.max_pool2d(sign * label[None, None].float(), 3, 1, 1)[0, 0] for sign in (1, -1))
    return torch.where(high == low, label, -1)
