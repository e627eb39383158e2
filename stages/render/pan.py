"""A camera that pans with moving objects and, if that is not sufficient, zooms out or moves back."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import look_at
from stages.render.subject import Subject

FRAME_FRACTION = 0.95  # fraction of the image's width and height in which moving objects are kept
MIN_FOCAL_FACTOR = 0.75  # smallest focal length, relative to the requested one
MAX_DISTANCE_FACTOR = 1.5  # largest distance, relative to the requested one; photos show little beyond their borders
DISTANCE_STEP = 1.05  # factor by which the distance grows until everything fits
PAN_ITERATIONS = 3  # number of corrections of the viewing direction
SMOOTHING = 0.03  # standard deviation of the temporal smoothing of the pan [length of the video]
MIN_DEPTH_FRACTION = 0.05  # lower bound of depth in slopes [largest depth of the frame]
MAX_TURN = 1.0  # largest change of the viewing direction in one correction, as a slope


def pan(
    subject: Subject, offsets: Float[Tensor, "t 3"], aim: Float[Tensor, "3"], size: tuple[int, int], focal: float
) -> tuple[Float[Tensor, "t 4 4"], float]:
    """World-to-camera matrices and focal length [px] of cameras at `offsets` from the subject that look at `aim`.

    The cameras rotate by the minimum that keeps moving points within images of this `size` at this `focal` length [px].
    """
    points = _at_frames(subject.moving, len(offsets)) if subject.moving is not None else None
    distance_factor = 1.0
    while True:
        half_slopes = FRAME_FRACTION / 2 / focal * torch.tensor(size)
        viewmats = _turned(points, subject, distance_factor * offsets, aim, half_slopes)
        max_focal = math.inf
        if points is not None:
            slopes = torch.stack(_bounds(points, viewmats)).abs().amax((0, 1)).clamp_min(1e-9)
            max_focal = FRAME_FRACTION / 2 * min(size[0] / float(slopes[0]), size[1] / float(slopes[1]))
        if max_focal >= MIN_FOCAL_FACTOR * focal or distance_factor >= MAX_DISTANCE_FACTOR:
            return viewmats, min(focal, max(max_focal, MIN_FOCAL_FACTOR * focal))
        distance_factor *= DISTANCE_STEP


def _turned(
    points: Float[Tensor, "t m 3"] | None, subject: Subject, offsets: Float[Tensor, "t 3"], aim: Float[Tensor, "3"],
    half: Float[Tensor, "2"],
) -> Float[Tensor, "t 4 4"]:  # fmt: skip
    """Rotate each camera until the slopes x / z and y / z of its points are within +-`half`, or centred if too wide."""
    eyes, aims = subject.target + offsets, aim.expand_as(offsets)
    viewmats = look_at(eyes, aims)
    if points is None:
        return viewmats
    distance = (aim - eyes).norm(dim=1, keepdim=True)
    for _ in range(PAN_ITERATIONS):
        low, high = _bounds(points, viewmats)
        excess = (high - half).clamp_min(0) + (low + half).clamp_max(0)
        excess = torch.where(high - low > 2 * half, (low + high) / 2, excess).clamp(-MAX_TURN, MAX_TURN)
        aims = aims + torch.einsum("ta,tai->ti", distance * excess, viewmats[:, :2, :3])
        viewmats = look_at(eyes, aims)
    return look_at(eyes, aim + _smoothed(aims - aim))


def _bounds(points: Float[Tensor, "t m 3"], viewmats: Float[Tensor, "t 4 4"]) -> tuple[Tensor, Tensor]:
    """Lowest and highest slopes x / z and y / z (t, 2) of the points in each camera."""
    local = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    min_depth = MIN_DEPTH_FRACTION * local[..., 2].abs().amax(1)[:, None, None].clamp_min(1e-9)
    slopes = local[..., :2] / torch.maximum(local[..., 2:], min_depth)
    return slopes.amin(1), slopes.amax(1)


def _at_frames(moving: Float[Tensor, "k m 3"], frames: int) -> Float[Tensor, "t m 3"]:
    """Interpolate moving points to the frames of the video; a single frame is in the middle of the motion."""
    index = torch.linspace(0, len(moving) - 1, frames) if frames > 1 else torch.tensor([(len(moving) - 1) / 2])
    first = index.long().clamp(max=max(len(moving) - 2, 0))
    last = (first + 1).clamp(max=len(moving) - 1)
    return torch.lerp(moving[first], moving[last], (index - first)[:, None, None])


def _smoothed(shifts: Float[Tensor, "t 3"]) -> Float[Tensor, "t 3"]:
    """Gaussian moving average over the frames, with edge values repeated beyond the ends."""
    sigma = SMOOTHING * len(shifts)
    radius = math.ceil(3 * sigma)
    weight = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / max(sigma, 1e-6)) ** 2)
    padded = torch.cat([shifts[:1].expand(radius, 3), shifts, shifts[-1:].expand(radius, 3)])
    return torch.einsum("tiw,w->ti", padded.unfold(0, 2 * radius + 1, 1), weight / weight.sum())
