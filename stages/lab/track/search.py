"""Search for a lost object where several images show something that the rest of the scene does not explain."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.geometry.cameras import depths, project
from stages.core.geometry.rotations import matrix, rotation_angle
from stages.lab.track.alignment import Observation, robust_cost
from stages.lab.track.poses import Poses
from stages.lab.track.synthesis import MASK_CONTRAST

if TYPE_CHECKING:
    from stages.lab.track.follow import Tracker

COARSE = 4  # image reduction in the search
SEARCHING = {8: 10, 4: 5}  # maximum number of steps by image reduction, coarse to fine: starts are up to 30 degrees off
MAX_REACH = 12  # half width of the grid of candidate positions [half object sizes]
SPREAD = 0.15  # positions count if their support is at most this much below the highest
MIN_VIEWS = 3  # number of images in which a position must be visible
MIN_SUPPORT = 0.7  # smallest fraction of the images that must show something unexplained at a position
ROTATIONS = 72  # number of rotations tried
STARTS = 4  # number of best rotations from which the object is aligned
DISTINCT = 30.0  # angle from which two rotations count as different [degrees]
DIFFERENT = 0.5  # difference of the renderings of two poses from which a pixel distinguishes them [residual scales]
MIN_DIFFERENT = 24  # smallest number of distinguishing pixels, over all images
PREFERRED = 0.65  # fraction of the distinguishing pixels in which the best pose must fit better than another rotation
VIEWS = 3  # number of images with which rotations are compared
LIKE = 0.15  # largest difference of a pixel that may show the object from the object's palette [colours from 0 to 1]
AWAY = 1e4  # coordinates of an object that is moved out of view [scene units]


class Sighting(NamedTuple):
    """An object that was found again."""

    poses: Poses  # poses of all objects
    distinct: bool  # whether the images distinguish the pose from all other rotations that were tried


def search(tracker: Tracker, frame: int, i: int, poses: Poses, velocity: Tensor, missing: int) -> Sighting | None:
    """The best pose of object i, which was last seen `missing` frames ago; None if it is not visible.

    The search is centred on its last known position in `poses`, since the velocity of an object that was barely visible
    before it was lost is unreliable.
    """
    seen = tracker.observe(frame, COARSE, velocity, velocity)
    gone = without(poses, torch.arange(len(poses.centre), device=tracker.device) == i)
    places = _places(tracker, seen, gone, i, poses.centre[i], missing)
    if not len(places):
        return None
    starts = []
    some = seen[:: math.ceil(len(seen) / VIEWS)]
    for turn in [torch.eye(3), *spread_rotations(ROTATIONS)]:
        start = Poses(poses.rotation.clone(), poses.centre.clone())
        start.rotation[i], start.centre[i] = turn.to(places) @ poses.rotation[i], places.mean(0)
        starts.append((_cost(tracker, some, start), start))
    starts.sort(key=lambda start: start[0])
    if starts[0][0] >= _cost(tracker, some, gone):  # the images are explained better without the object
        return None
    others = torch.arange(len(poses.centre), device=tracker.device) != i
    aligned = [tracker.fit(frame, SEARCHING, start, (velocity, velocity), others) for _, start in starts[:STARTS]]
    likely = min(aligned, key=lambda p: _cost(tracker, seen, p))
    for turn in half_turns(tracker.synthesiser.arm[tracker.synthesiser.row == i]):
        start = Poses(likely.rotation.clone(), likely.centre)
        start.rotation[i] = likely.rotation[i] @ turn
        aligned.append(tracker.fit(frame, SEARCHING, start, (velocity, velocity), others))
    aligned.sort(key=lambda p: _cost(tracker, seen, p))
    best, rivals = aligned[0], [p for p in aligned[1:] if _turned(aligned[0], p, i) > DISTINCT]
    return Sighting(best, all(_preferred(tracker, seen, best, p, tracker.scale[i]) >= PREFERRED for p in rivals))


def half_turns(points: Float[Tensor, "n 3"]) -> Float[Tensor, "3 3 3"]:
    """Half turns about the principal axes of points, which hardly change the outline of a long or flat object."""
    axes = torch.linalg.eigh(points.mT @ points).eigenvectors.mT[..., None]
    return 2 * axes @ axes.mT - torch.eye(3).to(points)


def _turned(a: Poses, b: Poses, i: int) -> float:
    """The angle between two rotations of object i [degrees]."""
    return float(rotation_angle(a.rotation[i] @ b.rotation[i].mT))


def _preferred(tracker: Tracker, seen: list[Observation], best: Poses, rival: Poses, scale: float) -> float:
    """Fraction of the pixels that distinguish two poses in which `best` fits better; 0 if there are too few pixels."""
    nearer, different = 0, 0
    for o in seen:
        one, other = (o.draw(tracker.synthesiser, p) for p in (best, rival))
        apart = (one.image - other.image).nan_to_num().square().mean(-1).sqrt() > DIFFERENT * scale
        closer = o.difference(one).square().mean(-1) < o.difference(other).square().mean(-1)
        nearer, different = nearer + int((apart & closer).sum()), different + int(apart.sum())
    return nearer / different if different >= MIN_DIFFERENT else 0.0


def _cost(tracker: Tracker, seen: list[Observation], poses: Poses) -> float:
    scale = max(tracker.scale)
    return sum(robust_cost(o.difference(o.draw(tracker.synthesiser, poses)), scale) for o in seen)


def without(poses: Poses, mask: Bool[Tensor, "o"]) -> Poses:
    """The poses with the objects in the mask moved out of view."""
    return Poses(poses.rotation, torch.where(mask[:, None].to(poses.centre.device), AWAY, poses.centre))


def _places(
    tracker: Tracker, seen: list[Observation], gone: Poses, i: int, middle: Float[Tensor, "3"], missing: int
) -> Float[Tensor, "n 3"]:
    """Positions around `middle` where most images show something unexplained that has the object's colours."""
    size, limit = tracker.synthesiser.sizes[i], tracker.scale[i]
    reach = min(MAX_REACH, 4 + 2 * missing)
    steps = torch.arange(-reach, reach + 1, device=tracker.device) * size / 2
    places = middle + torch.cartesian_prod(steps, steps, steps)
    palette, paint = tracker.synthesiser.palette(i), tracker.synthesiser.paint
    votes, views = torch.zeros(len(places)).to(places), torch.zeros(len(places)).to(places)
    for o in seen:
        drawn = o.draw(tracker.synthesiser, gone)
        off = o.difference(drawn).square().mean(-1).sqrt()
        like = (o.image[..., None, :3] - palette).square().mean(-1).sqrt().amin(-1) < LIKE
        if paint is not None:  # unknown label pixels are nan and do not exclude a position
            like &= ~((o.image[..., 3:] - paint[i]).norm(dim=-1) > MASK_CONTRAST / 2)
        vote, counted = _looked_up((off > limit) & like, drawn.label < 0, o, places)
        votes, views = votes + vote, views + counted
    support = torch.where(views >= min(MIN_VIEWS, len(seen)), votes / views.clamp_min(1), 0.0)
    return places[support >= max(float(support.max()) - SPREAD, MIN_SUPPORT)]


def _looked_up(
    mask: Bool[Tensor, "h w"], free: Bool[Tensor, "h w"], o: Observation, places: Float[Tensor, "n 3"]
) -> tuple[Bool[Tensor, "n"], Bool[Tensor, "n"]]:
    """The mask at the positions' pixels, and whether each position is inside the image and not occluded."""
    height, width = mask.shape
    x, y = (project(places, o.camera.viewmat, o.camera.K) / o.reduction).floor().long().unbind(1)
    inside = (depths(places, o.camera.viewmat) > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    at = y.clamp(0, height - 1), x.clamp(0, width - 1)
    return mask[at] & free[at] & inside, free[at] & inside


def spread_rotations(count: int) -> Float[Tensor, "n 3 3"]:
    """Evenly distributed rotations; deterministic.

    Source: Alexa 2022, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)".
    """
    s = torch.arange(count) + 0.5
    inner, outer = (s / count).sqrt(), (1 - s / count).sqrt()
    a, b = 2 * torch.pi * s / 2**0.5, 2 * torch.pi * s / 1.533751168755204288118041
    return matrix(torch.stack([inner * a.sin(), inner * a.cos(), outer * b.sin(), outer * b.cos()], 1))
