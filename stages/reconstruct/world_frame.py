"""Which way is up, where the floor is, and how large the scene is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.geometry.cameras import centres
from stages.core.geometry.planes import Plane, ransac
from stages.core.geometry.similarity import Similarity

# Minimum cosine of the cameras' pitch and minimum fraction of the points in focus, tried in this order.
PLANE_CRITERIA = ((0.5, 0.04), (0.05, 0.3))
# Band around the first plane in which it is fitted again, and side of a surface patch [camera distances].
BAND_BELOW, BAND_ABOVE, PATCH_SIZE = 0.08, 0.03, 0.04


@dataclass(frozen=True)
class Ground:
    """What was found out about the scene's stance, in the frame of the cameras."""

    up: Float[Tensor, "3"]
    plane: Plane | None  # supporting plane, its normal being `up`; None when there is none
    focus: Float[Tensor, "3"]  # what the cameras look at
    radius: float  # median distance of the cameras from it
    inlier_fraction: float = 0.0  # of the points in focus, on the plane


def focus_point(viewmats: Float[Tensor, "c 4 4"], distances: Float[Tensor, "c"]) -> Float[Tensor, "3"]:
    """The median of the points `distances` ahead of the cameras."""
    ahead = centres(viewmats) + viewmats[:, 2, :3] * distances[:, None]
    return ahead.median(0).values


def find_ground(
    points: Float[Tensor, "n 3"], viewmats: Float[Tensor, "c 4 4"], focus: Float[Tensor, "3"], seed: int = 0
) -> Ground:
    """The plane that the things in focus stand on, or the cameras' own up where there is none.

    Points count by their nearness to the focus, so a table wins over the floor around it; most cameras
    must be above it. Planes that the cameras look down on by less than 60 degrees come first, since steeper
    ones may be the front of a book; a steeper one must hold more points.
    """
    eyes = centres(viewmats)
    radius = float((eyes - focus).norm(dim=1).median())
    near = _focus_weights(points, focus, radius)
    for least_up, least_share in PLANE_CRITERIA:
        found = ransac(points, 0.01 * radius, near, lambda n, up=least_up: _plausible_up(n, viewmats, up), seed=seed)
        if found is None:
            continue
        plane, inside = _lowest_parallel_plane(points, near, found[0], 0.01 * radius)
        share = float(near[inside].sum() / near.sum())
        above = float((plane.heights(eyes) > 0).float().mean())
        if share >= least_share and above > 0.5:
            return Ground(plane.normal, plane, focus, radius, share)
    return Ground(up_from_cameras(viewmats), None, focus, radius)


def refine_ground(ground: Ground, points: Float[Tensor, "n 3"], seed: int = 0) -> Ground:
    """The plane again, by area: each patch of surface counts once, however many points its pattern gave.

    Patterned tops, of a keyboard and of a book, may hold more points than the bare table under them and tilt the
    first plane. It is looked for less far above than below, since what is above may be a tray.
    """
    if ground.plane is None:
        return ground
    heights = ground.plane.heights(points) / ground.radius
    band = points[(heights > -BAND_BELOW) & (heights < BAND_ABOVE)]
    _, patch, count = (band / (PATCH_SIZE * ground.radius)).floor().long().unique(
        dim=0, return_inverse=True, return_counts=True
    )
    weights = _focus_weights(band, ground.focus, ground.radius) / count[patch]
    found = ransac(band, 0.005 * ground.radius, weights, lambda n: n @ ground.up > 0.99, seed=seed)
    return ground if found is None else replace(ground, up=found[0].normal, plane=found[0])


def _focus_weights(points: Float[Tensor, "n 3"], focus: Float[Tensor, "3"], radius: float) -> Float[Tensor, "n"]:
    """Weights that fall to a half at half the cameras' distance."""
    return 1 / (1 + ((points - focus).norm(dim=1) / (0.5 * radius)) ** 4)


def _plausible_up(
    normals: Float[Tensor, "k 3"], viewmats: Float[Tensor, "c 4 4"], least_up: float
) -> Bool[Tensor, "k"]:
    """Normals that make sense as up for most cameras.

    People hold cameras level, so up is nearly square to the cameras' horizontal axes; it has at least the
    share `least_up` along the cameras' own up, and the cameras do not look up at the plane.
    """
    right, down, ahead = (viewmats[:, axis, :3] for axis in range(3))
    roll = (normals @ right.mT).abs().median(1).values  # sine of the angle the camera is rolled by
    upward = (-normals @ down.mT).median(1).values
    pitch = (normals @ ahead.mT).median(1).values
    return (roll < 0.3) & (upward > least_up) & (pitch < 0.2)


def up_from_cameras(viewmats: Float[Tensor, "c 4 4"]) -> Float[Tensor, "3"]:
    """Up as the cameras were held: square to their horizontal axes where those fix it, else their mean up.

    The mean up of cameras that all look down from one side leans; it is corrected only as far as the
    horizontal axes span two directions.
    """
    right = viewmats[:, 0, :3]
    mean = F.normalize(-viewmats[:, 1, :3].mean(0), dim=0)
    spread, axes = torch.linalg.eigh(right.mT @ right / len(right))
    if spread[1] < 0.1:
        return mean
    up = axes[:, 0]
    return up if float(up @ mean) > 0 else -up


def _lowest_parallel_plane(points, weights, plane: Plane, threshold: float) -> tuple[Plane, Bool[Tensor, "n"]]:
    """Among planes parallel to this one, the lowest that holds half as much or more: tables, not table mats."""
    heights = plane.heights(points)
    own = weights[heights.abs() < threshold].sum()
    near = weights > 0.5  # the floor under a table is large, but not in focus
    for shift in torch.arange(-12, -2).tolist():
        inside = (heights - shift * threshold).abs() < threshold
        if weights[inside & near].sum() >= 0.5 * own:
            centre = float((heights[inside] * weights[inside]).sum() / weights[inside].sum())
            lower = Plane(plane.normal, plane.offset + centre)
            return lower, lower.heights(points).abs() < threshold
    return plane, heights.abs() < threshold


def to_world(
    ground: Ground, points: Float[Tensor, "n 3"], viewmats: Float[Tensor, "c 4 4"], metric: bool
) -> Similarity:
    """The move to the world: z up, the floor at z = 0, the focus at x = y = 0, the first camera on the -y side.

    The scale is kept where cameras were given (`metric`), else chosen so that the cameras' median distance
    from the focus is 1.
    """
    scale = 1.0 if metric else 1 / ground.radius
    toward = ground.focus - centres(viewmats)[0]
    ahead = toward - ground.up * (toward @ ground.up)
    if ahead.norm() < 1e-3 * ground.radius:  # a first camera looking straight down: its own up is ahead
        ahead = -viewmats[0, 1, :3] - ground.up * (-viewmats[0, 1, :3] @ ground.up)
    ahead = F.normalize(ahead, dim=0)
    R = torch.stack([torch.linalg.cross(ahead, ground.up), ahead, ground.up])
    origin = ground.focus - ground.up * (ground.focus @ ground.up)
    if ground.plane is not None:
        floor = ground.plane.offset
    else:
        close = points[(points - ground.focus).norm(dim=1) < 0.5 * ground.radius]
        floor = float(((close if len(close) else points) @ ground.up).quantile(0.02))
    return Similarity(scale, R, -scale * R @ (origin + ground.up * floor))
