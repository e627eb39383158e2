"""Geometric segmentation: group Gaussians into objects, then repair the result in three passes."""

from __future__ import annotations

from dataclasses import replace

from stages.core.perception.body_merging import merge_bodies
from stages.core.perception.boundary_refinement import refine_boundaries
from stages.core.perception.false_positives import remove_false_positives
from stages.core.perception.grouping import group_objects, name_objects
from stages.core.perception.object_limits import GroupingOptions
from stages.core.perception.support import find_support, view_extent
from stages.core.perception.wall import find_wall
from stages.core.scene.scene import Scene


def segment_by_geometry(scene: Scene, grouping: GroupingOptions = GroupingOptions()) -> Scene:  # noqa: B008 -- frozen
    """The scene with an object_id for every Gaussian (0 for the background) and its objects, largest first.

    Objects found on a supporting plane are repaired: parts of one body are merged, boundaries refined, and texture of
    the table removed.
    """
    grouped = group_objects(scene, grouping)
    view = view_extent(scene)
    support = find_support(scene, view, grouping.seed)
    if not grouped.objects or support is None or find_wall(scene, view, grouping.seed) is not None:
        return grouped
    whole = replace(grouped, gaussians=merge_bodies(grouped.gaussians, support))
    whole = replace(whole, gaussians=refine_boundaries(whole, support))
    return name_objects(replace(whole, gaussians=remove_false_positives(whole, support)), support)
