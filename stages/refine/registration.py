"""A part of an object found on the whole of it: the similarity that puts the whole where the part is.

Features are matched, many threes of matches give a guess each, the best guesses are polished, in the end against the
whole with as much noise as the part has. Colours count all along. The part may be any 60 % of the surface, of any
size, turned any way. All is done on the device where the Gaussians are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import BruteForce, KDTree, neighbour_index
from stages.core.geometry.rotations import matrix, nearest_rotation
from stages.core.geometry.similarity import Similarity
from stages.core.scene.gaussians import Gaussians
from stages.refine.registration_cloud import COLOUR_WEIGHT, SMOOTHING_RADIUS, RegistrationCloud
from stages.refine.registration_hypotheses import PoseHypotheses, misfit, pose_hypotheses

MIN_REGISTRATION_POINTS = 100  # points of a part, or there is nothing to go by
PLANE = 0.7  # weight of the distance along the normal; along the surface it is the rest, or plain parts would hold all
AROUND = 300  # poses tried around one that was given
RELIT = 15 * COLOUR_WEIGHT  # most that light may shift a colour; more is another colour


@dataclass(frozen=True)
class Registration:
    """Where the whole is."""

    similarity: Similarity  # whole to part
    fit: float  # 1: every point of the part is on the whole, in place and colour; 0: none within 6 % of the diameter


def register(part: Gaussians, whole: Gaussians, seed: int = 0, hint: Similarity | None = None) -> Registration | None:
    """Put `whole` where `part` is, perhaps near a `hint`; nothing when no three features agree and none was given."""
    return register_clouds(RegistrationCloud.of(part, seed), RegistrationCloud.of(whole, seed), seed, hint)


def register_clouds(
    part: RegistrationCloud, whole: RegistrationCloud, seed: int = 0, hint: Similarity | None = None
) -> Registration | None:
    """As `register`, for clouds made before."""
    rough = coarse_registration(part, whole, seed, hint)
    return fine_registration(rough, part, whole, seed) if len(rough) else None


def coarse_registration(
    part: RegistrationCloud, whole: RegistrationCloud, seed: int = 0, hint: Similarity | None = None
) -> PoseHypotheses:
    """The few most promising poses, the best first, about 3 degrees off; none where no features agree.

    With a `hint`, whole to part, those tried are the ones around it too.
    """
    if min(len(part.points), len(whole.points)) < MIN_REGISTRATION_POINTS:
        return PoseHypotheses(torch.zeros(0), torch.zeros(0, 3, 3), torch.zeros(0, 3))
    poses = pose_hypotheses(part, whole, seed)
    if hint is not None:
        poses = PoseHypotheses.joined(to_normalised_frames(hint, part, whole).shaken(AROUND, seed), poses)
    if not len(poses):
        return poses
    tree, order = whole.tree(), _order(part, seed)
    poses = _best(poses, part, tree, order[:60], 200)
    poses = _best(poses, part, tree, order[:300], 200).distinct(12, 8.0, 0.05)
    poses = gauss_newton(poses, part, order[:300], whole, tree, 10, 0.03)
    return _best(poses, part, tree, order[:1000], 12).distinct(2, 4.0, 0.02)


def fine_registration(
    poses: PoseHypotheses, part: RegistrationCloud, whole: RegistrationCloud, seed: int = 0
) -> Registration:
    """The best of rough poses and some around them, as exact as the part allows."""
    order, size = _order(part, seed), float(poses.scale[0])
    noise, tint = _difference(poses[:1], part, whole)
    noisy = whole.as_seen(size * noise, tint, SMOOTHING_RADIUS * size, seed)
    tree = noisy.tree()
    poses = gauss_newton(poses.shaken(5, seed), part, order[:700], noisy, tree, 10, 0.03)
    poses = _best(poses, part, tree, order, 1)
    for _ in range(3):  # what is polished is not quite what is judged, so the way there may have been better
        poses = PoseHypotheses.joined(poses, gauss_newton(poses[-1:], part, order[:2500], noisy, tree, 7, 0.02))
    poses = _best(poses, part, tree, order, 1)
    fit = 1 - float(misfit(poses, part.points, part.colours, tree))
    return Registration(_in_the_scene(poses, part, whole), fit)


def coarse_fit(poses: PoseHypotheses, part: RegistrationCloud, whole: RegistrationCloud) -> float:
    """Fit of the first of rough poses; 0 without any."""
    return 1 - float(misfit(poses[:1], part.points, part.colours, whole.tree())) if len(poses) else 0.0


def _order(part: RegistrationCloud, seed: int) -> Int[Tensor, "n"]:
    """The part's points shuffled, so that the first few are anywhere."""
    order = torch.randperm(len(part.points), generator=torch.Generator().manual_seed(seed))
    return order.to(part.points.device)


def _best(
    poses: PoseHypotheses, part: RegistrationCloud, tree: KDTree | BruteForce, some: Int[Tensor, "k"], most: int
) -> PoseHypotheses:
    """The `most` that fit best, in order, judged by `some` points."""
    worth = misfit(poses, part.points[some], part.colours[some], tree)
    return poses[worth.topk(min(most, len(poses)), largest=False).indices]


def _difference(
    pose: PoseHypotheses, part: RegistrationCloud, whole: RegistrationCloud
) -> tuple[float, Float[Tensor, "3"]]:
    """Of a part from its whole: standard deviation off the surface [diameters of the part], and median colour.

    Noise makes a thin thing thicker and its rim wider; a whole as noisy as the part is wider by as much. And the part
    may be seen in another light, though not in any.
    """
    moved = pose(part.raw[:3000])[0]
    index = neighbour_index(whole.points).query(moved)[1][:, 0]
    off = ((moved - whole.points[index]) * whole.normals[index]).sum(1)
    tint = (part.raw_colours[:3000] - whole.colours[index]).median(0).values
    return 1.4826 * float(off.abs().median()) / float(pose.scale[0]), tint.clamp(-RELIT, RELIT)


def gauss_newton(
    poses: PoseHypotheses,
    part: RegistrationCloud,
    some: Int[Tensor, "k"],
    whole: RegistrationCloud,
    tree: KDTree | BruteForce,
    rounds: int,
    floor: float,
) -> PoseHypotheses:
    """Gauss-Newton on the robust one-sided coloured Chamfer distance, all poses at once.

    Nearest neighbours are taken in place and colour; their distance counts mostly along the normal (Chen and Medioni
    1992) and with weight 1 / (1 + (d / tau)^2)^2 (Geman and McClure 1985), tau being 2.5 times the median distance or
    `floor` [diameters]. It is measured in the part's own units: in the whole's, to shrink would always look better.
    """
    x, colours = part.points[some].double(), part.colours[some].double()
    targets, normals = whole.points.double(), whole.normals.double()
    poses = PoseHypotheses(poses.scale.double(), poses.rotation.double(), poses.translation.double())
    for _ in range(rounds):
        y = poses(x)
        distance, index = (found[..., 0] for found in tree.query(torch.cat([y, colours.expand_as(y)], 2)))
        tau = (2.5 * distance.median(1, keepdim=True).values).clamp_min(floor)
        step = _step(y, y - targets[index], normals[index], 1 / (1 + (distance / tau).square()))
        poses = _moved(poses, y.mean(1), step)
        if float(step.abs().max()) < 2e-5:
            break
    return PoseHypotheses(poses.scale.float(), nearest_rotation(poses.rotation).float(), poses.translation.float())


def _step(
    y: Float[Tensor, "h k 3"], error: Float[Tensor, "h k 3"], normals: Float[Tensor, "h k 3"], weight: Tensor
) -> Float[Tensor, "h 7"]:
    """Turn [rad], shift and log scale about the mean of y that lessen the weighted errors the most."""
    arm = y - y.mean(1, keepdim=True)
    axes = [(normals, PLANE), *((axis.expand_as(y), 1 - PLANE) for axis in torch.eye(3).to(y))]
    system = y.new_zeros(len(y), 8, 8)
    for axis, share in axes:
        along = [((arm - error) * axis).sum(2, keepdim=True), (error * axis).sum(2, keepdim=True)]
        rows = torch.cat([torch.linalg.cross(arm, axis), axis, *along], 2) * (share**0.5 * weight[..., None])
        system += rows.mT @ rows
    H, slope = system[:, :7, :7], system[:, :7, 7]
    damping = 1e-9 * H.diagonal(dim1=1, dim2=2).mean(1)
    return -torch.linalg.solve(H + damping[:, None, None] * torch.eye(7).to(y), slope).clamp(-0.5, 0.5)


def _moved(poses: PoseHypotheses, about: Float[Tensor, "h 3"], step: Float[Tensor, "h 7"]) -> PoseHypotheses:
    """Poses after a step of Gauss-Newton."""
    angle = step[:, :3].norm(dim=1, keepdim=True).clamp_min(1e-12)
    turn = matrix(torch.cat([(angle / 2).cos(), step[:, :3] / angle * (angle / 2).sin()], 1))
    grown = step[:, 6].exp()
    arm = (turn @ (poses.translation - about)[..., None])[..., 0]
    return PoseHypotheses(poses.scale * grown, turn @ poses.rotation, grown[:, None] * arm + about + step[:, 3:6])


def to_normalised_frames(place: Similarity, part: RegistrationCloud, whole: RegistrationCloud) -> PoseHypotheses:
    """Part to whole in normalised frames, from whole to part in the units of the scene."""
    place = place.to(part.centre.device)
    R = place.rotation.mT
    scale = part.diameter / (place.scale * whole.diameter)
    middle = (R @ (part.centre - place.translation) / place.scale - whole.centre) / whole.diameter
    return PoseHypotheses(torch.tensor([scale]).to(R), R[None], middle[None])


def _in_the_scene(pose: PoseHypotheses, part: RegistrationCloud, whole: RegistrationCloud) -> Similarity:
    """Whole to part in the units of the scene, from part to whole in normalised frames."""
    scale, R = float(pose.scale[0]), pose.rotation[0].mT
    grown = part.diameter / (scale * whole.diameter)
    shift = part.centre - part.diameter / scale * R @ pose.translation[0] - grown * R @ whole.centre
    return Similarity(grown, R, shift)
