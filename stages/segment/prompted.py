"""Segmentation by a promptable network: masks from boxes, points or proposals, propagated through all photos."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import torch

from stages.core.backends import load, pick_device
from stages.core.errors import InputError
from stages.core.models.promptable import PointPrompts, PromptableSegmenter
from stages.core.perception.grouping import name_objects
from stages.core.perception.support import find_support
from stages.core.perception.voting import apply_votes, collect_votes
from stages.core.scene.scene import Scene
from stages.segment.discovery import discover_objects
from stages.segment.options import BACKENDS, SegmentOptions
from stages.segment.prompts import ObjectPrompts, read_prompts
from stages.segment.propagation import MaskTracker
from stages.segment.view_images import view_images

log = logging.getLogger(__name__)


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """Label the objects marked by prompts in the first view or, without prompts, the objects on the table.

    The backend's row in BACKENDS names the function (weights, download, device) that loads its network; it is called
    after the inputs have been checked. The network runs on the photos or, without --photos, on renderings of the scene
    from its cameras. Raises InputError for a scene without cameras, and if the photo of the prompts is missing.
    """
    name = options.backend
    if scene.cameras is None or not len(scene.cameras):
        raise InputError(f"--backend {name}: the scene has no cameras; give a scene written by `ngff reconstruct`")
    images = view_images(scene, options.photos, options.undistorted)
    boxes = options.boxes
    prompts = read_prompts(boxes, scene.cameras, options.undistorted) if boxes is not None else None
    if prompts is not None and images.views[0] != 0:
        raise InputError(
            f"{options.photos}: does not contain {scene.cameras.names[0]}, the photo to which --boxes refers; add it"
        )
    load_network: Callable[[Path | None, bool, str], PromptableSegmenter] = load(BACKENDS[name].network)
    network = load_network(options.weights, options.download, pick_device(options.device))
    log.info(
        "%s: %d %s",
        name,
        len(images),
        "photos" if options.photos else "rendered views of the scene, without --photos",
    )
    tracker = MaskTracker(network, scene, images)
    if prompts is not None:
        votes = collect_votes(scene, tracker.labels(point_prompts(prompts, scene)))
        return apply_votes(scene, votes, dict(enumerate(prompts.names, start=1)), name, options.seed)
    support = find_support(scene, seed=options.seed)
    found = discover_objects(tracker, support, options)
    if not any(bool(labels.any()) for labels in found.values()):
        return scene
    return name_objects(apply_votes(scene, collect_votes(scene, found.items()), {}, name, options.seed), support)


def point_prompts(prompts: ObjectPrompts, scene: Scene) -> list[PointPrompts]:
    """Convert prompts to fractions of the first view: a box for each object, or a point if there are no boxes."""
    size = scene.cameras.sizes[0].float()
    if prompts.boxes is not None:
        return [PointPrompts.box(box / torch.cat([size, size])) for box in prompts.boxes]
    return [PointPrompts.inside(point / size) for point in prompts.points]
