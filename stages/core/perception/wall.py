"""Objects on a wall: rotate the scene so that the wall becomes the floor and can be processed like a table."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import centres
from stages.core.geometry.planes import Plane, ransac
from stages.core.geometry.rotations import rotation_between
from stages.core.geometry.similarity import Similarity
from stages.core.perception.support import SEARCH_RADIUS, ViewExtent, is_opaque
from stages.core.scene.gaussians import transformed
from stages.core.scene.scene import Scene

MIN_WALL_FRACTION = 0.2  # minimum fraction of the Gaussians in focus that lie on a wall
MAX_BEHIND_FRACTION = 0.05  # largest fraction of the Gaussians in focus that lie behind a wall
MIN_EXTENT = 0.8  # minimum extent of a wall, both vertically and horizontally [camera distance]
MAX_NORMAL_Z = 0.5  # largest |z| of a wall's unit normal; above it, the plane is a ramp
WALL_THICKNESS = 0.02  # [camera distance]


def find_wall(scene: Scene, view: ViewExtent, seed: int = 0) -> Similarity | None:
    """The rigid motion that turns the wall in view into a floor at z = 0.

    A wall is the plane with the most Gaussians in focus, if it is steep and large, all cameras are in front of it, and
    almost nothing is behind it. None for scenes with a floor or without such a plane.
    """
    if scene.floor is not None or scene.cameras is None or not len(scene.cameras):
        return None
    g, R = scene.gaussians, view.radius
    points = g.means[is_opaque(g, R) & ((g.means - view.focus).norm(dim=1) < SEARCH_RADIUS * R)]
    near = 1 / (1 + ((points - view.focus).norm(dim=1) / (0.5 * R)) ** 4)
    found = ransac(points, 0.5 * WALL_THICKNESS * R, near, seed=seed)
    if found is None or abs(float(found[0].normal[2])) > MAX_NORMAL_Z:
        return None
    plane, on = found
    eyes = plane.heights(centres(scene.cameras.viewmats))
    side = 1.0 if float(eyes.median()) > 0 else -1.0
    plane = Plane(side * plane.normal, side * plane.offset)
    behind = near[plane.heights(points) < -WALL_THICKNESS * R].sum() / near.sum()
    if (
        float((side * eyes).min()) <= 0
        or float(near[on].sum() / near.sum()) < MIN_WALL_FRACTION
        or float(behind) > MAX_BEHIND_FRACTION
    ):
        return None
    rotation = rotation_between(plane.normal, torch.tensor([0.0, 0.0, 1.0]))
    return (
        Similarity(1.0, rotation, torch.tensor([0.0, 0.0, -plane.offset]))
        if _is_large(points[on] @ rotation.mT, R)
        else None
    )


def _is_large(flat: Float[Tensor, "n 3"], radius: float) -> bool:
    """Whether the central 90 % of a level plane's points extend over MIN_EXTENT in both x and y."""
    thinned = flat[:: max(1, len(flat) // 100_000), :2]
    return bool((thinned.quantile(0.95, dim=0) - thinned.quantile(0.05, dim=0)).min() > MIN_EXTENT * radius)


def rotate_wall_to_floor(scene: Scene, rotation: Similarity) -> Scene:
    """The scene after the rigid motion of `find_wall`, with the wall as its floor."""
    cameras = scene.cameras.transformed(rotation)
    return replace(scene, gaussians=transformed(scene.gaussians, rotation), cameras=cameras, floor=0.0)
