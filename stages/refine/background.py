"""Background filling: adds the table under and behind objects, so that a lifted object leaves no hole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from stages.core.geometry.cameras import centres
from stages.core.geometry.cells import distinct_cells
from stages.core.geometry.harmonics import evaluate_sh, rgb_to_sh
from stages.core.geometry.neighbours import knn
from stages.core.perception.observed_space import ObservedSpace
from stages.core.perception.support import Support
from stages.core.raster.rasterise import rasterise
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene
from stages.refine.disc_gaussians import DISC_SIGMA, disc_gaussians
from stages.refine.inpaint import inpaint

# Lengths in camera distances (see `ViewExtent`) were tuned on photos of tabletops taken from all around.
MAX_VIEW_CELLS = 1024  # most cells along the longer side of the top view
FOOTPRINT_CELLS = 40_000  # approximate number of cells under objects
VIEW_MARGIN = 0.2  # width of the table around all objects that the top view includes [camera distance]
FILL_MARGIN = 0.06  # width of the border around an object's footprint that is filled where hidden [camera distance]
SHADOW_WIDTH = 0.04  # width of the border around a hole in which contact shadows are removed [camera distance]
COMPARISON_SIGMA = 0.25  # standard deviation of the blur before colours in this border are compared [SHADOW_WIDTH]
MIN_RESIDUAL_RATIO = 3.0  # smallest ratio of a stained cell's colour difference to the usual inpainting error (RMS)
SKIRT_WIDTH = 0.02  # width of the border around an object in which the table may have its colours [camera distance]
MAX_STAINED_FRACTION = 0.25  # stained fraction of the cells next to a hole, above which all of them are replaced
SHARPENING = 0.7  # fraction of the blur between neighbouring discs that is compensated
MIN_VISIBLE_FRACTION = 0.25  # fraction of the cameras above which a cell of table counts as seen
GRAZING_DEPTH = 0.03  # depth range of a pixel of table at a grazing angle [camera distance]
MAX_GAP = 0.03  # largest width of free-space gaps that are reconstruction errors and are filled [camera distance]
MIN_COLOUR_DIFFERENCE = 6.0  # smallest colour difference of a stained cell from the table [CIELAB]
MIN_COVERED_ALPHA = 0.92  # alpha above which table is present
MIN_COLOUR_ALPHA = 0.6  # alpha above which the table's colour is known
DENT_CELL = 0.015  # side of the cells in which depths below the surface are measured [camera distance]
MAX_DENT = 0.1  # largest depth of a dent; objects that extend deeper hang over the edge [camera distance]
STRAY_POINTS = 3  # number of the deepest Gaussians of a dent cell that are ignored
MIN_TABLE_GAUSSIANS = 50  # fewest Gaussians of a table that is filled


@dataclass(frozen=True)
class TopView:
    """Orthographic image of the table from above; one pixel per cell, rows along -y."""

    corner: Float[Tensor, "2"]  # x of the edge of the first column, y of the edge of the first row
    cell: float  # side of a cell [scene units]
    top: float  # height of the surface in the middle [scene units]
    rgb: Float[np.ndarray, "h w 3"]
    alpha: Float[np.ndarray, "h w"]
    dent: Float[np.ndarray, "h w"]  # depth below the surface at which objects lie, as on a cushion [scene units]

    def rows_columns(self, points: Float[Tensor, "n d"]) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each point, clamped to the image."""
        row = ((self.corner[1] - points[:, 1]) / self.cell).floor().clamp(0, self.alpha.shape[0] - 1)
        column = ((points[:, 0] - self.corner[0]) / self.cell).floor().clamp(0, self.alpha.shape[1] - 1)
        return row.long().numpy(), column.long().numpy()

    def centres(self, mask: np.ndarray) -> Float[Tensor, "m 2"]:
        """x and y of the centres of the cells in a mask."""
        row, column = (torch.from_numpy(i) for i in np.nonzero(mask))
        return torch.stack([self.corner[0] + (column + 0.5) * self.cell, self.corner[1] - (row + 0.5) * self.cell], 1)

    def on(self, support: Support, mask: np.ndarray) -> Float[Tensor, "m 3"]:
        """Centres of the cells in a mask, at the height of the surface or of a dent."""
        points = self.centres(mask)
        height = support.surface(points) - torch.from_numpy(self.dent[mask])
        return torch.cat([points, height[:, None]], 1)


def fill_background(scene: Scene, observed: ObservedSpace, support: Support, seed: int = 0) -> Scene:
    """Add discs on the supporting surface where objects hide it: under objects, with a margin.

    The table without objects is rendered from above, and its holes under and next to objects are inpainted. Cells of
    table that few cameras see, or that are close to an object, may be shadows or unlabelled parts of the object: they
    are replaced if they differ from the inpainted colours. Observed free space, and cells beyond the edge of the table,
    are not filled.
    """
    g, R = scene.gaussians, support.view.radius
    flat = (support.heights(g.means).abs() < 2 * support.tolerance) & (g.scales.amax(1) < 0.1 * R)
    flat &= (g.object_id == 0) & (g.opacities > 0.05) & support.inside(g.means, 0.05 * R)
    objects = g.means[(g.object_id > 0) & g.means.isfinite().all(1)]
    objects = objects[support.inside(objects, 0.05 * R)]
    if int(flat.sum()) < MIN_TABLE_GAUSSIANS or not len(objects):
        return scene
    view = _top_view(_diffuse(g[flat], observed), objects, support)
    if view is None:
        return scene
    hole, near, known, pure = _missing(view, objects, support, observed, seed)
    if not known.any():  # no texture to copy
        return scene
    colour = inpaint(view.rgb, hole, known, seed, pure=pure)
    removed = flat.clone()
    removed[flat] = torch.from_numpy(hole[view.rows_columns(g.means[flat])])
    remaining = _render_from_above(g[flat & ~removed], view.corner, view.cell, view.top, view.alpha.shape)
    new = hole | (near & (view.alpha >= MIN_COVERED_ALPHA) & (remaining.alpha < MIN_COVERED_ALPHA))
    new &= ~_where(new & (view.dent > 0), view, support, lambda points: observed.is_free(points, 2 * view.cell))
    return replace(scene, gaussians=concatenate([g[~removed], _discs(view, support, new, colour)]))


def _missing(
    view: TopView, objects: Float[Tensor, "m 3"], support: Support, observed: ObservedSpace, seed: int
) -> tuple[Bool[np.ndarray, "h w"], ...]:
    """Masks of the cells: hole, near, known and pure.

    hole: to be filled; near: under or close to objects; known: texture is copied from them; pure: so far from objects
    that the table has none of their colours.
    """
    R = support.view.radius
    under = _footprint(objects, support, view)
    near = ndimage.distance_transform_edt(~under) <= FILL_MARGIN * R / view.cell
    near[near] = support.inside(view.centres(near)).numpy()
    seen = view.alpha >= MIN_COLOUR_ALPHA

    def rarely_seen(points: Tensor) -> Tensor:
        return observed.visible_fraction(points, GRAZING_DEPTH * R) < MIN_VISIBLE_FRACTION

    hidden = _where(near | seen, view, support, rarely_seen)
    covered, hidden_under = view.alpha >= MIN_COVERED_ALPHA, under & hidden
    hole = near & ~covered & (under | hidden)
    width = 2 * support.tolerance + view.cell
    empty = _where(hole | seen, view, support, lambda points: observed.is_free(points, width))
    known, pure = seen & ~hole & ~empty, ndimage.distance_transform_edt(~under) > SKIRT_WIDTH * R / view.cell
    known &= ~hidden if bool((known & ~hidden).any()) else ~hidden_under  # without cameras, all cells are hidden
    hole &= ~ndimage.binary_opening(empty & hole, iterations=max(1, round(MAX_GAP * R / view.cell / 2)))
    if known.any():
        hole |= _stained(view, _Cells(hole, seen & near, known, hidden_under, pure), SHADOW_WIDTH * R / view.cell, seed)
    return hole, near, known, pure


class _Cells(NamedTuple):
    """Masks of cells of the top view."""

    hole: Bool[np.ndarray, "h w"]  # cells to be filled
    seen_near: Bool[np.ndarray, "h w"]  # cells of known colour under or close to objects
    known: Bool[np.ndarray, "h w"]  # cells from which texture is copied
    hidden_under: Bool[np.ndarray, "h w"]  # cells under objects that few cameras see
    pure: Bool[np.ndarray, "h w"]  # cells away from objects


def _discs(view: TopView, support: Support, cells: np.ndarray, colour: np.ndarray) -> Gaussians:
    """Discs in the cells of a mask, with colours sharpened to compensate the blur between neighbouring discs."""
    points = view.on(support, cells)
    up = torch.tensor([[0.0, 0, 1]]).expand(len(points), 3)
    sharp = colour + SHARPENING * (colour - _blurred(colour, cells | (view.alpha >= MIN_COLOUR_ALPHA), DISC_SIGMA))
    return disc_gaussians(points, up, torch.from_numpy(sharp[cells]), view.cell, 0)


def _where(
    cells: Bool[np.ndarray, "h w"], view: TopView, support: Support, test: Callable[[Tensor], Tensor]
) -> Bool[np.ndarray, "h w"]:
    """Mask of the cells in `cells` whose points on the surface pass a test."""
    out = np.zeros(cells.shape, bool)
    out[cells] = test(view.on(support, cells)).numpy()
    return out


def _stained(view: TopView, cells: _Cells, width: float, seed: int) -> Bool[np.ndarray, "h w"]:
    """Mask of stained cells: those hidden under objects or next to a hole, with a colour unlike the inpainted table.

    The tolerance depends on the inpainting error of known cells around them, which is large on textured tables. `width`
    is that of the border next to a hole [cells].
    """
    hole, known, hidden_under = cells.hole, cells.known, cells.hidden_under
    suspect = cells.seen_near & ~hole & (hidden_under | _adjacent(hole | hidden_under, width))
    reference = known & ~suspect & (ndimage.distance_transform_edt(~(hole | suspect)) <= width)
    table = inpaint(view.rgb, hole | suspect | reference, known, seed, rounds=0, pure=cells.pure)
    images = (_blurred(rgb, suspect | reference, COMPARISON_SIGMA * width) for rgb in (view.rgb, table))
    seen, expected = (cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB) for rgb in images)
    difference = np.linalg.norm(seen - expected, axis=2)
    usual = _blurred(difference[..., None] ** 2, reference, 2 * width)[..., 0] ** 0.5
    stained = suspect & (difference > np.maximum(MIN_COLOUR_DIFFERENCE, MIN_RESIDUAL_RATIO * usual))
    pieces, count = ndimage.label(hole | suspect)
    stains, suspects = (ndimage.sum(mask, pieces, range(count + 1)) for mask in (stained, suspect))
    fraction = stains / np.maximum(suspects, 1)
    return stained | (suspect & (fraction > MAX_STAINED_FRACTION)[pieces])


def _blurred(values: np.ndarray, where: Bool[np.ndarray, "h w"], sigma: float) -> np.ndarray:
    """Gaussian blur of the values in a mask, normalised by the blurred mask; `sigma` in cells."""
    weight = where.astype(np.float32)
    mean = cv2.GaussianBlur(values * weight[..., None], (0, 0), sigma).reshape(values.shape)
    return mean / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-6)[..., None]


def _adjacent(hole: Bool[np.ndarray, "h w"], distance: float) -> Bool[np.ndarray, "h w"]:
    """Cells within `distance` of a hole; next to narrower holes, which may be texture, only cells within 2 cells."""
    far = ndimage.distance_transform_edt(hole) < distance / 2
    if far.all():
        return ndimage.binary_dilation(hole, iterations=2)
    return (ndimage.distance_transform_edt(far) <= 1.5 * distance) | ndimage.binary_dilation(hole, iterations=2)


def _diffuse(table: Gaussians, observed: ObservedSpace) -> Gaussians:
    """The table with view-independent colours: the mean over the cameras, since no camera looks straight down."""
    if not observed.views:
        return table
    eyes = centres(torch.stack([viewmat for viewmat, *_ in observed.views]))
    rgb = sum(evaluate_sh(table.sh, torch.nn.functional.normalize(table.means - eye, dim=1)) for eye in eyes)
    return replace(table, sh=rgb_to_sh((rgb / len(eyes)).clamp(0, 1)))


def _top_view(table: Gaussians, objects: Float[Tensor, "m 3"], support: Support) -> TopView | None:
    """The top view of the table around all objects; None if they have no extent."""
    margin = VIEW_MARGIN * support.view.radius
    low, high = objects[:, :2].amin(0) - margin, objects[:, :2].amax(0) + margin
    longest = float((high - low).max())
    if not 1e-9 < longest < 1e9:
        return None
    spacing = float(knn(table.means, table.means[:: max(1, len(table) // 5000)], 4)[0][:, -1].median())
    side = DENT_CELL * support.view.radius
    area = len(distinct_cells((objects[:, :2] / side).floor().long())[1]) * side**2
    # half the spacing, since Gaussians are longer than wide
    cell = max(longest / MAX_VIEW_CELLS, spacing / 2, (area / FOOTPRINT_CELLS) ** 0.5)
    width, height = (((high - low) / cell).ceil().long().clamp_min(2)).tolist()
    top = float(support.surface((low + high)[None] / 2))
    flat = _render_from_above(table, torch.stack([low[0], high[1]]), cell, top, (height, width))
    return replace(flat, dent=_dent(objects, support, flat))


def _dent(objects: Float[Tensor, "m 3"], support: Support, view: TopView) -> Float[np.ndarray, "h w"]:
    """Depth of objects below the surface in each cell [scene units], about 0 elsewhere."""
    times = max(1, round(DENT_CELL * support.view.radius / view.cell))
    height, width = view.alpha.shape
    depths = np.zeros((-(-height // times), -(-width // times)), np.float32)
    depth = -support.heights(objects).numpy()
    below = (depth > 0) & (depth < MAX_DENT * support.view.radius)
    row, column = (index[below] // times for index in view.rows_columns(objects))
    square = row * depths.shape[1] + column
    order = np.lexsort((-depth[below], square))  # by cell, then deepest first
    squares, first, count = np.unique(square[order], return_index=True, return_counts=True)
    valid = count > STRAY_POINTS
    depths.flat[squares[valid]] = depth[below][order][first[valid] + STRAY_POINTS] + view.cell
    depths = cv2.dilate(depths, np.ones((3, 3)))  # covers the transitions between cells
    wide = cv2.resize(depths, (depths.shape[1] * times, depths.shape[0] * times), interpolation=cv2.INTER_LINEAR)
    return wide[:height, :width]


def _render_from_above(
    table: Gaussians, corner: Float[Tensor, "2"], cell: float, top: float, shape: tuple[int, int]
) -> TopView:
    """Render the top view with this corner, cell and shape (rows, columns), nearly orthographic from a large height."""
    height, width = shape
    height_above = 50 * max(shape) * cell
    viewmat = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    viewmat[:3, 3] = torch.tensor([-float(corner[0]), float(corner[1]), top + height_above])
    K = torch.tensor([[height_above / cell, 0, 0], [0, height_above / cell, 0], [0, 0, 1.0]])
    with torch.no_grad():
        rendered = rasterise(table, viewmat[None], K[None], width, height)
    alpha = rendered.alpha[0]
    rgb = (rendered.rgb[0] / alpha.clamp_min(1e-3)[..., None]).clamp(0, 1)
    flat = np.zeros(shape, np.float32)
    return TopView(corner, cell, top, rgb.numpy().astype(np.float32), alpha.numpy(), flat)


def _footprint(objects: Float[Tensor, "m 3"], support: Support, view: TopView) -> np.ndarray:
    """Mask of the cells directly under objects that stand on the table or are close above it; gaps are closed."""
    low = support.heights(objects) < 0.3 * support.view.radius
    under = np.zeros(view.alpha.shape, bool)
    under[view.rows_columns(objects[low])] = True
    return ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(under, 8), iterations=4)[8:-8, 8:-8])
