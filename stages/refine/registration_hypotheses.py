"""Hypotheses of the similarity between two clouds, from consistent triples of matched local features."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import BruteForce, KDTree
from stages.core.geometry.rotations import matrix, nearest_rotation
from stages.refine.registration_cloud import COLOUR_WEIGHT, RegistrationCloud

FEATURE_RADII = (0.07, 0.14, 0.28)  # radii of the described neighbourhoods [diameter of the whole object]
SCALES = (1.0, 1.15, 1.32, 1.52)  # ratios of the diameters of whole and part that are tried, as features have no scale
SCALE_TOLERANCE = 1.18  # largest ratio of an edge to its expected length; more than the step between SCALES
KEYPOINTS, MATCHES_PER_KEYPOINT = 500, 4  # keypoints of the part, and matches of each
TARGETS = 2000  # points of the whole to which keypoints are matched
TRIPLES = 40_000  # triples of matches drawn for each scale
MAX_HYPOTHESES = 6000  # most hypotheses that are returned
MAX_RESIDUAL = 0.06  # joint distance in position and colour at which residuals are truncated [diameter]


@dataclass(frozen=True)
class PoseHypotheses:
    """Similarities from part to whole in the clouds' normalised frames: x -> scale R x + translation."""

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
        """Least-squares similarities a to b, batched. Source: Umeyama 1991, as in stages.core.geometry.similarity."""
        mean_a, mean_b = a.mean(1, keepdim=True), b.mean(1, keepdim=True)
        A, B = a - mean_a, b - mean_b
        H = B.mT @ A
        R = nearest_rotation(H)
        scale = (R * H).sum((1, 2)) / A.square().sum((1, 2)).clamp_min(1e-12)
        return PoseHypotheses(scale, R, (mean_b - scale[:, None, None] * (mean_a @ R.mT))[:, 0])

    @staticmethod
    def joined(*parts: PoseHypotheses) -> PoseHypotheses:
        """Concatenate sets of hypotheses."""
        return PoseHypotheses(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(PoseHypotheses)))

    def perturbed(self, copies: int, seed: int) -> PoseHypotheses:
        """These poses and `copies` perturbations of each, by about 5 degrees, 4 % of scale and 2 % of the diameter."""
        rng = torch.Generator().manual_seed(seed)
        at = self.scale.device
        some = self[torch.arange(len(self), device=at).repeat(copies)]
        quats = torch.nn.functional.pad(0.025 * torch.randn(len(some), 3, generator=rng), (1, 0), value=1.0)
        turn, grown = matrix(quats).to(at), (0.04 * torch.randn(len(some), generator=rng)).exp().to(at)
        shift = 0.01 * torch.randn(len(some), 3, generator=rng).to(at)
        moved = grown[:, None] * (turn @ some.translation[..., None])[..., 0] + shift
        return PoseHypotheses.joined(self, PoseHypotheses(some.scale * grown, turn @ some.rotation, moved))

    def distinct(self, count: int, degrees: float, shift: float) -> PoseHypotheses:
        """The first `count` poses that differ from all kept before by at least an angle or a shift [diameter]."""
        traces = self.rotation.flatten(1) @ self.rotation.flatten(1).mT
        rotated = torch.rad2deg(((traces - 1) / 2).clamp(-1, 1).arccos())
        shifted = (self.translation[:, None] - self.translation).norm(dim=2)
        alike = ((rotated < degrees) & (shifted < shift)).tolist()  # one copy from the GPU
        kept: list[int] = []
        for i in range(len(self)):
            if len(kept) < count and not any(alike[i][j] for j in kept):
                kept.append(i)
        return self[torch.tensor(kept, dtype=torch.int64).to(self.scale.device)]


def misfit(
    poses: PoseHypotheses, points: Float[Tensor, "n 3"], colours: Float[Tensor, "n 3"], tree: KDTree | BruteForce
) -> Float[Tensor, "h"]:
    """Mean squared distance of the part's points from the whole in position and colour, truncated to 0..1.

    The unit is MAX_RESIDUAL^2. The distance is one-sided, since the part is incomplete, and truncated for robustness to
    outliers.
    """
    moved = poses(points)
    distance, _ = tree.query(torch.cat([moved, colours.expand_as(moved)], 2), within=MAX_RESIDUAL)
    return (distance[..., 0].clamp_max(MAX_RESIDUAL) / MAX_RESIDUAL).square().mean(1)


def local_features(cloud: RegistrationCloud, at: Int[Tensor, "k"], unit: float) -> Float[Tensor, "k f"]:
    """Rotation-invariant features of the neighbourhoods of the points `at`, with radii of FEATURE_RADII times `unit`.

    For each neighbourhood: mean and standard deviation of colour, the three principal standard deviations of position,
    and the offset of the mean from the point, along the normal and in total. Each is divided by its typical variation.
    """
    x, colour, q = cloud.points, cloud.colours / COLOUR_WEIGHT, cloud.points[at]
    squared = torch.cdist(q, x).square()
    second = (x[:, :, None] * x[:, None]).flatten(1)
    values = torch.cat([x.new_ones(len(x), 1), x, second, colour, colour.square()], 1)
    out = []
    for r in (unit * radius for radius in FEATURE_RADII):
        sums = (1 - squared / r**2).clamp_min(0) @ values
        _, mean, second, colour_mean, colour_square = (sums / sums[:, :1]).split([1, 3, 9, 3, 3], 1)
        covariance = second.unflatten(1, (3, 3)) - mean[:, :, None] * mean[:, None]
        off = mean - q
        out += [
            colour_mean / 12, (colour_square - colour_mean.square()).clamp_min(0).sqrt() / 12,
            torch.linalg.eigvalsh(covariance).clamp_min(0).sqrt() / (0.05 * r),
            (off * cloud.normals[at]).sum(1, keepdim=True).abs() / (0.05 * r),
            off.norm(dim=1, keepdim=True) / (0.08 * r),
        ]  # fmt: skip
    return torch.cat(out, 1)


def pose_hypotheses(part: RegistrationCloud, whole: RegistrationCloud, seed: int = 0) -> PoseHypotheses:
    """Similarities from triples of matches with consistent distances and angles between normals.

    Source: RANSAC by Fischler and Bolles 1981; comparison of edges before fitting as in Rusu et al. 2009, "Fast point
    feature histograms (FPFH) for 3D registration".
    """
    generator, at = torch.Generator().manual_seed(seed), part.points.device
    targets = torch.randperm(len(whole.points), generator=generator)[:TARGETS].to(at)
    keypoints = torch.randperm(len(part.points), generator=generator)[:KEYPOINTS].to(at)
    features = local_features(whole, targets, 1.0)
    found = []
    for size in SCALES:
        feature_distance = torch.cdist(local_features(part, keypoints, size), features)
        choices = targets[feature_distance.topk(min(MATCHES_PER_KEYPOINT, len(targets)), dim=1, largest=False).indices]
        triple = torch.randint(len(keypoints), (TRIPLES, 3), generator=generator).to(at)
        which = torch.randint(choices.shape[1], (TRIPLES, 3), generator=generator).to(at)
        found.append(_consistent(part, whole, keypoints[triple], choices[triple, which], size))
    a, b = (torch.cat(side) for side in zip(*found, strict=True))
    poses = PoseHypotheses.fitted(a, b)
    exact = (poses.scale[:, None, None] * (a @ poses.rotation.mT) + poses.translation[:, None] - b).norm(dim=2).amax(1)
    return poses[(exact < 0.05) & (poses.scale > 0.5) & (poses.scale < 1.15)][:MAX_HYPOTHESES]


def _consistent(
    part: RegistrationCloud, whole: RegistrationCloud, i: Int[Tensor, "d 3"], j: Int[Tensor, "d 3"], size: float
):
    """Points of the triples that are large enough, have similar proportions and roughly the assumed scale."""
    a, b = part.points[i], whole.points[j]
    edges_a, edges_b = ((p - p.roll(1, 1)).norm(dim=2) for p in (a, b))
    ratio = size * edges_b / edges_a.clamp_min(1e-9)
    ok = (edges_a.amin(1) > 0.15) & (ratio > 1 / SCALE_TOLERANCE).all(1) & (ratio < SCALE_TOLERANCE).all(1)
    ok &= ratio.amax(1) < 1.15 * ratio.amin(1)
    bend_a, bend_b = ((n * n.roll(1, 1)).sum(2).abs() for n in (part.normals[i], whole.normals[j]))
    ok &= ((bend_a - bend_b).abs() < 0.35).all(1)
    return a[ok], b[ok]
