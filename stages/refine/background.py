"""The table under and behind objects, so that one can be lifted and leaves no hole."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from stages.geometry.neighbours import knn
from stages.physics.support import Support
from stages.raster.rasterise import rasterise
from stages.refine.patches import none_like, patches
from stages.refine.sight import Sight
from stages.scene.gaussians import Gaussians
from stages.scene.scene import Scene

MOST = 512  # cells along the longer side of the picture of the table
COVERED = 0.75  # alpha above which the table is there


def fill(scene: Scene, sight: Sight, support: Support, seed: int = 0) -> Gaussians:
    """Flat Gaussians on the plane where objects hide it: under them, with a margin, and where they stood in the way.

    The table is drawn from above without the objects; holes in its picture are inpainted from their rims, with
    the grain of the table around. Places that a camera sees through, past the table's edge, stay open.
    """
    g = scene.gaussians
    h = support.heights(g.means)
    near = (h.abs() < 2 * support.tolerance) & (g.scales.amax(1) < 0.1 * support.view.radius) & (g.opacities > 0.05)
    table = g[(g.object_id == 0) & near & support.inside(g.means, 0.05 * support.view.radius)]
    things = g.means[(g.object_id > 0) & g.means.isfinite().all(1)]
    things = things[support.inside(things, 0.05 * support.view.radius)]
    if len(table) < 50 or not len(things):
        return none_like(g)
    picture = _picture(table, things, support)
    if picture is None:
        return none_like(g)
    low, cell, rgb, alpha, centres = picture
    wanted = _wanted(things, support, low, cell, alpha.shape) & support.inside(centres).numpy().reshape(alpha.shape)
    hole = wanted & (alpha < COVERED)
    points = torch.cat([centres, support.surface(centres)[:, None]], 1)
    through = np.zeros(alpha.shape, bool)
    where = torch.from_numpy(hole.reshape(-1))
    through.reshape(-1)[hole.reshape(-1)] = sight.empty(points[where], 2 * support.tolerance + cell).numpy()
    hole &= ~ndimage.binary_opening(through, iterations=1)
    if not hole.any():
        return none_like(g)
    colour = inpaint(rgb, hole, alpha >= COVERED, seed)
    take = torch.from_numpy(hole.reshape(-1))
    up = torch.tensor([[0.0, 0, 1]]).expand(int(take.sum()), 3)
    return patches(points[take], up, torch.from_numpy(colour.reshape(-1, 3))[take], cell, 0)


def _picture(table: Gaussians, things: Float[Tensor, "m 3"], support: Support):
    """The table from above around all things: corner, cell, rgb (h, w, 3), alpha (h, w), cell centres (h w, 2).

    The camera is so high that the view is all but parallel; a pixel is a cell, rows go along -y.
    """
    margin = 0.08 * support.view.radius
    low, high = things[:, :2].amin(0) - margin, things[:, :2].amax(0) + margin
    longest = float((high - low).max())
    if not 1e-9 < longest < 1e9:
        return None
    some = table.means[:: max(1, len(table) // 5000)]
    spacing = float(knn(table.means, some, 4)[0][:, -1].median())
    cell = max(longest / MOST, spacing)
    width, height = (((high - low) / cell).ceil().long().clamp_min(2)).tolist()
    away = 50 * longest
    top = float(support.surface((low + high)[None] / 2))
    viewmat = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, top + away], [0, 0, 0, 1]])
    viewmat[:2, 3] = -viewmat[:2, :2] @ torch.tensor([float(low[0]), float(high[1])])
    K = torch.tensor([[away / cell, 0, 0], [0, away / cell, 0], [0, 0, 1.0]])
    with torch.no_grad():
        drawn = rasterise(table, viewmat[None], K[None], width, height)
    alpha = drawn.alpha[0]
    rgb = (drawn.rgb[0] / alpha.clamp_min(1e-3)[..., None]).clamp(0, 1)
    x = low[0] + (torch.arange(width) + 0.5) * cell
    y = high[1] - (torch.arange(height) + 0.5) * cell
    centres = torch.stack([x.repeat(height), y.repeat_interleave(width)], 1)
    corner = torch.stack([low[0], high[1]])
    return corner, cell, rgb.numpy().astype(np.float32), alpha.numpy(), centres


def _wanted(things: Tensor, support: Support, corner: Tensor, cell: float, shape: tuple[int, int]) -> np.ndarray:
    """Cells that a thing covers or is so near to that it may have hidden them."""
    low = support.heights(things) < 0.3 * support.view.radius
    column = ((things[low, 0] - corner[0]) / cell).floor().long().clamp(0, shape[1] - 1)
    row = ((corner[1] - things[low, 1]) / cell).floor().long().clamp(0, shape[0] - 1)
    under = np.zeros(shape, bool)
    under[row.numpy(), column.numpy()] = True
    reach = 0.06 * support.view.radius / cell
    under = ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(under, 8), iterations=4)[8:-8, 8:-8])
    return ndimage.distance_transform_edt(~under) <= reach


def inpaint(rgb: np.ndarray, hole: np.ndarray, known: np.ndarray, seed: int) -> np.ndarray:
    """Colours in the holes: smooth from their rims (Telea 2004), plus fine grain copied from known places.

    Cells that are neither hole nor known are of no use as a source, so they are treated as holes too.
    """
    gap = ~known | hole
    if not (~gap).any():
        return rgb
    pixels = (rgb * 255).round().astype(np.uint8)
    smooth = cv2.inpaint(pixels, gap.astype(np.uint8), 4, cv2.INPAINT_TELEA).astype(np.float32) / 255
    weight = cv2.GaussianBlur((~gap).astype(np.float32), (0, 0), 3)
    blurred = cv2.GaussianBlur(rgb * (~gap)[..., None], (0, 0), 3) / np.maximum(weight, 1e-3)[..., None]
    grain = (rgb - blurred)[~gap]
    keep = np.abs(grain).max(1) <= np.quantile(np.abs(grain).max(1), 0.95)  # edges are no grain
    rng = np.random.default_rng(seed)
    soft = cv2.GaussianBlur(smooth, (0, 0), 1.5)  # Telea's streaks
    out = np.where(gap[..., None], soft, rgb)
    pick = rng.integers(0, int(keep.sum()), int(gap.sum()))
    out[gap] += 0.7 * grain[keep][pick]
    return out.clip(0, 1)
