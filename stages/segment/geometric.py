"""Objects by where things are and how they look: no labels, no networks."""

from __future__ import annotations

from stages.physics.grouping import Grouping, group
from stages.scene.scene import Scene
from stages.segment.options import SegmentOptions


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """What stands on the supporting plane, grouped by position, colour and shape."""
    return group(scene, Grouping(options.max_objects, options.min_size, options.detail, options.seed))
