"""Guesses of a similarity between two clouds: local features are matched, and threes of matches that agree are kept."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import BruteForce, KDTree
from stages.core.geometry.rotations import matrix, nearest_rotation
from stages.refine.registration_cloud import COLOUR_WEIGHT, RegistrationCloud

RADII = (0.07, 0.14, 0.28)  # of the neighbourhoods described [diameters of the whole object]
SIZES = (1.0, 1.15, 1.32, 1.52)  # diameters of the whole in those of the part; a feature knows no scale, so try some
SLACK = 1.18  # between two of these sizes, and to spare
KEYPOINTS, CHOICES = 500, 4  # points of the part that are matched, and matches kept for each
TARGETS = 2000  # points of the whole to match with
DRAWS = 40_000  # threes of matches for each size
WORST = 0.06  # coloured distance at which a point counts as not matched at all [diameters]


@dataclass(frozen=True)
class PoseHypotheses:
    """Candidate similarities, part to whole, in the clouds' normalised frames: x -> scale R x + translation."""

    scale: Float[Tensor, "h"]
    rotation: Float[Tensor, "h 3 3"]
    translation: Float[Tensor, "h 3"]

    def __len__(self) -> int:
        return len(self.scale)

    def __getitem__(self, index) -> PoseHypotheses:
        return PoseHypotheses(self.scale[index], self.rotation[index], self.translation[index])

    def __call__(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "h n 3"]:
        return self.scale[:, None, None] * (points @ self.rotation.mT) + self.translation[:, None]

    @staticmethod
    def fitted(a: Float[Tensor, "h k 3"], b: Float[Tensor, "h k 3"]) -> PoseHypotheses:
        """Least squares, a to b. Source: Umeyama 1991, as in stages.core.geometry.similarity, for many at once."""
        mean_a, mean_b = a.mean(1, keepdim=True), b.mean(1, keepdim=True)
        A, B = a - mean_a, b - mean_b
        H = B.mT @ A
        R = nearest_rotation(H)
        scale = (R * H).sum((1, 2)) / A.square().sum((1, 2)).clamp_min(1e-12)
        return PoseHypotheses(scale, R, (mean_b - scale[:, None, None] * (mean_a @ R.mT))[:, 0])

    @staticmethod
    def joined(*parts: PoseHypotheses) -> PoseHypotheses:
        return PoseHypotheses(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(PoseHypotheses)))

    def shaken(self, copies: int, seed: int) -> PoseHypotheses:
        """These, and `copies` of each about 5 degrees, 4 % of size and 2 % of the diameter off, about the origin."""
        rng = torch.Generator().manual_seed(seed)
        at = self.scale.device
        some = self[torch.arange(len(self), device=at).repeat(copies)]
        quats = torch.nn.functional.pad(0.025 * torch.randn(len(some), 3, generator=rng), (1, 0), value=1.0)
        turn, grown = matrix(quats).to(at), (0.04 * torch.randn(len(some), generator=rng)).exp().to(at)
        shift = 0.01 * torch.randn(len(some), 3, generator=rng).to(at)
        moved = grown[:, None] * (turn @ some.translation[..., None])[..., 0] + shift
        return PoseHypotheses.joined(self, PoseHypotheses(some.scale * grown, turn @ some.rotation, moved))

    def distinct(self, most: int, degrees: float, far: float) -> PoseHypotheses:
        """The first `most` that differ from all before them by an angle or a shift."""
        traces = self.rotation.flatten(1) @ self.rotation.flatten(1).mT
        turned = torch.rad2deg(((traces - 1) / 2).clamp(-1, 1).arccos())
        shifted = (self.translation[:, None] - self.translation).norm(dim=2)
        alike = ((turned < degrees) & (shifted < far)).tolist()  # one copy; to ask a GPU for each would take longer
        kept: list[int] = []
        for i in range(len(self)):
            if len(kept) < most and not any(alike[i][j] for j in kept):
                kept.append(i)
        return self[torch.tensor(kept, dtype=torch.int64).to(self.scale.device)]


def misfit(
    poses: PoseHypotheses, points: Float[Tensor, "n 3"], colours: Float[Tensor, "n 3"], tree: KDTree | BruteForce
) -> Float[Tensor, "h"]:
    """Mean squared distance, in place and colour, of the part's points from the whole, in units of WORST^2: 0 to 1.

    One-sided, as what the part lacks says nothing, and cut off, as what is not of the object says little.
    """
    moved = poses(points)
    distance, _ = tree.query(torch.cat([moved, colours.expand_as(moved)], 2), within=WORST)
    return (distance[..., 0].clamp_max(WORST) / WORST).square().mean(1)


def local_features(cloud: RegistrationCloud, at: Int[Tensor, "k"], unit: float) -> Float[Tensor, "k f"]:
    """What surrounds points of a cloud within RADII times `unit`, whichever way it is turned.

    Of each neighbourhood: mean colour, its spread, the three standard deviations of place, and how far the mean lies
    off the point, along the normal and at all. Each is divided by what it usually differs by.
    """
    x, colour, q = cloud.points, cloud.colours / COLOUR_WEIGHT, cloud.points[at]
    squared = torch.cdist(q, x).square()
    second = (x[:, :, None] * x[:, None]).flatten(1)
    values = torch.cat([x.new_ones(len(x), 1), x, second, colour, colour.square()], 1)
    out = []
    for r in (unit * radius for radius in RADII):
        sums = (1 - squared / r**2).clamp_min(0) @ values
        _, mean, second, tint, tint2 = (sums / sums[:, :1]).split([1, 3, 9, 3, 3], 1)
        covariance = second.unflatten(1, (3, 3)) - mean[:, :, None] * mean[:, None]
        off = mean - q
        out += [
            tint / 12, (tint2 - tint.square()).clamp_min(0).sqrt() / 12,
            torch.linalg.eigvalsh(covariance).clamp_min(0).sqrt() / (0.05 * r),
            (off * cloud.normals[at]).sum(1, keepdim=True).abs() / (0.05 * r),
            off.norm(dim=1, keepdim=True) / (0.08 * r),
        ]  # fmt: skip
    return torch.cat(out, 1)


def pose_hypotheses(
    part: RegistrationCloud, whole: RegistrationCloud, seed: int = 0, most: int = 6000
) -> PoseHypotheses:
    """Similarities through three matches each whose distances, and angles of normals, agree.

    Source: Fischler and Bolles 1981; agreement of edges before fitting as in Rusu et al. 2009, "Fast point feature
    histograms (FPFH) for 3D registration".
    """
    generator, at = torch.Generator().manual_seed(seed), part.points.device
    targets = torch.randperm(len(whole.points), generator=generator)[:TARGETS].to(at)
    keypoints = torch.randperm(len(part.points), generator=generator)[:KEYPOINTS].to(at)
    features = local_features(whole, targets, 1.0)
    found = []
    for size in SIZES:
        like = torch.cdist(local_features(part, keypoints, size), features)
        choices = targets[like.topk(min(CHOICES, len(targets)), dim=1, largest=False).indices]
        three = torch.randint(len(keypoints), (DRAWS, 3), generator=generator).to(at)
        which = torch.randint(choices.shape[1], (DRAWS, 3), generator=generator).to(at)
        found.append(_agreeing(part, whole, keypoints[three], choices[three, which], size))
    a, b = (torch.cat(side) for side in zip(*found, strict=True))
    poses = PoseHypotheses.fitted(a, b)
    exact = (poses.scale[:, None, None] * (a @ poses.rotation.mT) + poses.translation[:, None] - b).norm(dim=2).amax(1)
    return poses[(exact < 0.05) & (poses.scale > 0.5) & (poses.scale < 1.15)][:most]


def _agreeing(
    part: RegistrationCloud, whole: RegistrationCloud, i: Int[Tensor, "d 3"], j: Int[Tensor, "d 3"], size: float
):
    """Points of the threes that span enough, keep their proportions and are of about the size supposed."""
    a, b = part.points[i], whole.points[j]
    edges_a, edges_b = ((p - p.roll(1, 1)).norm(dim=2) for p in (a, b))
    ratio = size * edges_b / edges_a.clamp_min(1e-9)
    ok = (edges_a.amin(1) > 0.15) & (ratio > 1 / SLACK).all(1) & (ratio < SLACK).all(1)
    ok &= ratio.amax(1) < 1.15 * ratio.amin(1)
    bend_a, bend_b = ((n * n.roll(1, 1)).sum(2).abs() for n in (part.normals[i], whole.normals[j]))
    ok &= ((bend_a - bend_b).abs() < 0.35).all(1)
    return a[ok], b[ok]
