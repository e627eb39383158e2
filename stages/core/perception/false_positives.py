"""Remove false positives: texture of the table that was labelled as an object."""

from __future__ import annotations

from dataclasses import replace

import torch

from stages.core.geometry.neighbours import knn
from stages.core.perception.boundary_refinement import BOUNDARY_WIDTH, HEIGHT_RESOLUTION, MIN_VISIBLE_WEIGHT
from stages.core.perception.support import Support
from stages.core.perception.visibility import summed_view_directions
from stages.core.scene.gaussians import SURFACE_OPACITY, Gaussians
from stages.core.scene.scene import Scene

TABLE_NEIGHBOURS = 8  # Gaussians of the table that each Gaussian of an object is compared with
MAX_LEVEL_FRACTION = 0.65  # fraction of an object level with the table next to it, above which the object is texture


def remove_false_positives(scene: Scene, support: Support) -> Gaussians:
    """The scene's Gaussians, with objects that are level with the surrounding table relabelled as background.

    A real object is higher than the visible table next to it, or has an interior far from any visible table. Stripes
    and threads of a tablecloth, which grouping finds by their colour, have neither property.
    """
    g, level, margin = scene.gaussians, HEIGHT_RESOLUTION * support.view.radius, BOUNDARY_WIDTH * support.view.radius
    shown = (g.opacities > SURFACE_OPACITY) & g.means.isfinite().all(1)
    if scene.cameras is not None and len(scene.cameras):
        shown &= summed_view_directions(g, scene.cameras).norm(dim=1) > MIN_VISIBLE_WEIGHT
    heights = torch.where(shown, support.heights(torch.where(shown[:, None], g.means, 0.0)), torch.inf)
    bare = shown & (g.object_id == 0) & (heights.abs() < level)
    if int(bare.sum()) < TABLE_NEIGHBOURS:
        return g
    ids = g.object_id.clone()
    for label in ids.unique().tolist():
        own = shown & (ids == label)
        if label == 0 or not own.any():
            continue
        distance, index = knn(g.means[bare], g.means[own], TABLE_NEIGHBOURS)
        even = ((heights[own][:, None] - heights[bare][index]).abs() < level).float().mean(1) > 0.5
        if float((even & (distance[:, 0] < margin)).float().mean()) > MAX_LEVEL_FRACTION:
            ids[ids == label] = 0
    return replace(g, object_id=ids)
