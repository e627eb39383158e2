"""What a camera should look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.cameras import centres, depths, project
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.render.animation import Animation

KEPT = (0.05, 0.95)  # quantiles of each coordinate that count as the extent
VISIBLE = 0.1  # opacity
ASTRAY = 2.0  # radii of what the cameras look at (two thirds of their distance): objects farther off are scenery
GONE = 4.0  # radii of what the cameras look at, whose distance is three: farther off a thing has left the scene
LEASH = 0.35  # radii of what the cameras look at: the aim stays within this of theirs
SCRAP = 0.05  # of the Gaussians of the largest object; smaller ones do not direct the camera
MANY = 200_000  # points are thinned to about this many
MOMENTS, FOLLOWED = 60, 3000  # most times at which what moves must be in the picture, and points of it
STIRS = 0.1  # of the size of what is shown; what moves less needs no attention


@dataclass(frozen=True)
class Subject:
    """An upright box that holds what matters."""

    centre: Float[Tensor, "3"]
    half: Float[Tensor, "3"]  # from the centre to the faces
    aim: Float[Tensor, "3"] | None = None  # where to look, if not at the centre
    moving: Float[Tensor, "t m 3"] | None = None  # points of what moves, at even times of the film

    @property
    def target(self) -> Float[Tensor, "3"]:
        return self.centre if self.aim is None else self.aim

    @property
    def radius(self) -> float:
        """From the centre to the corners."""
        return float(self.half.norm())

    def corners(self) -> Float[Tensor, "8 3"]:
        signs = torch.tensor([-1.0, 1.0])
        return self.centre + torch.cartesian_prod(signs, signs, signs) * self.half


def find_subject(footage: Animation) -> Subject:
    """The objects along all of their motion; without objects what the cameras look at; else the whole scene.

    Photos are framed around what matters, so objects pull the aim only a little away from theirs.
    """
    g, cameras = footage.scene.gaussians, footage.scene.cameras
    seen = g[g.opacities > VISIBLE] if (g.opacities > VISIBLE).any() else g
    aimed = (axes_focus(cameras) or common_view_centre(cameras, seen.means)) if cameras is not None else None
    ids = _central(seen, aimed)
    if not len(ids):
        return aimed or robust_box(seen.means)
    found = _box(footage, seen, ids)
    if aimed is None:
        return found
    pull = found.centre - aimed.centre
    pull = pull * min(1.0, LEASH * aimed.radius / float(pull.norm().clamp_min(1e-9)))
    return replace(found, aim=aimed.centre + pull, moving=_near(found.moving, aimed))


def _near(moving: Float[Tensor, "t m 3"] | None, aimed: Subject) -> Float[Tensor, "t m 3"] | None:
    """What leaves the scene is not chased: such points count as if they were in the middle."""
    if moving is None:
        return None
    gone = (moving - aimed.centre).norm(dim=2, keepdim=True) > GONE * aimed.radius
    return torch.where(gone, aimed.centre, moving)


def merge_subjects(subjects: Sequence[Subject]) -> Subject:
    """The box around several subjects; the camera aims at the middle of what they would have it aim at."""
    if len(subjects) == 1:
        return subjects[0]
    low = torch.stack([s.centre - s.half for s in subjects]).amin(0)
    high = torch.stack([s.centre + s.half for s in subjects]).amax(0)
    aims = torch.stack([s.target for s in subjects])
    moving = [s.moving for s in subjects if s.moving is not None]
    times = max(map(len, moving), default=0)
    moving = torch.cat([m[_even(len(m), times)] for m in moving], 1) if moving else None
    return Subject((low + high) / 2, (high - low) / 2, aims.mean(0), moving)


def _box(footage: Animation, seen: Gaussians, ids: Int[Tensor, "o"]) -> Subject:
    """Where these objects are in the course of the film, and where they start: what is lifted is not up for long."""
    trajectory = footage.trajectory
    if trajectory is not None:
        moving = torch.isin(trajectory.keypoints.object_id, ids)
        if moving.any():
            shown = (trajectory.positions if footage.moves else trajectory.positions[[footage.frozen or 0]])[:, moving]
            box = merge_subjects([robust_box(shown.reshape(-1, 3)), robust_box(shown[0])])
            return replace(box, moving=_moving(shown, STIRS * box.radius))
    return robust_box(seen.means[torch.isin(seen.object_id, ids)])


def _moving(shown: Float[Tensor, "t p 3"], least: float) -> Float[Tensor, "t m 3"] | None:
    """Those of the points that move by more than `least`, thinned in time and number."""
    shown = shown[_even(len(shown), min(len(shown), MOMENTS))]
    shown = shown[:, (shown - shown[0]).norm(dim=2).amax(0) > least]
    return shown[:, _even(shown.shape[1], min(shown.shape[1], FOLLOWED))] if shown.shape[1] else None


def _even(have: int, count: int) -> Int[Tensor, "c"]:
    """`count` indices from the first to the last of `have`."""
    return torch.linspace(0, max(have - 1, 0), count).round().long()


def _central(g: Gaussians, aimed: Subject | None) -> Int[Tensor, "o"]:
    """Ids of the objects that matter: not scraps, nor those far from where the cameras look, unless all are."""
    ids, counts = g.object_id[g.object_id > 0].unique(return_counts=True)
    ids = ids[counts >= SCRAP * counts.max()] if len(ids) else ids
    if aimed is None or not len(ids):
        return ids
    centres = torch.stack([g.means[g.object_id == i].median(0).values for i in ids])
    near = (centres - aimed.centre).norm(dim=1) < ASTRAY * aimed.radius
    return ids[near] if near.any() else ids


def robust_box(points: Float[Tensor, "n 3"]) -> Subject:
    """The box of the middle nine tenths of each coordinate, grown by what was cut off on average."""
    thinned = points[:: max(1, len(points) // MANY)].double()
    low, high = torch.quantile(thinned, torch.tensor(KEPT, dtype=torch.float64), dim=0)
    half = (high - low) / 2 / (KEPT[1] - KEPT[0])
    return Subject(((low + high) / 2).float(), half.float().clamp_min(1e-6))


def axes_focus(cameras: Cameras) -> Subject | None:
    """The point nearest to all viewing axes.

    Nothing when the axes are nearly parallel, or when fewer than half of the cameras see that point.
    """
    eyes = centres(cameras.viewmats).double()
    axes = cameras.viewmats[:, 2, :3].double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]  # projects an axis away
    normal = across.sum(0)
    if torch.linalg.eigvalsh(normal)[0] < 0.02 * len(cameras):
        return None
    point = torch.linalg.solve(normal, (across @ eyes[..., None]).sum(0))[:, 0].float()
    depth = torch.stack([depths(point[None], viewmat)[0] for viewmat in cameras.viewmats])
    if (depth > 0).float().mean() < 0.5:
        return None
    return _at(point, depth[depth > 0].median())


def common_view_centre(cameras: Cameras, points: Float[Tensor, "n 3"]) -> Subject | None:
    """Where the points lie that are in the middle of most photos, for cameras that look in one direction."""
    points = points[:: max(1, len(points) // MANY)]
    middle = torch.zeros(len(points))
    for viewmat, K, size in zip(cameras.viewmats, cameras.Ks, cameras.sizes, strict=True):
        offset = (project(points, viewmat, K) / size - 0.5).abs()
        middle += ((offset < 0.25).all(1) & (depths(points, viewmat) > 0)).float()
    shared = points[middle >= 0.5 * len(cameras)]
    if not len(shared):
        return None
    point = shared.median(0).values
    return _at(point, (centres(cameras.viewmats) - point).norm(dim=1).median())


def _at(point: Float[Tensor, "3"], distance: Float[Tensor, ""]) -> Subject:
    """A cube whose corners are a third as far from its centre as the cameras."""
    return Subject(point, (distance / 3 / 3**0.5).expand(3))
