"""Objects by SAM 2.1: masks from boxes, points or nothing, carried through all photos, and the majority of them."""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.models.sam2.weights import download, find, load
from stages.core.perception.grouping import name_objects
from stages.core.perception.support import find_support
from stages.core.scene.scene import Scene
from stages.segment.options import SegmentOptions
from stages.segment.prompts import ObjectPrompts, read_prompts
from stages.segment.view_images import ViewImages, view_images
from stages.segment.voting import apply_votes, collect_votes

log = logging.getLogger(__name__)


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """The objects that the prompts show in the first view, or, without prompts, whatever stands on the table.

    The network sees the photos, or the scene drawn where there are none. Memory: its weights, about 1 GB at work, one
    photo, and 20 MB an object, however many photos there are.
    """
    if scene.cameras is None or not len(scene.cameras):
        raise InputError("--backend sam2: the scene has no cameras; use one that `ngff reconstruct` wrote")
    shown = view_images(scene, options.photos)
    prompts = read_prompts(options.boxes, scene.cameras.sizes[0].tolist()) if options.boxes is not None else None
    if prompts is not None and shown.views[0] != 0:
        raise InputError(f"{options.photos}: lacks {scene.cameras.names[0]}, the photo that --boxes is about")
    model = load(_weights(options), pick_device(options.device))
    log.info("SAM 2.1 looks at %d %s", len(shown), "photos" if options.photos else "drawings of the scene: no --photos")
    return segment_views(scene, model, shown, prompts, options)


def _weights(options: SegmentOptions) -> Path:
    """The file of weights, fetched first when the user asked for that and it is not there."""
    try:
        return find(options.weights)
    except InputError:
        if not options.download or options.weights is not None:
            raise
    return download()


def segment_views(
    scene: Scene, model, shown: ViewImages, prompts: ObjectPrompts | None, options: SegmentOptions
) -> Scene:
    """The scene with the objects that a loaded network finds in pictures of it."""
    from stages.segment.discovery import (
        discover_objects,  # imports transformers, whose absence `load` has explained by now
    )
    from stages.segment.propagation import MaskTracker

    tracker = MaskTracker(model, scene, shown)
    if prompts is not None:
        votes = collect_votes(scene, tracker.labels(point_prompts(prompts, scene)))
        return apply_votes(scene, votes, dict(enumerate(prompts.names, start=1)), "sam2", options.seed)
    support = find_support(scene, seed=options.seed)
    found = discover_objects(tracker, support, options)
    if not any(bool(labels.any()) for labels in found.values()):
        return scene
    return name_objects(apply_votes(scene, collect_votes(scene, found.items()), {}, "sam2", options.seed), support)


def point_prompts(prompts: ObjectPrompts, scene: Scene) -> list:
    """A box for each object, or a point where there are no boxes, as shares of the first view."""
    from stages.core.models.sam2.network import PointPrompts

    size = scene.cameras.sizes[0].float()
    if prompts.boxes is not None:
        return [PointPrompts.box(box / torch.cat([size, size])) for box in prompts.boxes]
    return [PointPrompts.inside(point / size) for point in prompts.points]
