"""Pose of a whole object from learned matches between an image of the seen part and renderings of the whole.

The whole is rendered from all around, and the image is matched to every rendering. The matches with the best rendering
are lifted to points on both surfaces, from which RANSAC estimates a similarity. It is only a hint: registration.py
tries it with its own hypotheses and chooses the best by position and colour.
Source: the paper's refinement, which uses SuperGlue; Lindenberger et al. 2023, "LightGlue: Local feature matching at
light speed"; Fischler and Bolles 1981, "Random sample consensus".
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import centres, intrinsics, orbit
from stages.core.geometry.similarity import Similarity, umeyama
from stages.core.models.matching.weights import Matcher
from stages.core.raster.rasterise import rasterise
from stages.core.scene.gaussians import Gaussians
from stages.refine.registration_hypotheses import PoseHypotheses

YAWS, PITCHES = 20, (0.0, 9.0, 18.0, 27.0, 36.0)  # number of yaws, and pitches [degrees], as in the public code
# Size of the renderings [px], focal length [sides; 40 degrees] and camera distance [longest extent of the object].
SIDE, FOCAL, RADIUS = 256, 1.374, 1.6
MAX_KEYPOINTS, MIN_SCORE = 1024, 0.02  # most keypoints of an image, and their smallest score
HYPOTHESES, SAMPLE = 256, 6  # hypotheses of RANSAC, and matches per hypothesis
MAX_ERROR = 0.05  # largest distance between matched points of an inlier [longest extent of the part]
MIN_ALPHA = 0.5  # alpha above which a pixel shows a surface


class View(NamedTuple):
    """An image of an object alone, with the surface point of each pixel."""

    image: Float[Tensor, "s s 3"]
    points: Float[Tensor, "s s 3"]  # nan for pixels without a surface


def matched_place(matcher: Matcher, part: View, whole: Gaussians, seed: int = 0) -> Similarity | None:
    """The similarity from `whole` to the part, by matches with its image; None if there are too few inliers."""
    keypoints, descriptors = matcher.features.keypoints_of(part.image, MAX_KEYPOINTS, MIN_SCORE)
    best: tuple[Tensor, Tensor] | None = None
    for view in views_around(whole):
        other, others = matcher.features.keypoints_of(view.image, MAX_KEYPOINTS, MIN_SCORE)
        sizes = tuple((v.image.shape[1], v.image.shape[0]) for v in (part, view))
        rows = matcher.glue.match((keypoints, other), (descriptors, others), sizes)
        a, b = _lifted(part, keypoints[rows[:, 0]]), _lifted(view, other[rows[:, 1]])
        known = a.isfinite().all(1) & b.isfinite().all(1)
        if best is None or int(known.sum()) > len(best[0]):
            best = a[known], b[known]
    return None if best is None else ransac_similarity(best[1], best[0], seed)


def view_of(part: Gaussians, image: Float[Tensor, "s s 3"], viewmat: Tensor, K: Tensor) -> View:
    """An image, with the surface points of the object that its camera sees."""
    height, width = image.shape[:2]
    drawn = rasterise(part, viewmat[None], K[None], width, height)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    x, y, depth = x.to(drawn.depth), y.to(drawn.depth), drawn.depth[0]
    ray = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1)
    points = centres(viewmat[None])[0] + depth[..., None] * ray @ viewmat[:3, :3]
    return View(image, torch.where(drawn.alpha[0, ..., None] > MIN_ALPHA, points, torch.nan))


def views_around(whole: Gaussians) -> list[View]:
    """Render an object from all around, on white."""
    low, high = whole.means.amin(0), whole.means.amax(0)
    K = intrinsics(SIDE, SIDE, FOCAL * SIDE).to(low)
    views = []
    for pitch in PITCHES:
        for viewmat in orbit(YAWS, ((low + high) / 2).cpu(), RADIUS * float((high - low).max()), pitch).to(low):
            drawn = rasterise(whole, viewmat[None], K[None], SIDE, SIDE, torch.ones(3).to(low))
            views.append(view_of(whole, drawn.rgb[0].clamp(0, 1), viewmat, K))
    return views


def _lifted(view: View, keypoints: Float[Tensor, "k 2"]) -> Float[Tensor, "k 3"]:
    """The surface points at keypoints of an image."""
    side = torch.tensor([view.image.shape[1], view.image.shape[0]]).to(keypoints) - 1
    x, y = keypoints.floor().clamp_min(0).minimum(side).long().unbind(1)
    return view.points[y, x]


def ransac_similarity(source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"], seed: int) -> Similarity | None:
    """The similarity from source to target with most inliers, fitted to them; None with fewer than SAMPLE inliers."""
    if len(source) < SAMPLE:
        return None
    rng = torch.Generator().manual_seed(seed)
    chosen = torch.rand(HYPOTHESES, len(source), generator=rng).topk(SAMPLE, dim=1).indices.to(source.device)
    poses = PoseHypotheses.fitted(source[chosen], target[chosen])
    limit = MAX_ERROR * float((target.amax(0) - target.amin(0)).max())
    agree = (poses(source) - target).norm(dim=2) < limit
    inliers = agree[agree.sum(1).argmax()]
    return umeyama(source[inliers], target[inliers]) if int(inliers.sum()) >= SAMPLE else None
