"""A camera that turns after what moves, and widens its lens or steps back where turning is not enough."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import look_at
from stages.render.subject import Subject

EDGE = 0.95  # of the picture, for what moves
WIDEST = 0.75  # of the wanted focal length, and
BACK = 1.5  # of the wanted distance, at most: beyond the edges of the photos little is known
CALM = 0.03  # of the film, over which a turn is spread


def pan(
    subject: Subject, arms: Float[Tensor, "t 3"], aim: Float[Tensor, "3"], size: tuple[int, int], focal: float
) -> tuple[Float[Tensor, "t 4 4"], float]:
    """World-to-camera and focal length [px] of cameras that stand off the subject by `arms` and look at `aim`.

    They turn no more than it takes to have what moves in pictures of this `size` at this `focal` length.
    """
    points = _at_frames(subject.moving, len(arms)) if subject.moving is not None else None
    back = 1.0
    while True:
        viewmats = _turned(points, subject, back * arms, aim, EDGE / 2 / focal * torch.tensor(size))
        longest = math.inf
        if points is not None:
            reach = torch.stack(_bounds(points, viewmats)).abs().amax((0, 1)).clamp_min(1e-9)
            longest = EDGE / 2 * min(size[0] / float(reach[0]), size[1] / float(reach[1]))
        if longest >= WIDEST * focal or back >= BACK:
            return viewmats, min(focal, max(longest, WIDEST * focal))
        back *= 1.05


def _turned(
    points: Float[Tensor, "t m 3"] | None, subject: Subject, arms: Float[Tensor, "t 3"], aim: Float[Tensor, "3"],
    half: Float[Tensor, "2"],
) -> Float[Tensor, "t 4 4"]:  # fmt: skip
    """Each camera turned until `points` have slopes x / z and y / z within `half`, or are in the middle."""
    eyes, aims = subject.target + arms, aim.expand_as(arms)
    viewmats = look_at(eyes, aims)
    if points is None:
        return viewmats
    far = (aim - eyes).norm(dim=1, keepdim=True)
    for _ in range(3):
        low, high = _bounds(points, viewmats)
        off = (high - half).clamp_min(0) + (low + half).clamp_max(0)
        off = torch.where(high - low > 2 * half, (low + high) / 2, off).clamp(-1, 1)
        aims = aims + torch.einsum("ta,tai->ti", far * off, viewmats[:, :2, :3])
        viewmats = look_at(eyes, aims)
    return look_at(eyes, aim + _calm(aims - aim))


def _bounds(points: Float[Tensor, "t m 3"], viewmats: Float[Tensor, "t 4 4"]) -> tuple[Tensor, Tensor]:
    """Lowest and highest x / z and y / z of the points (t, 2) as each camera sees them."""
    seen = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    least = 0.05 * seen[..., 2].abs().amax(1)[:, None, None].clamp_min(1e-9)
    slopes = seen[..., :2] / torch.maximum(seen[..., 2:], least)
    return slopes.amin(1), slopes.amax(1)


def _at_frames(moving: Float[Tensor, "k m 3"], frames: int) -> Float[Tensor, "t m 3"]:
    """What moves, in between the moments at which it is known; a single frame sees the middle of the film."""
    at = torch.linspace(0, len(moving) - 1, frames) if frames > 1 else torch.tensor([(len(moving) - 1) / 2])
    first = at.long().clamp(max=max(len(moving) - 2, 0))
    last = (first + 1).clamp(max=len(moving) - 1)
    return torch.lerp(moving[first], moving[last], (at - first)[:, None, None])


def _calm(turns: Float[Tensor, "t 3"]) -> Float[Tensor, "t 3"]:
    """Running averages (Gaussian) over a little of the film; its ends go on as they are."""
    width = CALM * len(turns)
    reach = math.ceil(3 * width)
    weight = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / max(width, 1e-6)) ** 2)
    padded = torch.cat([turns[:1].expand(reach, 3), turns, turns[-1:].expand(reach, 3)])
    return torch.einsum("tiw,w->ti", padded.unfold(0, 2 * reach + 1, 1), weight / weight.sum())
