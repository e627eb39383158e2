"""Outline of the table on which objects stand, from views that look past its edge at lower surfaces.

Where no camera looks past the edge, for example where the photos end, the table is taken to continue. The outline is
convex, an intersection of half-planes in DIRECTIONS directions, so a notch in a table counts as table. Objects that
stand at the height of the table are inside the outline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage

from stages.core.geometry.cameras import centres
from stages.core.perception.observed_space import FAR, ObservedSpace
from stages.core.perception.support import Support, find_support
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.scene import Scene

# Lengths are in camera distances. MIN_DROP to MIN_KNOWN were chosen on the scenes kitchen, kermit, the desk and banana,
# whose carpet has no edge. A view knows a cell if its pixel shows the cell or a surface behind it.
MIN_DROP = 0.05  # minimum distance along the ray from the table to a surface seen past it
MIN_VIEWS = 3  # minimum number of views that must know a cell
STRIP, GAP, NEAR = 0.1, 0.01, 0.03  # width of the strip beyond an edge, its distance from the edge, depth of the edge
MIN_SEEN_PAST = 0.8  # fraction of the known cells in the strip past which cameras must look
MIN_KNOWN = 0.25  # minimum fraction of known cells in the strip

MIN_SHARE = 0.5  # fraction of the views that know a cell above which cameras look past it
DIRECTIONS = 72  # candidate normals of the edges, at equal angles
LOWEST = 0.1  # quantile of the heights seen past the table that is the ground; lower heights are errors of few views


@dataclass(frozen=True)
class TableOutline:
    """The table as an intersection of half-planes in x and y, and the ground beyond it, in scene units."""

    normals: Float[np.ndarray, "k 2"]  # outward
    offsets: Float[np.ndarray, "k"]  # normals @ xy <= offsets on the table
    ground: float  # height of the lowest surface that cameras see past the table

    def beyond(self, xy: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
        """Signed distance of points beyond the edge; negative on the table."""
        return (xy[:, :2] @ self.normals.T - self.offsets).max(1)


@cached_in_scene
def table_outline(scene: Scene, device: str = "cpu") -> TableOutline | None:
    """The outline of the table at the scene's floor; None if no edge is known, for example without cameras.

    The depth maps are rendered on `device`.
    """
    if scene.floor is None or scene.cameras is None or len(scene.cameras) < MIN_VIEWS:
        return None
    support = find_support(scene)
    if support is None:
        return None
    past, known, heights = _seen_past(support, ObservedSpace.of(scene, device))
    table = ndimage.binary_opening(support.region.numpy() & ~past, iterations=2)
    parts, count = ndimage.label(table)
    if not count:
        return None
    largest = np.argwhere(parts == 1 + np.argmax(np.bincount(parts[table])[1:]))
    edges = _edges(largest, _bases(scene, support), past, known, support.view.radius / support.cell)
    if not edges or not len(heights):
        return None
    normals, offsets = (np.array(each) for each in zip(*edges, strict=True))
    origin = support.view.focus[:2].double().numpy() - support.cell * (len(past) - 1) / 2  # of the first cell
    return TableOutline(normals, offsets * support.cell + normals @ origin, float(np.quantile(heights, LOWEST)))


def _bases(scene: Scene, support: Support) -> np.ndarray:
    """Cells (m, 2) of the Gaussians at table height that belong to objects which do not reach far below the table."""
    cells = [torch.zeros(0, 2, dtype=torch.int64)]
    for o in scene.objects:
        means = scene.gaussians.means[scene.gaussians.object_id == o.id]
        heights = support.heights(means)
        if len(means) and float(heights.sort().values[len(means) // 20]) > -support.tolerance:
            cells.append(support.cells(means[heights.abs() < support.tolerance]))
    return torch.cat(cells).numpy()


def _seen_past(
    support: Support, observed: ObservedSpace
) -> tuple[Bool[np.ndarray, "g g"], Bool[np.ndarray, "g g"], Float[np.ndarray, "h"]]:
    """Find where cameras look past the table.

    Returns masks over the support's grid of the cells past which most views look, and of those that enough views know,
    and the heights of the surfaces seen past the former [scene units].
    """
    side, drop = len(support.region), MIN_DROP * support.view.radius
    along = (torch.arange(side) + 0.5 - side / 2) * support.cell
    xy = torch.stack(torch.meshgrid(along, along, indexing="ij"), -1).flatten(0, 1) + support.view.focus[:2]
    cells = torch.cat([xy, support.surface(xy)[:, None]], 1)
    past, known = (torch.zeros(len(cells), dtype=torch.int64) for _ in range(2))
    seen = []
    for (viewmat, *_), (inside, z, depth) in zip(observed.views, observed.surface_depths(cells), strict=True):
        sees = (depth > z - drop) & (depth < FAR)
        beyond = sees & (depth > z + drop)
        known[inside] += sees
        past[inside] += beyond
        eye, row = centres(viewmat[None])[0], inside.nonzero()[:, 0][beyond]
        seen.append((row, eye[2] + (cells[row, 2] - eye[2]) * (depth / z)[beyond]))
    enough = known >= MIN_VIEWS
    through = enough & (past > MIN_SHARE * known)
    heights = torch.cat([height[through[row]] for row, height in seen])
    return through.view(side, side).numpy(), enough.view(side, side).numpy(), heights.numpy()


def _edges(
    table: np.ndarray, bases: np.ndarray, past: np.ndarray, known: np.ndarray, unit: float
) -> list[tuple[Float[np.ndarray, "2"], float]]:
    """Outward normals and offsets [cells] of the known edges around the cells `table` (m, 2) and `bases` (n, 2).

    `past` and `known` are the masks of `_seen_past`; `unit` is the camera distance [cells].
    """
    edges = []
    for angle in np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False):
        normal = np.array([np.cos(angle), np.sin(angle)])
        along = np.array([-normal[1], normal[0]])
        height = table @ normal
        end = max(np.quantile(height, 0.995), (bases @ normal).max(initial=-np.inf))
        edge = table[height > min(end, height.max()) - NEAR * unit] @ along
        t, h = np.meshgrid(
            np.arange(edge.min(), edge.max() + 1), np.arange(end + GAP * unit, end + (GAP + STRIP) * unit)
        )
        strip = np.round(t[..., None] * along + h[..., None] * normal).astype(np.int64).reshape(-1, 2)
        strip = strip[((strip >= 0) & (strip < len(past))).all(1)]
        is_known, is_past = (mask[tuple(strip.T)] for mask in (known, past))
        if len(strip) and is_known.mean() > MIN_KNOWN and is_past.sum() > MIN_SEEN_PAST * is_known.sum():
            edges.append((normal, float(end)))
    return edges
