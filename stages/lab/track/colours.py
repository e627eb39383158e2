"""Colours of the sides of objects that no picture of the first frame shows, learned from later pictures.

A Gaussian that was not seen at the release takes the median, over the latest frames in which it is seen, of its colour
then and what the picture differed there from the rendering: where several Gaussians share a pixel, this becomes sharper
from frame to frame, and colours that were right stay. An object is learned from where it was followed without a gap
for some frames, and from those pictures that agree with what is known of it already.
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

BEHIND = 0.1  # how far a Gaussian that is seen may be behind the surface drawn there [sizes of its object]
LATEST = 9  # frames of which the median is taken
ENOUGH = 3  # the fewest of them in which a Gaussian is seen


class Sightings(NamedTuple):
    """The Gaussians of all objects in one picture."""

    seen: Bool[Tensor, "n"]  # inside the outline of their object, in front
    off: Float[Tensor, "n c"]  # difference of the picture to the rendering there


class LaterColours:
    """Which Gaussians of a synthesiser have known colours, and the colours of others as they are seen."""

    def __init__(self, synthesiser: Synthesiser, first: Sequence[Observation], tolerance: Sequence[float]):
        self.synthesiser, self.tolerance = synthesiser, torch.tensor(tolerance, device=synthesiser.device)
        rest = synthesiser.at_rest()
        self.known = torch.stack([sightings(synthesiser, o, rest).seen for o in first]).any(0)
        self.unseen = (~self.known).nonzero()[:, 0]  # at the release
        self._latest: deque[Float[Tensor, "m 3"]] = deque(maxlen=LATEST)  # colours of these, nan where not seen

    def learn(self, pictures: Sequence[Observation], poses: Poses, followed: Bool[Tensor, "o"]) -> None:
        """Learn from the pictures of a frame, of the objects that were followed to their poses in it."""
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
        """Whether a picture has the colours of an object where it shows what is known of it."""
        row, shown = self.synthesiser.row, (found.seen & self.known).float()
        near = shown * (found.off.square().mean(1).sqrt() < self.tolerance[row])
        total, close = (torch.zeros_like(self.tolerance).index_add_(0, row, x) for x in (shown, near))
        return (total >= MIN_PIXELS) & (close >= CONFIRMED * total)


def sightings(synthesiser: Synthesiser, picture: Observation, poses: Poses) -> Sightings:
    """Which Gaussians of the objects at these poses a picture shows."""
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
    """The labels, -1 on outlines."""
    high, low = (sign * F.max_pool2d(sign * label[None, None].float(), 3, 1, 1)[0, 0] for sign in (1, -1))
    return torch.where(high == low, label, -1)
