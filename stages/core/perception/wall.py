"""Things on a wall: found and made whole as on a table, the wall lying down as a floor while that is done."""

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

SHARE = 0.2  # of what is in focus, a wall holds at least
BEHIND = 0.05  # of what is in focus, lies behind a wall at most
WIDE = 0.8  # a wall reaches at least so far, up as well as sideways [view radii]
STEEP = 0.5  # z of a wall's normal at most: what is flatter is a ramp
THICK = 0.02  # of the wall [view radii]


def find_wall(scene: Scene, view: ViewExtent, seed: int = 0) -> Similarity | None:
    """The turn that lays the wall behind what the cameras look at on its back, as a floor at z = 0.

    None for scenes with a floor, and where there is no wall: the plane with most of what is in focus, if it is
    steep and wide, all cameras are in front of it, and next to nothing is behind it.
    """
    if scene.floor is not None or scene.cameras is None or not len(scene.cameras):
        return None
    g, R = scene.gaussians, view.radius
    points = g.means[is_opaque(g, R) & ((g.means - view.focus).norm(dim=1) < SEARCH_RADIUS * R)]
    near = 1 / (1 + ((points - view.focus).norm(dim=1) / (0.5 * R)) ** 4)
    found = ransac(points, 0.5 * THICK * R, near, seed=seed)
    if found is None or abs(float(found[0].normal[2])) > STEEP:
        return None
    plane, on = found
    eyes = plane.heights(centres(scene.cameras.viewmats))
    side = 1.0 if float(eyes.median()) > 0 else -1.0
    plane = Plane(side * plane.normal, side * plane.offset)
    behind = near[plane.heights(points) < -THICK * R].sum() / near.sum()
    if float((side * eyes).min()) <= 0 or float(near[on].sum() / near.sum()) < SHARE or float(behind) > BEHIND:
        return None
    turn = rotation_between(plane.normal, torch.tensor([0.0, 0.0, 1.0]))
    return Similarity(1.0, turn, torch.tensor([0.0, 0.0, -plane.offset])) if _wide(points[on] @ turn.mT, R) else None


def _wide(flat: Float[Tensor, "n 3"], radius: float) -> bool:
    """Whether the middle nine tenths of a level plane's points reach far in x and in y."""
    thinned = flat[:: max(1, len(flat) // 100_000), :2]
    return bool((thinned.quantile(0.95, dim=0) - thinned.quantile(0.05, dim=0)).min() > WIDE * radius)


def rotate_wall_to_floor(scene: Scene, turn: Similarity) -> Scene:
    """The scene after `find_wall`'s turn, with the wall for its floor."""
    cameras = scene.cameras.transformed(turn)
    return replace(scene, gaussians=transformed(scene.gaussians, turn), cameras=cameras, floor=0.0)
