"""The learned backend: objects by a network over the voxels of the scene, trained on simulated clutter."""

from __future__ import annotations

from stages.core.backends import pick_device
from stages.core.models.segmenter.segment import segment_by_network
from stages.core.perception.object_limits import ObjectLimits
from stages.core.scene.scene import Scene
from stages.segment.options import SegmentOptions


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """Label the objects of the scene, largest first; `ngff simulate` does the same for an unlabelled scene."""
    limits = ObjectLimits(options.max_objects, options.min_size)
    return segment_by_network(scene, limits, options.weights, options.seed, pick_device(options.device))
