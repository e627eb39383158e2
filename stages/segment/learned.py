"""The learned backend: objects by a network over the voxels of the scene, trained on simulated clutter."""

from __future__ import annotations

from dataclasses import replace

from stages.core.models.segmenter.segment import SegmenterOptions, find, load_segmenter, object_ids
from stages.core.perception.grouping import name_objects
from stages.core.perception.support import find_support, view_extent
from stages.core.scene.scene import Scene
from stages.segment.options import SegmentOptions


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """Objects of the scene, largest first."""
    settings = SegmenterOptions(options.max_objects, options.min_size)
    support = find_support(scene, view_extent(scene), options.seed)
    ids = object_ids(scene, load_segmenter(find(options.weights)), support, settings)
    return name_objects(replace(scene, gaussians=replace(scene.gaussians, object_id=ids)), support)
