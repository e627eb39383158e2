"""Object discovery without prompts: a network's mask proposals, filtered to objects on the supporting plane."""

from __future__ import annotations

import logging

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.perception.support import Support, view_extent
from stages.core.perception.voting import ViewFootprint
from stages.core.scene.scene import Scene
from stages.segment.options import SegmentOptions
from stages.segment.propagation import MaskTracker, resize_logits

log = logging.getLogger(__name__)
SEARCHED_VIEWS = 4  # evenly spaced images that are searched; an object occluded in one is visible in another
MIN_NESTED_FRACTION = 0.8  # fraction of a mask inside a larger one above which it is part of the larger one
MIN_KNOWN_FRACTION = 0.5  # fraction of a mask inside tracked objects above which it is one of these objects
MAX_HEIGHT = 0.4  # largest height of an object's lowest points above the table [camera distance]
MAX_SIZE = 1.2  # largest longest side of an object [camera distance]
MIN_POINTS = 20  # fewest visible Gaussians of an object
MAX_MASK_PIXELS = 5000  # about the most pixels of a mask that are tested


def discover_objects(
    tracker: MaskTracker, support: Support | None, options: SegmentOptions
) -> dict[int, Int[Tensor, "h w"]]:
    """Label images by camera index: 0 is the background, 1... are the objects, at most `options.max_objects`.

    A few images are searched one after the other, and new masks are propagated through all images. A new label is
    merged with an earlier object if it mostly covers that object in the other images.
    """
    found: dict[int, Tensor] = {}
    count = 0
    for row in torch.linspace(0, len(tracker.images), SEARCHED_VIEWS + 1)[:-1].long().unique().tolist():
        view = tracker.images.views[row]
        masks = _object_masks(tracker, row, support, options)
        if view in found and len(masks):
            known = resize_logits((found[view] > 0)[None], masks.shape[2], masks.shape[1])[0] > 0.5
            masks = masks[(masks & known).sum((1, 2)) < MIN_KNOWN_FRACTION * masks.sum((1, 2))]
        masks = masks[: options.max_objects - count]
        log.info("%s: %d new objects found", tracker.scene.cameras.names[view], len(masks))
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
    """Object number of each new label 0...`new`: the known object, of `count`, that it mostly covers, or a new number.

    Labels and objects are compared only in images in which both are visible.
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
    fraction = shared / area.clamp_min(1)
    number = torch.zeros(new + 1, dtype=torch.int64)
    for label in range(1, new + 1):
        best = int(fraction[label, 1:].argmax()) + 1 if count else 0
        known = best and fraction[label, best] > MIN_KNOWN_FRACTION
        number[label] = best if known else int(max(count, number.max())) + 1
    return number


def _object_masks(
    tracker: MaskTracker, row: int, support: Support | None, options: SegmentOptions
) -> Bool[Tensor, "m l l"]:
    """Masks of the objects in an image, largest first."""
    masks = tracker.proposals(row)
    front = ViewFootprint.of(tracker.scene, tracker.images.views[row]).front
    height, width = front.shape
    inside = (resize_logits(mask[None], width, height)[0] > 0.5 for mask in masks)
    kept = [is_on_support(tracker.scene, front[pixels], support, options) for pixels in inside]
    return remove_nested_masks(masks[torch.tensor(kept, dtype=torch.bool)])


def is_on_support(scene: Scene, front: Int[Tensor, "p"], support: Support | None, options: SegmentOptions) -> bool:
    """Whether a mask shows an object on the table; `front` has the front-most Gaussian of each pixel, or -1.

    An object has a plausible size, is mostly over the table and higher than its surface, and its lowest points are
    near the table.
    """
    front = front[front >= 0]
    points = scene.gaussians.means[front[:: max(1, len(front) // MAX_MASK_PIXELS)].long()]
    if len(points) < MIN_POINTS:
        return False
    view = support.view if support is not None else view_extent(scene)
    low, high = points.quantile(torch.tensor([0.02, 0.98]), dim=0)
    side = float((high - low).max()) / view.radius
    if not options.min_size <= side < MAX_SIZE:
        return False
    if support is None:
        return float((points - view.focus).norm(dim=1).median()) < 0.8 * view.radius
    heights = support.heights(points)
    over = float(support.inside(points).float().mean()) > 0.5
    return over and float(heights.median()) > 0.5 * support.tolerance and (
        float(heights.quantile(0.02)) < MAX_HEIGHT * view.radius
    )  # fmt: skip


def remove_nested_masks(masks: Bool[Tensor, "m h w"]) -> Bool[Tensor, "k h w"]:
    """Remove masks that are part of a larger one; the result is sorted, largest first."""
    areas = masks.flatten(1).sum(1)
    kept: list[int] = []
    for i in areas.argsort(descending=True, stable=True).tolist():
        within: Float[Tensor, "k"] = (masks[kept] & masks[i]).flatten(1).sum(1) / areas[i]
        if not bool((within > MIN_NESTED_FRACTION).any()):
            kept.append(i)
    return masks[kept]
