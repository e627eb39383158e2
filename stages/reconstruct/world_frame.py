"""Estimation of the world frame: up direction, supporting plane and scale of the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.geometry.cameras import centres
from stages.core.geometry.planes import Plane, ransac
from stages.core.geometry.similarity import Similarity
from stages.reconstruct.options import UP_SIDES

# Minimum component of a plane's normal along the cameras' up axes (cosine of their pitch), and minimum weighted
# fraction of the points on the plane; the first pair is preferred.
PLANE_CRITERIA = ((0.5, 0.04), (0.05, 0.3))
UPRIGHT_FACTOR = 1.5  # weight of a plane's fraction of points if photos are upright; squared if cameras look down on it
LOOKS_DOWN = 0.25  # sine of the smallest mean pitch of cameras that look down
ROLL_RATIO = 4.0  # smallest ratio of the least spreads of the cameras' x and y axes if one of them is horizontal
# Depth below and height above the first plane of the band in which it is refitted, and side of a patch of the surface
# [camera distances].
BAND_BELOW, BAND_ABOVE, PATCH_SIZE = 0.08, 0.03, 0.04


@dataclass(frozen=True)
class Ground:
    """Up direction and supporting plane, in the frame of the cameras."""

    up: Float[Tensor, "3"]
    plane: Plane | None  # supporting plane with normal `up`, if there is one
    focus: Float[Tensor, "3"]  # the point that the cameras look at
    radius: float  # median distance of the cameras from `focus`
    inlier_fraction: float = 0.0  # fraction of the points, weighted by focus, that are on the plane
    up_side: str = "top"  # side of the photos that is up
    rival: str = ""  # another side that may be up instead; empty if the choice is clear


def focus_point(viewmats: Float[Tensor, "c 4 4"], distances: Float[Tensor, "c"]) -> Float[Tensor, "3"]:
    """Median of the points at `distances` along the viewing axes of the cameras."""
    ahead = centres(viewmats) + viewmats[:, 2, :3] * distances[:, None]
    return ahead.median(0).values


def find_ground(
    points: Float[Tensor, "n 3"], viewmats: Float[Tensor, "c 4 4"], focus: Float[Tensor, "3"], seed: int = 0,
    up_side: str = "auto",
) -> Ground:  # fmt: skip
    """Find the supporting plane of the objects in focus; without one, only the up direction from the cameras.

    `up_side` is the side of the photos that is up, one of UP_SIDES. With "auto" the sides that are compatible with the
    roll of the cameras are tried; the one whose plane has most points in focus, weighted by UPRIGHT_FACTOR, is chosen.
    """
    sides, looks_down = _sides_by_roll(viewmats) if up_side == "auto" else ((up_side,), "")
    found = {side: replace(_find_ground(points, turned(viewmats, side), focus, seed), up_side=side) for side in sides}
    support = {
        side: ground.inlier_fraction * UPRIGHT_FACTOR ** ((side == "top") + 2 * (side == looks_down))
        for side, ground in found.items()
    }
    best, *rest = sorted(sides, key=lambda side: (-support[side], side != looks_down, side != "top"))
    near = rest[0] if rest and support[best] < UPRIGHT_FACTOR * support[rest[0]] else ""
    return replace(found[best], rival=near)


def _sides_by_roll(viewmats: Float[Tensor, "c 4 4"]) -> tuple[tuple[str, ...], str]:
    """Sides of the photos that may be up, and the one that is up if the cameras look down ("" if unknown).

    Cameras that move around a scene rotate about the vertical: one of their image axes stays horizontal, that is,
    orthogonal to a common direction, while the other does not.
    """
    right, down, ahead = (viewmats[:, axis, :3] for axis in range(3))
    (flat, wide), (upright, other) = (torch.linalg.eigh(axis.mT @ axis / len(axis)) for axis in (right, down))
    spans = float(min(flat[1], upright[1])) > 0.02  # otherwise the cameras are too similar
    if not spans or max(flat[0], upright[0]) < ROLL_RATIO * min(flat[0], upright[0]):
        return UP_SIDES, ""
    landscape = bool(flat[0] < upright[0])
    up = (wide if landscape else other)[:, 0]
    pitch = float((ahead @ up).mean())
    up = up if pitch < 0 else -up
    sides = ("top", "bottom") if landscape else ("right", "left")
    along = -down if landscape else right
    return sides, "" if abs(pitch) < LOOKS_DOWN else sides[0 if float((along @ up).mean()) > 0 else 1]


def turned(viewmats: Float[Tensor, "c 4 4"], up_side: str) -> Float[Tensor, "c 4 4"]:
    """Rotate cameras about their optical axes so that `up_side` of their images becomes the top."""
    quarter = torch.eye(4).to(viewmats)
    quarter[:2, :2] = torch.tensor([[0.0, 1], [-1, 0]])  # the right side becomes the top
    return torch.linalg.matrix_power(quarter, UP_SIDES.index(up_side)) @ viewmats


def _find_ground(
    points: Float[Tensor, "n 3"], viewmats: Float[Tensor, "c 4 4"], focus: Float[Tensor, "3"], seed: int
) -> Ground:
    """Find the supporting plane by RANSAC, for cameras that are held upright.

    Points are weighted by their distance from the focus, so that a table is preferred to the floor around it; most
    cameras must be above the plane. Planes that the cameras look down on by less than 60 degrees are preferred:
    steeper ones may be the front of a book. They need more points, which then do not count for the others.
    """
    eyes = centres(viewmats)
    radius = float((eyes - focus).norm(dim=1).median())
    weights = _focus_weights(points, focus, radius)
    (min_flat, flat_fraction), (min_steep, steep_fraction) = PLANE_CRITERIA

    def supporting(min_up: float, min_fraction: float, free: Float[Tensor, "n"]) -> Ground | None:
        """The plane with most of the weight `free` of the points, if it has enough of it."""
        allowed = lambda n: _plausible_up(n, viewmats, min_up)  # noqa: E731
        found = ransac(points, 0.01 * radius, free, allowed, seed=seed) if free.any() else None
        if found is None:
            return None
        plane, inside = _lowest_parallel_plane(points, free, found[0], 0.01 * radius)
        fraction = float(free[inside].sum() / weights.sum())
        good = fraction >= min_fraction and float((plane.heights(eyes) > 0).float().mean()) > 0.5
        return Ground(plane.normal, plane, focus, radius, fraction) if good else None

    free, steep = weights, supporting(min_steep, steep_fraction, weights)
    if steep is not None and not _plausible_up(steep.up[None], viewmats, min_flat):
        # photos straight down on a table: slanted planes through it have some of its points
        free = weights.masked_fill(steep.plane.heights(points).abs() < 0.02 * radius, 0.0)
    flat = supporting(min_flat, flat_fraction, free)
    if flat or steep:
        return flat or steep
    return Ground(up_from_cameras(viewmats), None, focus, radius)


def refine_ground(ground: Ground, points: Float[Tensor, "n 3"], seed: int = 0) -> Ground:
    """Refit the supporting plane with weights by area instead of by number of points.

    Textured objects, such as a keyboard and a book, may have more points than the table under them and tilt the first
    plane. Only points in a band are used, which extends less far above the plane than below, since points above may be
    on a tray.
    """
    if ground.plane is None:
        return ground
    heights = ground.plane.heights(points) / ground.radius
    band = points[(heights > -BAND_BELOW) & (heights < BAND_ABOVE)]
    _, patch, count = (
        (band / (PATCH_SIZE * ground.radius)).floor().long().unique(dim=0, return_inverse=True, return_counts=True)
    )
    weights = _focus_weights(band, ground.focus, ground.radius) / count[patch]
    found = ransac(band, 0.005 * ground.radius, weights, lambda n: n @ ground.up > 0.99, seed=seed)
    return ground if found is None else replace(ground, up=found[0].normal, plane=found[0])


def _focus_weights(points: Float[Tensor, "n 3"], focus: Float[Tensor, "3"], radius: float) -> Float[Tensor, "n"]:
    """Weights of points by their distance from the focus: 1 at the focus, 1/2 at half the cameras' distance."""
    return 1 / (1 + ((points - focus).norm(dim=1) / (0.5 * radius)) ** 4)


def _plausible_up(normals: Float[Tensor, "k 3"], viewmats: Float[Tensor, "c 4 4"], min_up: float) -> Bool[Tensor, "k"]:
    """Mask of unit normals that are plausible up directions for most cameras.

    Cameras are mostly held without roll, so up is nearly orthogonal to their horizontal axes; its component along the
    up axes of the cameras is at least `min_up`, and the cameras do not look up at the plane.
    """
    right, down, ahead = (viewmats[:, axis, :3] for axis in range(3))
    roll = (normals @ right.mT).abs().median(1).values  # sine of the roll angle
    upward = (-normals @ down.mT).median(1).values
    pitch = (normals @ ahead.mT).median(1).values
    return (roll < 0.3) & (upward > min_up) & (pitch < 0.2)


def up_from_cameras(viewmats: Float[Tensor, "c 4 4"]) -> Float[Tensor, "3"]:
    """Up direction from the cameras: orthogonal to their x axes if these span a plane, otherwise the mean up axis.

    The mean up axis of cameras that all look down from one side is tilted, so it is only the fallback.
    """
    right = viewmats[:, 0, :3]
    mean = F.normalize(-viewmats[:, 1, :3].mean(0), dim=0)
    spread, axes = torch.linalg.eigh(right.mT @ right / len(right))
    if spread[1] < 0.1:
        return mean
    up = axes[:, 0]
    return up if float(up @ mean) > 0 else -up


def _lowest_parallel_plane(points, weights, plane: Plane, threshold: float) -> tuple[Plane, Bool[Tensor, "n"]]:
    """The lowest parallel plane with at least half the weight of `plane`, and its inliers: the table under a mat."""
    heights = plane.heights(points)
    weight = weights[heights.abs() < threshold].sum()
    in_focus = weights > 0.5  # excludes the floor under a table
    for shift in torch.arange(-12, -2).tolist():
        inside = (heights - shift * threshold).abs() < threshold
        if weights[inside & in_focus].sum() >= 0.5 * weight:
            centre = float((heights[inside] * weights[inside]).sum() / weights[inside].sum())
            lower = Plane(plane.normal, plane.offset + centre)
            return lower, lower.heights(points).abs() < threshold
    return plane, heights.abs() < threshold


def to_world(
    ground: Ground, points: Float[Tensor, "n 3"], viewmats: Float[Tensor, "c 4 4"], metric: bool
) -> Similarity:
    """Transform to the world frame: z up, supporting plane at z = 0, focus at x = y = 0, first camera on the -y side.

    Without a plane, z = 0 is the 2 % quantile of the heights near the focus. For given cameras (`metric`) the scale is
    kept; otherwise the median distance of the cameras from the focus becomes 1.
    """
    scale = 1.0 if metric else 1 / ground.radius
    to_focus = ground.focus - centres(viewmats)[0]
    forward = to_focus - ground.up * (to_focus @ ground.up)
    if forward.norm() < 1e-3 * ground.radius:  # the first camera looks straight down: use its up axis
        forward = -viewmats[0, 1, :3] - ground.up * (-viewmats[0, 1, :3] @ ground.up)
    forward = F.normalize(forward, dim=0)
    R = torch.stack([torch.linalg.cross(forward, ground.up), forward, ground.up])
    origin = ground.focus - ground.up * (ground.focus @ ground.up)
    if ground.plane is not None:
        floor = ground.plane.offset
    else:
        close = points[(points - ground.focus).norm(dim=1) < 0.5 * ground.radius]
        floor = float(((close if len(close) else points) @ ground.up).quantile(0.02))
    return Similarity(scale, R, -scale * R @ (origin + ground.up * floor))
