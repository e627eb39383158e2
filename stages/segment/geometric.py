"""The geometric backend: objects by position, colour and shape, without labels or networks."""

from __future__ import annotations

from stages.core.perception.object_limits import GroupingOptions
from stages.core.perception.segmentation import segment_by_geometry
from stages.core.scene.scene import Scene
from stages.segment.options import SegmentOptions


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """Label the objects on the supporting plane."""
    settings = GroupingOptions(options.max_objects, options.min_size, options.detail, options.seed)
    return segment_by_geometry(scene, settings)
