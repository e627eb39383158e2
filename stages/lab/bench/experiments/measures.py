"""Quantities measured in an experiment, from its trajectory alone."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.scene.trajectory import Trajectory


def path(t: Trajectory, row: int) -> Float[Tensor, "t 3"]:
    """Displacement of the centre of mass of an object since the start [m]."""
    return t.com[:, row] - t.com[0, row]


def gap(t: Trajectory, above: int = 2, below: int = 1) -> float:
    """Final height of the lower face of a box above the upper face of another, in heights of the upper box."""
    upper, lower = (t.keypoints.object_id == i for i in (above, below))
    rest, end = t.keypoints.rest, t.positions[-1]
    high, low = float(rest[upper, 2].max()), float(rest[upper, 2].min())
    margin = 0.02 * (high - low)
    face = upper & (rest[:, 2] < low + margin)
    reach = (rest[face, :2].amax(0) - rest[face, :2].amin(0)).max() / 2
    over = (rest[:, :2] - rest[face, :2].mean(0)).norm(dim=1) < 1.5 * reach
    top = lower & (rest[:, 2] > float(rest[lower, 2].max()) - margin)
    top = top & over if bool((top & over).any()) else top
    return float(end[face, 2].mean() - end[top, 2].mean()) / (high - low)


def spin(t: Trajectory, row: int = 0) -> float:
    """Angular speed about z at the end [rad/s]."""
    turned = 2 * torch.atan2(t.rotation[-2:, row, 3], t.rotation[-2:, row, 0])
    return float((turned[1] - turned[0] + math.pi) % (2 * math.pi) - math.pi) / t.info.dt


def rebound(t: Trajectory, drop: float) -> float:
    """Coefficient of restitution, from the height reached after the first bounce."""
    z = path(t, 0)[:, 2] + drop
    hit = int((z < 0.1 * drop).nonzero()[0]) if bool((z < 0.1 * drop).any()) else len(z) - 1
    return math.sqrt(max(float(z[hit:].max()), 0.0) / drop)


def largest_shift(t: Trajectory) -> float:
    """Largest displacement of any object at the end [m]."""
    return float((t.com[-1] - t.com[0]).norm(dim=1).max())


def largest_difference(one: Trajectory, other: Trajectory, scale: float, size: float) -> float:
    """Largest distance of centres of mass in two scenes at any time, the other `scale` times as large, in `size`."""
    return float((other.com / scale - one.com).norm(dim=-1).max()) / size


def overlap(t: Trajectory, radius: float) -> float:
    """Largest overlap of balls with each other or with the floor at the end, in diameters."""
    closest = torch.pdist(t.com[-1]).min() / (2 * radius)
    lowest = (t.com[-1, :, 2].min() + radius) / (2 * radius)
    return max(1 - float(torch.minimum(closest, lowest)), 0.0)
