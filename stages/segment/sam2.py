"""The sam2 backend: SAM 2.1, with its published weights."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from stages.core.errors import InputError
from stages.core.models.promptable import PromptableSegmenter
from stages.core.models.sam2.weights import download, find, load
from stages.core.scene.scene import Scene
from stages.segment.options import SegmentOptions
from stages.segment.prompted import segment_with


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """Objects by SAM 2.1; see `segment_with`.

    Memory: the weights, about 1 GB of activations, one photo, and 20 MB per object, for any number of photos.
    """
    return segment_with(_network, scene, options)


def _network(options: SegmentOptions, device: str) -> PromptableSegmenter:
    return _loaded(_weights(options), device)


@lru_cache(maxsize=1)
def _loaded(weights: Path, device: str) -> PromptableSegmenter:
    model = load(weights, device)  # explains the absence of transformers, which the next line imports
    from stages.core.models.sam2.segmenter import Sam2Segmenter

    return Sam2Segmenter(model)


def _weights(options: SegmentOptions) -> Path:
    """Path of the weights, downloaded first if that was requested and they are missing."""
    try:
        return find(options.weights)
    except InputError:
        if not options.download or options.weights is not None:
            raise
    return download()
