"""The table under and behind objects, so that one can be lifted and leaves no hole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from stages.core.geometry.cameras import centres
from stages.core.geometry.harmonics import evaluate_sh, rgb_to_sh
from stages.core.geometry.neighbours import knn
from stages.core.perception.support import Support
from stages.core.raster.rasterise import rasterise
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene
from stages.refine.disc_gaussians import DISC_SIGMA, disc_gaussians
from stages.refine.inpaint import inpaint
from stages.refine.observed_space import ObservedSpace

MOST = 1024  # cells along the longer side of the picture of the table
CELLS = 40_000  # under things, about
AROUND = 0.2  # of the table around all things that is in the picture, to see how its edges go on [view radii]
MARGIN = 0.06  # around what is under an object [view radii]
RIM = 0.04  # beside a hole, where a contact shadow is [view radii]
WIDE = 0.25  # standard deviation at which colours are compared there [of the rim]
SURE = 3.0  # times the root mean square of what is usual that they must differ: beyond the noise of a grainy table
DIRTY = 0.25  # share of dirt beside a hole from which nothing there is trusted
SHARPER = 0.7  # share of what a patch blurs that is added to its colour
FEW = 0.25  # share of the cameras that look at a place, below which the table there counts as not seen
GRAZING = 0.03  # depth that a pixel of table spans at a flat angle [view radii]
GAP = 0.03  # places that cameras see through are narrower where the reconstruction is at fault [view radii]
OTHER = 6.0  # CIELAB distance from which a colour is not the table's
COVERED = 0.92  # alpha above which the table is there
SEEN = 0.6  # alpha above which its colour is known
DENT = 0.015  # side of the squares in which it is asked how deep things lie [view radii]
DEEPEST = 0.1  # below the surface that something lies on it; deeper it hangs over the edge [view radii]
STRAYS = 3  # Gaussians below the surface in a square that say nothing


@dataclass(frozen=True)
class TopView:
    """The table from above; a pixel is a cell, rows go along -y."""

    corner: Float[Tensor, "2"]  # x of the first column's edge, y of the first row's
    cell: float
    top: float  # height of the surface in the middle
    rgb: Float[np.ndarray, "h w 3"]
    alpha: Float[np.ndarray, "h w"]
    dent: Float[np.ndarray, "h w"]  # how far below the surface things lie in a cell, as they do on a seat

    def rows_columns(self, points: Float[Tensor, "n d"]) -> tuple[np.ndarray, np.ndarray]:
        """Cell of each point, clamped to the picture."""
        row = ((self.corner[1] - points[:, 1]) / self.cell).floor().clamp(0, self.alpha.shape[0] - 1)
        column = ((points[:, 0] - self.corner[0]) / self.cell).floor().clamp(0, self.alpha.shape[1] - 1)
        return row.long().numpy(), column.long().numpy()

    def centres(self, mask: np.ndarray) -> Float[Tensor, "m 2"]:
        row, column = (torch.from_numpy(i) for i in np.nonzero(mask))
        return torch.stack([self.corner[0] + (column + 0.5) * self.cell, self.corner[1] - (row + 0.5) * self.cell], 1)

    def on(self, support: Support, mask: np.ndarray) -> Float[Tensor, "m 3"]:
        """Centres of cells, on the surface, or below it where things lie deeper."""
        points = self.centres(mask)
        height = support.surface(points) - torch.from_numpy(self.dent[mask])
        return torch.cat([points, height[:, None]], 1)


def fill_background(scene: Scene, sight: ObservedSpace, support: Support, seed: int = 0) -> Scene:
    """The scene with flat Gaussians on the plane where objects hide it: under them, with a margin.

    The table is drawn from above without the objects, and its holes are inpainted from what is around: those under
    an object, and those beside it that are hidden. Under an object few cameras see the table, and close to it what
    they see may be its shadow, or a part of it that was missed: where that is not what is inpainted, it goes. Places
    that a camera sees through, or where it sees no table, past the edge, stay open.
    """
    g, R = scene.gaussians, support.view.radius
    flat = (support.heights(g.means).abs() < 2 * support.tolerance) & (g.scales.amax(1) < 0.1 * R)
    flat &= (g.object_id == 0) & (g.opacities > 0.05) & support.inside(g.means, 0.05 * R)
    things = g.means[(g.object_id > 0) & g.means.isfinite().all(1)]
    things = things[support.inside(things, 0.05 * R)]
    picture = _picture(_matt(g[flat], sight), things, support) if int(flat.sum()) >= 50 and len(things) else None
    if picture is None:
        return scene
    hole, near, known = _missing(picture, things, support, sight, seed)
    if not known.any():  # nothing to go on with
        return scene
    colour = inpaint(picture.rgb, hole, known, seed)
    gone = flat.clone()
    gone[flat] = torch.from_numpy(hole[picture.rows_columns(g.means[flat])])
    left = _drawn(g[flat & ~gone], picture.corner, picture.cell, picture.top, picture.alpha.shape)
    new = hole | (near & (picture.alpha >= COVERED) & (left.alpha < COVERED))
    new &= ~_each(new & (picture.dent > 0), picture, support, lambda points: sight.empty(points, 2 * picture.cell))
    return replace(scene, gaussians=concatenate([g[~gone], _laid(picture, support, new, colour)]))


def _missing(
    picture: TopView, things: Float[Tensor, "m 3"], support: Support, sight: ObservedSpace, seed: int
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Cells to fill, those under and close to things, and those that tell how the table goes on."""
    R = support.view.radius
    under = _under(things, support, picture)
    near = ndimage.distance_transform_edt(~under) <= MARGIN * R / picture.cell
    near[near] = support.inside(picture.centres(near)).numpy()
    seen = picture.alpha >= SEEN
    hidden = _each(near | seen, picture, support, lambda points: sight.share(points, GRAZING * R) < FEW)
    covered, blind = picture.alpha >= COVERED, under & hidden
    hole = near & ~covered & (under | hidden)
    width = 2 * support.tolerance + picture.cell
    empty = _each(hole | seen, picture, support, lambda points: sight.empty(points, width))
    known = seen & ~hole & ~empty
    known &= ~hidden if bool((known & ~hidden).any()) else ~blind  # without cameras all of it is hidden
    hole &= ~ndimage.binary_opening(empty & hole, iterations=max(1, round(GAP * R / picture.cell / 2)))
    if known.any():
        hole |= _dirt(picture, hole, seen & near, known, blind, RIM * R / picture.cell, seed)
    return hole, near, known


def _laid(picture: TopView, support: Support, cells: np.ndarray, colour: np.ndarray) -> Gaussians:
    """Patches in some of the cells, of colours that undo how they blur each other."""
    points = picture.on(support, cells)
    up = torch.tensor([[0.0, 0, 1]]).expand(len(points), 3)
    sharp = colour + SHARPER * (colour - _blurred(colour, cells | (picture.alpha >= SEEN), DISC_SIGMA))
    return disc_gaussians(points, up, torch.from_numpy(sharp[cells]), picture.cell, 0)


def _each(
    cells: Bool[np.ndarray, "h w"], picture: TopView, support: Support, test: Callable[[Tensor], Tensor]
) -> Bool[np.ndarray, "h w"]:
    """Those of the cells whose place on the surface passes a test."""
    out = np.zeros(cells.shape, bool)
    out[cells] = test(picture.on(support, cells)).numpy()
    return out


def _dirt(
    picture: TopView, hole: np.ndarray, here: np.ndarray, known: np.ndarray, blind: np.ndarray, rim: float, seed: int
) -> Bool[np.ndarray, "h w"]:
    """Blind cells, and those beside a hole, where colours are not what the table farther off goes on with.

    How well that can be foretold is seen farther off: where the table is patched, colours that differ are its own.
    """
    doubt = here & ~hole & (blind | _beside(hole | blind, rim))
    proof = known & ~doubt & (ndimage.distance_transform_edt(~(hole | doubt)) <= rim)
    table = inpaint(picture.rgb, hole | doubt | proof, known, seed, rounds=0)
    lab = [cv2.cvtColor(_blurred(rgb, doubt | proof, WIDE * rim), cv2.COLOR_RGB2LAB) for rgb in (picture.rgb, table)]
    differ = np.linalg.norm(lab[0] - lab[1], axis=2)
    usual = _blurred(differ[..., None] ** 2, proof, 2 * rim)[..., 0] ** 0.5
    dirt = doubt & (differ > np.maximum(OTHER, SURE * usual))
    pieces, count = ndimage.label(hole | doubt)
    share = ndimage.sum(dirt, pieces, range(count + 1)) / np.maximum(ndimage.sum(doubt, pieces, range(count + 1)), 1)
    return dirt | (doubt & (share > DIRTY)[pieces])


def _blurred(values: np.ndarray, where: Bool[np.ndarray, "h w"], sigma: float) -> np.ndarray:
    """Means around each cell of the values where they count."""
    weight = where.astype(np.float32)
    mean = cv2.GaussianBlur(values * weight[..., None], (0, 0), sigma).reshape(values.shape)
    return mean / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-6)[..., None]


def _beside(hole: Bool[np.ndarray, "h w"], reach: float) -> Bool[np.ndarray, "h w"]:
    """Cells within reach of a hole; of one narrower than that, a part of the table's own pattern, only those close."""
    far = ndimage.distance_transform_edt(hole) < reach / 2
    if far.all():
        return ndimage.binary_dilation(hole, iterations=2)
    return (ndimage.distance_transform_edt(far) <= 1.5 * reach) | ndimage.binary_dilation(hole, iterations=2)


def _matt(table: Gaussians, sight: ObservedSpace) -> Gaussians:
    """In the mean of the colours that the cameras see; those straight from above, where none is, would be a guess."""
    if not sight.views:
        return table
    eyes = centres(torch.stack([viewmat for viewmat, *_ in sight.views]))
    rgb = sum(evaluate_sh(table.sh, torch.nn.functional.normalize(table.means - eye, dim=1)) for eye in eyes)
    return replace(table, sh=rgb_to_sh((rgb / len(eyes)).clamp(0, 1)))


def _picture(table: Gaussians, things: Float[Tensor, "m 3"], support: Support) -> TopView | None:
    """The table from above around all things."""
    margin = AROUND * support.view.radius
    low, high = things[:, :2].amin(0) - margin, things[:, :2].amax(0) + margin
    longest = float((high - low).max())
    if not 1e-9 < longest < 1e9:
        return None
    spacing = float(knn(table.means, table.means[:: max(1, len(table) // 5000)], 4)[0][:, -1].median())
    side = DENT * support.view.radius
    area = len((things[:, :2] / side).floor().unique(dim=0)) * side**2
    cell = max(longest / MOST, spacing / 2, (area / CELLS) ** 0.5)  # twice as fine: Gaussians are longer than wide
    width, height = (((high - low) / cell).ceil().long().clamp_min(2)).tolist()
    top = float(support.surface((low + high)[None] / 2))
    flat = _drawn(table, torch.stack([low[0], high[1]]), cell, top, (height, width))
    return replace(flat, dent=_dent(things, support, flat))


def _dent(things: Float[Tensor, "m 3"], support: Support, picture: TopView) -> Float[np.ndarray, "h w"]:
    """How far below the surface things lie in each cell [scene units], about 0 where none does."""
    times = max(1, round(DENT * support.view.radius / picture.cell))
    height, width = picture.alpha.shape
    deep = np.zeros((-(-height // times), -(-width // times)), np.float32)
    depth = -support.heights(things).numpy()
    below = (depth > 0) & (depth < DEEPEST * support.view.radius)
    row, column = (index[below] // times for index in picture.rows_columns(things))
    square = row * deep.shape[1] + column
    order = np.lexsort((-depth[below], square))  # the deepest of each square first
    squares, first, count = np.unique(square[order], return_index=True, return_counts=True)
    told = count > STRAYS
    deep.flat[squares[told]] = depth[below][order][first[told] + STRAYS] + picture.cell
    deep = cv2.dilate(deep, np.ones((3, 3)))  # so that what is between squares lies below things as well
    wide = cv2.resize(deep, (deep.shape[1] * times, deep.shape[0] * times), interpolation=cv2.INTER_LINEAR)
    return wide[:height, :width]


def _drawn(table: Gaussians, corner: Float[Tensor, "2"], cell: float, top: float, shape: tuple[int, int]) -> TopView:
    """The picture with this corner, cell and shape (rows, columns), from so high that the view is all but parallel."""
    height, width = shape
    away = 50 * max(shape) * cell
    viewmat = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    viewmat[:3, 3] = torch.tensor([-float(corner[0]), float(corner[1]), top + away])
    K = torch.tensor([[away / cell, 0, 0], [0, away / cell, 0], [0, 0, 1.0]])
    with torch.no_grad():
        drawn = rasterise(table, viewmat[None], K[None], width, height)
    alpha = drawn.alpha[0]
    rgb = (drawn.rgb[0] / alpha.clamp_min(1e-3)[..., None]).clamp(0, 1)
    flat = np.zeros(shape, np.float32)
    return TopView(corner, cell, top, rgb.numpy().astype(np.float32), alpha.numpy(), flat)


def _under(things: Float[Tensor, "m 3"], support: Support, picture: TopView) -> np.ndarray:
    """Cells directly under things that stand or hang low."""
    low = support.heights(things) < 0.3 * support.view.radius
    under = np.zeros(picture.alpha.shape, bool)
    under[picture.rows_columns(things[low])] = True
    return ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(under, 8), iterations=4)[8:-8, 8:-8])
