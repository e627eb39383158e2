"""The geometric backend: objects by position, colour and shape, without labels or networks."""

from __future__ import annotations

from dataclasses import replace

from stages.core.perception.grouping import GroupingOptions, group_objects, name_objects
from stages.core.perception.support import find_support, view_extent
from stages.core.perception.wall import find_wall
from stages.core.scene.scene import Scene
from stages.segment.body_merging import merge_bodies
from stages.segment.boundary_refinement import refine_boundaries
from stages.segment.false_positives import remove_false_positives
from stages.segment.options import SegmentOptions


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """Objects on the supporting plane: grouping, merging of bodies, boundary refinement, removal of false positives."""
    grouped = group_objects(
        scene,
        GroupingOptions(
            max_objects=options.max_objects, min_size=options.min_size, detail=options.detail, seed=options.seed
        ),
    )
    view = view_extent(scene)
    support = find_support(scene, view, options.seed)
    if not grouped.objects or support is None or find_wall(scene, view, options.seed) is not None:
        return grouped
    whole = replace(grouped, gaussians=merge_bodies(grouped.gaussians, support))
    whole = replace(whole, gaussians=refine_boundaries(whole, support))
    return name_objects(replace(whole, gaussians=remove_false_positives(whole, support)), support)
