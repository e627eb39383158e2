"""Objects by SAM 2.1: masks from boxes, points or nothing, carried through all photos, and the majority of them."""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.models.sam2.weights import download, find, load
from stages.core.perception.grouping import named
from stages.core.perception.support import find_support
from stages.core.scene.scene import Scene
from stages.segment.options import SegmentOptions
from stages.segment.pictures import Pictures, pictures
from stages.segment.prompts import Prompts, read_prompts
from stages.segment.vote import decide, poll

log = logging.getLogger(__name__)


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """The objects that the prompts show in the first view, or, without prompts, whatever stands on the table.

    The network sees the photos, or the scene drawn where there are none. Memory: its weights, about 1 GB at work, one
    photo, and 20 MB an object, however many photos there are.
    """
    if scene.cameras is None or not len(scene.cameras):
        raise InputError("--backend sam2: the scene has no cameras; use one that `ngff reconstruct` wrote")
    shown = pictures(scene, options.photos)
    prompts = read_prompts(options.boxes, scene.cameras.sizes[0].tolist()) if options.boxes is not None else None
    if prompts is not None and shown.views[0] != 0:
        raise InputError(f"{options.photos}: lacks {scene.cameras.names[0]}, the photo that --boxes is about")
    model = load(_weights(options), pick_device(options.device))
    log.info("SAM 2.1 looks at %d %s", len(shown), "photos" if options.photos else "drawings of the scene: no --photos")
    return labelled(scene, model, shown, prompts, options)


def _weights(options: SegmentOptions) -> Path:
    """The file of weights, fetched first when the user asked for that and it is not there."""
    try:
        return find(options.weights)
    except InputError:
        if not options.download or options.weights is not None:
            raise
    return download()


def labelled(scene: Scene, model, shown: Pictures, prompts: Prompts | None, options: SegmentOptions) -> Scene:
    """The scene with the objects that a loaded network finds in pictures of it."""
    from stages.segment.discover import discover  # imports transformers, whose absence `load` has explained by now
    from stages.segment.propagate import Tracker

    tracker = Tracker(model, scene, shown)
    if prompts is not None:
        votes = poll(scene, tracker.labels(clicks_of(prompts, scene)))
        return decide(scene, votes, dict(enumerate(prompts.names, start=1)), "sam2", options.seed)
    support = find_support(scene, seed=options.seed)
    found = discover(tracker, support, options)
    if not any(bool(labels.any()) for labels in found.values()):
        return scene
    return named(decide(scene, poll(scene, found.items()), {}, "sam2", options.seed), support)


def clicks_of(prompts: Prompts, scene: Scene) -> list:
    """A box for each object, or a point where there are no boxes, as shares of the first view."""
    from stages.core.models.sam2.network import Clicks

    size = scene.cameras.sizes[0].float()
    if prompts.boxes is not None:
        return [Clicks.box(box / torch.cat([size, size])) for box in prompts.boxes]
    return [Clicks.inside(point / size) for point in prompts.points]
