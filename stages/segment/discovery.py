"""Objects that nobody pointed at: SAM 2.1's automatic masks, of which those stay that stand on the table."""

from __future__ import annotations

import logging

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.models.sam2.mask_generation import propose_masks
from stages.core.perception.support import Support, view_extent
from stages.core.scene.scene import Scene
from stages.segment.options import SegmentOptions
from stages.segment.propagation import MaskTracker, resize_logits
from stages.segment.voting import ViewFootprint

log = logging.getLogger(__name__)
LOOKS = 4  # pictures, evenly spread, that are searched for objects: what hides in one shows in another
PART = 0.8  # share of a mask within a larger one that makes it a part of that
KNOWN = 0.5  # share of a mask within objects that are followed already
HIGH = 0.4  # what hangs higher above the table than this is no thing on it [view radii]
LARGE = 1.2  # longest side of a thing [view radii]


def discover_objects(
    tracker: MaskTracker, support: Support | None, options: SegmentOptions
) -> dict[int, Int[Tensor, "h w"]]:
    """Label images of all views, by camera: 0 background, 1... the objects, at most `options.max_objects`.

    Each of a few pictures is searched in turn; what is new there is followed through all pictures. It is an object
    seen before where, in the other pictures, it mostly covers one.
    """
    found: dict[int, Tensor] = {}
    count = 0
    for row in torch.linspace(0, len(tracker.shown), LOOKS + 1)[:-1].long().unique().tolist():
        view = tracker.shown.views[row]
        masks = _objects_in(tracker, row, support, options)
        if view in found and len(masks):
            known = resize_logits((found[view] > 0)[None], masks.shape[2], masks.shape[1])[0] > 0.5
            masks = masks[(masks & known).sum((1, 2)) < KNOWN * masks.sum((1, 2))]
        masks = masks[: options.max_objects - count]
        log.info("%s: %d new objects", tracker.scene.cameras.names[view], len(masks))
        if len(masks):
            fresh = dict(tracker.labels(masks, row))
            number = match_labels(fresh, found, len(masks), count)
            count = max(count, int(number.max()))
            for v, labels in fresh.items():
                before = found.get(v, torch.zeros_like(labels))
                found[v] = torch.where(before > 0, before, number[labels])
    return found


def match_labels(
    fresh: dict[int, Int[Tensor, "h w"]], found: dict[int, Int[Tensor, "h w"]], new: int, count: int
) -> Int[Tensor, "m"]:
    """The number that each new label 0...`new` gets: that of the old object, of `count`, it mostly lies on, or a next.

    Compared are the pictures in which both show; a new label without an old one under it is new.
    """
    shared, area = torch.zeros(2, new + 1, count + 1)
    for view, labels in fresh.items():
        old = found.get(view)
        if old is None:
            continue
        table = torch.zeros(new + 1, count + 1).index_put_(
            (labels.flatten(), old.flatten()), torch.ones(labels.numel()), accumulate=True
        )
        present = (table.sum(0) > 0) & (table.sum(1, keepdim=True) > 0)
        shared += table
        area += torch.where(present, table.sum(1, keepdim=True), 0)
    share = shared / area.clamp_min(1)
    number = torch.zeros(new + 1, dtype=torch.int64)
    for label in range(1, new + 1):
        best = int(share[label, 1:].argmax()) + 1 if count else 0
        number[label] = best if best and share[label, best] > KNOWN else int(max(count, number.max())) + 1
    return number


def _objects_in(
    tracker: MaskTracker, row: int, support: Support | None, options: SegmentOptions
) -> Bool[Tensor, "m l l"]:
    """Masks of the things in a picture, largest first."""
    masks = propose_masks(tracker.model, tracker.pixels(row)).masks
    sight = ViewFootprint.of(tracker.scene, tracker.shown.views[row])
    height, width = sight.front.shape
    shown = [sight.front[resize_logits(mask[None], width, height)[0] > 0.5] for mask in masks]
    stands = [is_on_support(tracker.scene, front, support, options) for front in shown]
    return remove_nested_masks(masks[torch.tensor(stands, dtype=torch.bool)])


def is_on_support(scene: Scene, front: Int[Tensor, "p"], support: Support | None, options: SegmentOptions) -> bool:
    """Whether what the pixels of a mask show is a thing on the table; `front` names the Gaussian in each.

    It is, if it is neither small nor large, higher than the table on the whole, over the table, and reaches down.
    """
    front = front[front >= 0]
    points = scene.gaussians.means[front[:: max(1, len(front) // 5000)].long()]
    if len(points) < 20:
        return False
    view = support.view if support is not None else view_extent(scene)
    low, high = points.quantile(torch.tensor([0.02, 0.98]), dim=0)
    side = float((high - low).max()) / view.radius
    if not options.min_size <= side < LARGE:
        return False
    if support is None:
        return float((points - view.focus).norm(dim=1).median()) < 0.8 * view.radius
    heights = support.heights(points)
    over = float(support.inside(points).float().mean()) > 0.5
    return over and float(heights.median()) > 0.5 * support.tolerance and (
        float(heights.quantile(0.02)) < HIGH * view.radius
    )  # fmt: skip


def remove_nested_masks(masks: Bool[Tensor, "m h w"]) -> Bool[Tensor, "k h w"]:
    """Masks without those that are parts of a larger one, largest first."""
    areas = masks.flatten(1).sum(1)
    kept: list[int] = []
    for i in areas.argsort(descending=True, stable=True).tolist():
        within: Float[Tensor, "k"] = (masks[kept] & masks[i]).flatten(1).sum(1) / areas[i]
        if not bool((within > PART).any()):
            kept.append(i)
    return masks[kept]
