"""Objects from boxes drawn in the first view: the geometric groups that fill them."""

from __future__ import annotations

import logging
from dataclasses import replace

import torch
from jaxtyping import Float

from stages.errors import InputError
from stages.geometry.cameras import depths, project
from stages.physics.grouping import Grouping, group
from stages.scene.scene import Scene, SceneObject
from stages.segment.options import SegmentOptions
from stages.segment.prompts import read_prompts

log = logging.getLogger(__name__)


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """For each box the group, or the few groups, that together fill it best; the rest is background."""
    prompts = read_prompts(options.boxes)
    if prompts.boxes is None:
        raise InputError(f"{options.boxes}: has points and no bbox; points are for --backend sam2")
    if scene.cameras is None or not len(scene.cameras):
        raise InputError("--boxes: the scene has no cameras; use one that `ngff reconstruct` wrote")
    fine = Grouping(max(options.max_objects, 4 * len(prompts.names)), 0.5 * options.min_size, options.detail)
    grouped = group(scene, fine)
    count = len(grouped.objects)
    if not count:
        raise InputError(f"{options.boxes}: nothing stands on the plane of the scene, so no box can be filled")
    spans = torch.stack([_span(grouped, number) for number in range(1, count + 1)])
    ids, objects, taken = torch.zeros_like(grouped.gaussians.object_id), [], set()
    for row, (box, name) in enumerate(zip(prompts.boxes, prompts.names, strict=True), start=1):
        chosen = _fill(box, spans, taken)
        if not chosen:
            log.warning("%s: no group of Gaussians lies in the box of %s", options.boxes, name)
            continue
        taken |= set(chosen)
        ids[torch.isin(grouped.gaussians.object_id, torch.tensor(chosen) + 1)] = row
        objects.append(SceneObject(row, name))
    return replace(grouped, gaussians=replace(grouped.gaussians, object_id=ids), objects=tuple(objects))


def _span(scene: Scene, number: int) -> Float[Tensor, "4"]:
    """Box around an object in view 0 [px], without its outermost hundredth; nan where it is behind the camera."""
    g, cameras = scene.gaussians, scene.cameras
    means = g.means[g.object_id == number]
    means = means[depths(means, cameras.viewmats[0]) > 0.01]
    if not len(means):
        return torch.full((4,), torch.nan)
    pixel = project(means, cameras.viewmats[0], cameras.Ks[0])[:: max(1, len(means) // 100_000)]
    return torch.cat([pixel.quantile(0.01, dim=0), pixel.quantile(0.99, dim=0)])


def _fill(box: Float[Tensor, "4"], spans: Float[Tensor, "o 4"], taken: set[int]) -> list[int]:
    """Groups whose joint span overlaps the box best, added one at a time while that grows."""
    chosen: list[int] = []
    best = 0.1  # less is not this object
    while True:
        scores = {}
        for i, span in enumerate(spans):
            if i not in taken and i not in chosen and not bool(span.isnan().any()) and _within(span, box) > 0.5:
                joint = torch.stack([span, *(spans[j] for j in chosen)])
                scores[i] = overlap(torch.cat([joint[:, :2].amin(0), joint[:, 2:].amax(0)]), box)
        if not scores or max(scores.values()) <= best + 0.02:
            return chosen
        winner = max(scores, key=scores.get)
        best = scores[winner]
        chosen.append(winner)


def _area(box: Float[Tensor, "4"]) -> float:
    return float((box[2:] - box[:2]).clamp_min(0).prod())


def _shared(a: Float[Tensor, "4"], b: Float[Tensor, "4"]) -> float:
    return _area(torch.cat([torch.maximum(a[:2], b[:2]), torch.minimum(a[2:], b[2:])]))


def _within(span: Float[Tensor, "4"], box: Float[Tensor, "4"]) -> float:
    """Share of the span that lies in the box."""
    return _shared(span, box) / max(_area(span), 1e-9)


def overlap(a: Float[Tensor, "4"], b: Float[Tensor, "4"]) -> float:
    """Intersection over union of two boxes x0 y0 x1 y1."""
    shared = _shared(a, b)
    return shared / max(_area(a) + _area(b) - shared, 1e-9)
