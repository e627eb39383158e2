"""Registration of a whole object to an observed part of it: estimates the similarity from the whole to the part.

Feature matches give many pose hypotheses (registration_hypotheses.py), of which the best are refined by Gauss-Newton;
in the last round the whole gets the same noise as the part. Positions and colours are used throughout. Tested for parts
with 60 % of the surface, any rotation and scales of 0.5 to 2. Runs on the device of the Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import BruteForce, KDTree, neighbour_index
from stages.core.geometry.rotations import matrix, nearest_rotation
from stages.core.geometry.similarity import Similarity
from stages.core.scene.gaussians import Gaussians
from stages.refine.registration_cloud import COLOUR_WEIGHT, SMOOTHING_RADIUS, RegistrationCloud
from stages.refine.registration_hypotheses import PoseHypotheses, misfit, pose_hypotheses

MIN_REGISTRATION_POINTS = 100  # fewest points of the part and of the whole
NORMAL_WEIGHT = 0.7  # weight of point-to-plane distances; the rest is point-to-point and bounds tangential shifts
HINT_PERTURBATIONS = 300  # number of poses tried around a hint
MAX_TINT = 15 * COLOUR_WEIGHT  # largest colour offset attributed to illumination [diameter]


class Target(NamedTuple):
    """The cloud to which another is registered, and its search structure."""

    cloud: RegistrationCloud
    tree: KDTree | BruteForce


@dataclass(frozen=True)
class Registration:
    """Result of a registration."""

    similarity: Similarity  # from the whole to the part
    fit: float  # 1: all points of the part agree in position and colour; 0: no point within 6 % of the diameter


def register(part: Gaussians, whole: Gaussians, seed: int = 0, hints: Sequence[Similarity] = ()) -> Registration | None:
    """Estimate the similarity from `whole` to `part`; poses near `hints`, which map whole to part, are tried too.

    Returns None for too few points, or if there are neither hints nor consistent features.
    """
    return register_clouds(RegistrationCloud.of(part, seed), RegistrationCloud.of(whole, seed), seed, hints)


def register_clouds(
    part: RegistrationCloud, whole: RegistrationCloud, seed: int = 0, hints: Sequence[Similarity] = ()
) -> Registration | None:
    """As `register`, for registration clouds."""
    coarse = coarse_registration(part, whole, seed, hints)
    return fine_registration(coarse, part, whole, seed) if len(coarse) else None


def coarse_registration(
    part: RegistrationCloud, whole: RegistrationCloud, seed: int = 0, hints: Sequence[Similarity] = ()
) -> PoseHypotheses:
    """At most 2 candidate poses, best first, accurate to about 3 degrees; empty if no features agree.

    Poses around `hints` (whole to part) are tried too.
    """
    if min(len(part.points), len(whole.points)) < MIN_REGISTRATION_POINTS:
        return PoseHypotheses(torch.zeros(0), torch.zeros(0, 3, 3), torch.zeros(0, 3))
    poses = pose_hypotheses(part, whole, seed)
    for hint in hints:
        poses = PoseHypotheses.joined(
            to_normalised_frames(hint, part, whole).perturbed(HINT_PERTURBATIONS, seed), poses
        )
    if not len(poses):
        return poses
    tree, order = whole.tree(), _order(part, seed)
    poses = _best(poses, part, tree, order[:60], 200)
    poses = _best(poses, part, tree, order[:300], 200).distinct(12, 8.0, 0.05)
    poses = gauss_newton(poses, part, order[:300], Target(whole, tree), rounds=10, floor=0.03)
    return _best(poses, part, tree, order[:1000], 12).distinct(2, 4.0, 0.02)


def fine_registration(
    poses: PoseHypotheses, part: RegistrationCloud, whole: RegistrationCloud, seed: int = 0
) -> Registration:
    """Refine the best of the coarse poses and their perturbations, against a whole with the noise of the part."""
    order, size = _order(part, seed), float(poses.scale[0])
    noise, tint = _noise_and_tint(poses[:1], part, whole)
    noisy = whole.as_seen(size * noise, tint, SMOOTHING_RADIUS * size, seed)
    tree = noisy.tree()
    target = Target(noisy, tree)
    poses = gauss_newton(poses.perturbed(5, seed), part, order[:700], target, rounds=10, floor=0.03)
    poses = _best(poses, part, tree, order, 1)
    for _ in range(3):  # keeps intermediate poses, since Gauss-Newton minimises another criterion than `misfit`
        refined = gauss_newton(poses[-1:], part, order[:2500], target, rounds=7, floor=0.02)
        poses = PoseHypotheses.joined(poses, refined)
    poses = _best(poses, part, tree, order, 1)
    fit = 1 - float(misfit(poses, part.points, part.colours, tree))
    return Registration(_to_scene_units(poses, part, whole), fit)


def coarse_fit(poses: PoseHypotheses, part: RegistrationCloud, whole: RegistrationCloud) -> float:
    """Fit of the first coarse pose; 0 if there is none."""
    return 1 - float(misfit(poses[:1], part.points, part.colours, whole.tree())) if len(poses) else 0.0


def _order(part: RegistrationCloud, seed: int) -> Int[Tensor, "n"]:
    """A random permutation of the part's points, so that any prefix is a random sample."""
    order = torch.randperm(len(part.points), generator=torch.Generator().manual_seed(seed))
    return order.to(part.points.device)


def _best(
    poses: PoseHypotheses, part: RegistrationCloud, tree: KDTree | BruteForce, some: Int[Tensor, "k"], count: int
) -> PoseHypotheses:
    """The `count` poses with the smallest misfit of the points `some`, best first."""
    misfits = misfit(poses, part.points[some], part.colours[some], tree)
    return poses[misfits.topk(min(count, len(poses)), largest=False).indices]


def _noise_and_tint(
    pose: PoseHypotheses, part: RegistrationCloud, whole: RegistrationCloud
) -> tuple[float, Float[Tensor, "3"]]:
    """Noise of the part relative to the whole: standard deviation normal to the surface [diameter], and colour offset.

    Noise thickens thin parts and widens their edges; adding the same noise to the whole removes this bias. The colour
    offset, due to illumination, is limited to MAX_TINT.
    """
    moved = pose(part.raw[:3000])[0]
    index = neighbour_index(whole.points).query(moved)[1][:, 0]
    off = ((moved - whole.points[index]) * whole.normals[index]).sum(1)
    tint = (part.raw_colours[:3000] - whole.colours[index]).median(0).values
    return 1.4826 * float(off.abs().median()) / float(pose.scale[0]), tint.clamp(-MAX_TINT, MAX_TINT)


def gauss_newton(
    poses: PoseHypotheses,
    part: RegistrationCloud,
    some: Int[Tensor, "k"],
    target: Target,
    rounds: int,
    floor: float,
) -> PoseHypotheses:
    """Gauss-Newton on a robust one-sided Chamfer distance in position and colour, batched over poses.

    Nearest neighbours are found in position and colour. Their distance is weighted mostly along the normal (Chen and
    Medioni 1992) and by 1 / (1 + (d / tau)^2)^2 (Geman and McClure 1985), where tau is 2.5 times the median distance,
    at least `floor` [diameter]. Distances are in units of the part: in those of the whole, shrinking the part would
    always reduce them.
    """
    x, colours = part.points[some].double(), part.colours[some].double()
    targets, normals = target.cloud.points.double(), target.cloud.normals.double()
    poses = PoseHypotheses(poses.scale.double(), poses.rotation.double(), poses.translation.double())
    for _ in range(rounds):
        y = poses(x)
        distance, index = (found[..., 0] for found in target.tree.query(torch.cat([y, colours.expand_as(y)], 2)))
        tau = (2.5 * distance.median(1, keepdim=True).values).clamp_min(floor)
        step = _step(y, y - targets[index], normals[index], 1 / (1 + (distance / tau).square()))
        poses = _stepped(poses, y.mean(1), step)
        if float(step.abs().max()) < 2e-5:
            break
    return PoseHypotheses(poses.scale.float(), nearest_rotation(poses.rotation).float(), poses.translation.float())


def _step(
    y: Float[Tensor, "h k 3"], error: Float[Tensor, "h k 3"], normals: Float[Tensor, "h k 3"], weight: Tensor
) -> Float[Tensor, "h 7"]:
    """Gauss-Newton step (rotation [rad], translation, log scale) about the mean of y."""
    arm = y - y.mean(1, keepdim=True)
    axes = [(normals, NORMAL_WEIGHT), *((axis.expand_as(y), 1 - NORMAL_WEIGHT) for axis in torch.eye(3).to(y))]
    system = y.new_zeros(len(y), 8, 8)
    for axis, weight_along in axes:
        along = [((arm - error) * axis).sum(2, keepdim=True), (error * axis).sum(2, keepdim=True)]
        rows = torch.cat([torch.linalg.cross(arm, axis), axis, *along], 2) * (weight_along**0.5 * weight[..., None])
        system += rows.mT @ rows
    H, slope = system[:, :7, :7], system[:, :7, 7]
    damping = 1e-9 * H.diagonal(dim1=1, dim2=2).mean(1)
    return -torch.linalg.solve(H + damping[:, None, None] * torch.eye(7).to(y), slope).clamp(-0.5, 0.5)


def _stepped(poses: PoseHypotheses, about: Float[Tensor, "h 3"], step: Float[Tensor, "h 7"]) -> PoseHypotheses:
    """Apply a Gauss-Newton step to poses, about the points `about`."""
    angle = step[:, :3].norm(dim=1, keepdim=True).clamp_min(1e-12)
    rotation = matrix(torch.cat([(angle / 2).cos(), step[:, :3] / angle * (angle / 2).sin()], 1))
    growth = step[:, 6].exp()
    arm = (rotation @ (poses.translation - about)[..., None])[..., 0]
    return PoseHypotheses(poses.scale * growth, rotation @ poses.rotation, growth[:, None] * arm + about + step[:, 3:6])


def to_normalised_frames(place: Similarity, part: RegistrationCloud, whole: RegistrationCloud) -> PoseHypotheses:
    """Convert a similarity (whole to part, scene units) to a pose (part to whole, normalised frames)."""
    place = place.to(part.centre.device)
    R = place.rotation.mT
    scale = part.diameter / (place.scale * whole.diameter)
    middle = (R @ (part.centre - place.translation) / place.scale - whole.centre) / whole.diameter
    return PoseHypotheses(torch.tensor([scale]).to(R), R[None], middle[None])


def _to_scene_units(pose: PoseHypotheses, part: RegistrationCloud, whole: RegistrationCloud) -> Similarity:
    """Convert a pose (part to whole, normalised frames) to a similarity (whole to part, scene units)."""
    scale, R = float(pose.scale[0]), pose.rotation[0].mT
    growth = part.diameter / (scale * whole.diameter)
    shift = part.centre - part.diameter / scale * R @ pose.translation[0] - growth * R @ whole.centre
    return Similarity(growth, R, shift)
