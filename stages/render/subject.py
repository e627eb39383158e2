"""The subject of the camera: the region of the scene to be framed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.cameras import centres, depths, project
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import SURFACE_OPACITY, Gaussians
from stages.render.animation import Animation

EXTENT_QUANTILES = (0.05, 0.95)  # quantiles of each coordinate that bound a set of points
# The focus radius is a third of the distance of the cameras from their focus.
MAX_OBJECT_DISTANCE = 2.0  # distance from the focus beyond which objects are scenery [focus radius]
MAX_POINT_DISTANCE = 4.0  # distance from the focus beyond which moving points have left the scene [focus radius]
MAX_AIM_SHIFT = 0.35  # largest shift of the aim from the focus towards the objects [focus radius]
MIN_OBJECT_FRACTION = 0.05  # number of Gaussians below which objects are ignored, relative to the largest object
MAX_POINTS = 200_000  # number of points to which point sets are thinned
MAX_TIMES, MAX_TRACKED_POINTS = 60, 3000  # numbers of times and points to which moving points are thinned
MIN_MOTION = 0.1  # displacement below which points are not tracked [radius of the subject]


@dataclass(frozen=True)
class Subject:
    """An axis-aligned box to be framed."""

    centre: Float[Tensor, "3"]
    half: Float[Tensor, "3"]  # distances from the centre to the faces
    aim: Float[Tensor, "3"] | None = None  # point to look at; None: the centre
    moving: Float[Tensor, "t m 3"] | None = None  # tracked points at evenly spaced times of the animation

    @property
    def target(self) -> Float[Tensor, "3"]:
        """Point that the camera looks at."""
        return self.centre if self.aim is None else self.aim

    @property
    def radius(self) -> float:
        """Distance from the centre to the corners."""
        return float(self.half.norm())

    def corners(self) -> Float[Tensor, "8 3"]:
        """Corners of the box."""
        signs = torch.tensor([-1.0, 1.0])
        return self.centre + torch.cartesian_prod(signs, signs, signs) * self.half


def find_subject(animation: Animation) -> Subject:
    """Find the subject: the objects over their whole motion; without objects the focus, or else the whole scene.

    With photos the camera aims at the focus, shifted by at most MAX_AIM_SHIFT towards the objects.
    """
    g, cameras = animation.scene.gaussians, animation.scene.cameras
    opaque = g[g.opacities > SURFACE_OPACITY] if (g.opacities > SURFACE_OPACITY).any() else g
    focus = (axes_focus(cameras) or common_view_centre(cameras, opaque.means)) if cameras is not None else None
    ids = _central_objects(opaque, focus)
    if not len(ids):
        return focus or robust_box(opaque.means)
    found = _objects_box(animation, opaque, ids)
    if focus is None:
        return found
    shift = found.centre - focus.centre
    shift = shift * min(1.0, MAX_AIM_SHIFT * focus.radius / float(shift.norm().clamp_min(1e-9)))
    return replace(found, aim=focus.centre + shift, moving=_within_scene(found.moving, focus))


def _within_scene(moving: Float[Tensor, "t m 3"] | None, focus: Subject) -> Float[Tensor, "t m 3"] | None:
    """Move tracked points that have left the scene to the focus, so that they do not attract the camera."""
    if moving is None:
        return None
    outside = (moving - focus.centre).norm(dim=2, keepdim=True) > MAX_POINT_DISTANCE * focus.radius
    return torch.where(outside, focus.centre, moving)


def merge_subjects(subjects: Sequence[Subject]) -> Subject:
    """The bounding box of several subjects, with the mean of their targets and all of their moving points."""
    if len(subjects) == 1:
        return subjects[0]
    low = torch.stack([s.centre - s.half for s in subjects]).amin(0)
    high = torch.stack([s.centre + s.half for s in subjects]).amax(0)
    targets = torch.stack([s.target for s in subjects])
    moving = [s.moving for s in subjects if s.moving is not None]
    times = max(map(len, moving), default=0)
    moving = torch.cat([m[_evenly(len(m), times)] for m in moving], 1) if moving else None
    return Subject((low + high) / 2, (high - low) / 2, targets.mean(0), moving)


def _objects_box(animation: Animation, opaque: Gaussians, ids: Int[Tensor, "o"]) -> Subject:
    """The box of these objects over the whole animation; it always includes their initial positions."""
    trajectory = animation.trajectory
    if trajectory is not None:
        selected = torch.isin(trajectory.keypoints.object_id, ids)
        if selected.any():
            frames = slice(None) if animation.is_moving else [animation.frozen or 0]
            positions = trajectory.positions[frames][:, selected]
            box = merge_subjects([robust_box(positions.reshape(-1, 3)), robust_box(positions[0])])
            return replace(box, moving=_moving_points(positions, MIN_MOTION * box.radius))
    return robust_box(opaque.means[torch.isin(opaque.object_id, ids)])


def _moving_points(positions: Float[Tensor, "t p 3"], min_motion: float) -> Float[Tensor, "t m 3"] | None:
    """The points that move by more than `min_motion`, thinned in time and number; None if there are none."""
    positions = positions[_evenly(len(positions), min(len(positions), MAX_TIMES))]
    positions = positions[:, (positions - positions[0]).norm(dim=2).amax(0) > min_motion]
    count = positions.shape[1]
    return positions[:, _evenly(count, min(count, MAX_TRACKED_POINTS))] if count else None


def _evenly(length: int, count: int) -> Int[Tensor, "c"]:
    """`count` evenly spaced indices from the first to the last of `length`."""
    return torch.linspace(0, max(length - 1, 0), count).round().long()


def _central_objects(g: Gaussians, focus: Subject | None) -> Int[Tensor, "o"]:
    """Ids of the objects that are not very small and are near the focus; if none is near, of all that are not small."""
    ids, counts = g.object_id[g.object_id > 0].unique(return_counts=True)
    ids = ids[counts >= MIN_OBJECT_FRACTION * counts.max()] if len(ids) else ids
    if focus is None or not len(ids):
        return ids
    medians = torch.stack([g.means[g.object_id == i].median(0).values for i in ids])
    near = (medians - focus.centre).norm(dim=1) < MAX_OBJECT_DISTANCE * focus.radius
    return ids[near] if near.any() else ids


def robust_box(points: Float[Tensor, "n 3"]) -> Subject:
    """The box between EXTENT_QUANTILES of each coordinate, enlarged by as much as the quantiles cut off."""
    thinned = points[:: max(1, len(points) // MAX_POINTS)].double()
    low, high = torch.quantile(thinned, torch.tensor(EXTENT_QUANTILES, dtype=torch.float64), dim=0)
    half = (high - low) / 2 / (EXTENT_QUANTILES[1] - EXTENT_QUANTILES[0])
    return Subject(((low + high) / 2).float(), half.float().clamp_min(1e-6))


def axes_focus(cameras: Cameras) -> Subject | None:
    """The focus of cameras: the point nearest to all viewing axes (least squares).

    None if the axes are nearly parallel, or if the point is behind more than half of the cameras.
    """
    eyes = centres(cameras.viewmats).double()
    axes = cameras.viewmats[:, 2, :3].double()
    projectors = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]  # orthogonal to an axis
    normal = projectors.sum(0)
    if torch.linalg.eigvalsh(normal)[0] < 0.02 * len(cameras):
        return None
    point = torch.linalg.solve(normal, (projectors @ eyes[..., None]).sum(0))[:, 0].float()
    depth = torch.stack([depths(point[None], viewmat)[0] for viewmat in cameras.viewmats])
    if (depth > 0).float().mean() < 0.5:
        return None
    return _focus_cube(point, depth[depth > 0].median())


def common_view_centre(cameras: Cameras, points: Float[Tensor, "n 3"]) -> Subject | None:
    """The focus of nearly parallel cameras: median of the points that are central in half of the photos or more.

    A point is central in a photo if it is in the middle half of its width and height. None if there is no such point.
    """
    points = points[:: max(1, len(points) // MAX_POINTS)]
    count = torch.zeros(len(points))
    for viewmat, K, size in zip(cameras.viewmats, cameras.Ks, cameras.sizes, strict=True):
        offset = (project(points, viewmat, K) / size - 0.5).abs()
        count += ((offset < 0.25).all(1) & (depths(points, viewmat) > 0)).float()
    central = points[count >= 0.5 * len(cameras)]
    if not len(central):
        return None
    point = central.median(0).values
    return _focus_cube(point, (centres(cameras.viewmats) - point).norm(dim=1).median())


def _focus_cube(point: Float[Tensor, "3"], distance: Float[Tensor, ""]) -> Subject:
    """A cube whose corners are a third as far from its centre as the cameras are."""
    return Subject(point, (distance / 3 / 3**0.5).expand(3))
