"""Objects by where things are and how they look: no labels, no networks."""

from __future__ import annotations

from dataclasses import replace

from stages.core.perception.grouping import Grouping, group, named
from stages.core.perception.support import find_support, view_of
from stages.core.perception.wall import find_wall
from stages.core.scene.scene import Scene
from stages.segment.bodies import joined
from stages.segment.options import SegmentOptions
from stages.segment.rims import redrawn
from stages.segment.scraps import without_scraps


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """What stands on the supporting plane: grouped by position, colour and shape; made whole; its rims redrawn.

    What then turns out to be a pattern of the table is given back to it.
    """
    grouped = group(scene, Grouping(options.max_objects, options.min_size, options.detail, options.seed))
    view = view_of(scene)
    support = find_support(scene, view, options.seed)
    if not grouped.objects or support is None or find_wall(scene, view, options.seed) is not None:
        return grouped
    whole = replace(grouped, gaussians=joined(grouped.gaussians, support))
    whole = replace(whole, gaussians=redrawn(whole, support))
    return named(replace(whole, gaussians=without_scraps(whole, support)), support)
