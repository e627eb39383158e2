"""Interactive segmentation: selects the candidates of the network that contain points given by the user."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.models.segmenter.network import Segmenter
from stages.core.models.segmenter.segment import REDUCTIONS, ScoredCandidates, outlined, score_at
from stages.core.models.segmenter.surfels import scene_surfels
from stages.core.models.segmenter.voxels import SCALES
from stages.core.perception.object_limits import ObjectLimits
from stages.core.perception.view_outlines import refine_outlines
from stages.core.scene.scene import Scene

log = logging.getLogger(__name__)
CLICK_REACH = 0.03  # largest distance of a click from the nearest surfel of a candidate [camera distance]


@dataclass(frozen=True)
class Click:
    """A point on an object."""

    point: Float[Tensor, "3"]  # point on the object's surface, world frame
    object: int  # 1 or more
    text: str  # as the user gave it, for messages


@torch.no_grad()
def clicked_ids(scene: Scene, model: Segmenter, clicks: Sequence[Click], limits: ObjectLimits) -> Int[Tensor, "n"]:
    """Return the object number of each Gaussian, which is that of the clicks on it; 0 for the rest.

    An object is the candidate with the largest expected IoU that contains all clicks on the object and no other clicks.
    Clicks for which there is no such candidate are logged. Raises InputError if no object is found for any click.
    """
    ids = torch.zeros(len(scene.gaussians), dtype=torch.int64)
    surfels, index, view = scene_surfels(scene)
    if not len(surfels):
        raise InputError(
            f"--points {clicks[0].text!r}: the scene has no surface close enough to its cameras; reconstruct it again"
        )
    means = scene.gaussians.means[index]
    found: dict[int, tuple[float, Int[Tensor, "n"]]] = {}
    scored = [score_at(surfels, scale, model) for scale in (*SCALES, *REDUCTIONS)]
    for at_scale in scored:
        paths = [_path(at_scale, (means - click.point).norm(dim=1) / view.radius) for click in clicks]
        usable = at_scale.usable(limits.min_size).numpy()
        for number in {click.object for click in clicks}:
            own = [path for path, click in zip(paths, clicks, strict=True) if click.object == number]
            others = [path for path, click in zip(paths, clicks, strict=True) if click.object != number]
            nodes = set.intersection(*own).difference(*others)
            best = max((n for n in nodes if usable[n]), key=lambda n: float(at_scale.ious[n]), default=None)
            if best is not None and float(at_scale.ious[best]) > found.get(number, (-1.0,))[0]:
                found[number] = float(at_scale.ious[best]), at_scale.labels(np.array([best])) == 0
    for click in clicks:
        if click.object not in found:
            log.warning("--points %r: no object was found at this point; choose a point in the middle of the "
                        "object, or mark it with --boxes "
                        "or --masks", click.text)  # fmt: skip
    if not found:
        raise InputError(
            f"--points {clicks[0].text!r}: there is no object at any of the points; choose points in the middle "
            "of objects, or use --boxes or --masks"
        )
    labels = torch.zeros(len(surfels), dtype=torch.int64)
    for number, (_, members) in sorted(found.items(), key=lambda item: -int(item[1][1].sum())):  # small objects last
        labels[members] = number
    ids[index] = outlined(surfels, labels, scored[: len(SCALES)])
    return refine_outlines(scene, ids, device=model.input_projection.weight.device)


def _path(scored: ScoredCandidates, distance: Float[Tensor, "n"]) -> set[int]:
    """Return the candidates that contain the surfel at the smallest `distance`; none if it is beyond CLICK_REACH."""
    leaf = torch.full((int(scored.owner.max()) + 2,), -1)  # the last entry is for surfels without a voxel
    leaf[scored.candidates.voxels] = scored.candidates.leaf
    leaves = leaf[scored.owner]
    nearest = torch.where(leaves >= 0, distance, torch.inf).argmin()
    if leaves[nearest] < 0 or distance[nearest] > CLICK_REACH:
        return set()
    parents, node, path = scored.candidates.tree.parents(), int(leaves[nearest]), set()
    while node >= 0:
        path.add(node)
        node = int(parents[node])
    return path
