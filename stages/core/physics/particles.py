"""Sample the particles of an object from its Gaussians.

The Gaussians of an object form a shell, often with gaps. The shell is rasterised into voxels of half a grid cell, gaps
are closed, the enclosed volume is filled (an open bowl stays hollow), sheets are thickened to three voxels, and each
voxel gets one particle: eight in a full cell, as bodies with fewer than about four fracture numerically.

Bodies on a shared grid touch at a distance of about one cell. Thick bodies therefore leave their outermost layer of
voxels empty, with its mass and volume carried by the other particles, so that the visible surfaces close up. Lengths
are in the unit of the Gaussians.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.neighbours import knn
from stages.core.geometry.rotations import matrix
from stages.core.kernels.threads import parallel_map
from stages.core.perception.support import topples
from stages.core.physics.morphology import dilated, eroded, opened, squared_distances, surrounded, within
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene

log = logging.getLogger(__name__)

MIN_PARTICLE_OPACITY = 0.02  # Gaussians of lower opacity are ignored, as published
MAX_OUTLIER_SCORE = 3.5  # robust z-score of the distance to the median centre (Iglewicz and Hoaglin 1993)
MIN_PARTICLES = 40  # per object
MAX_VOXELS_ALONG = 300  # maximum number of voxels along an object
MAX_SURFACE_SAMPLES = 1_000_000  # maximum number of points sampled from the Gaussians of an object
START = 0.25  # of the object's bounds in their voxel
CLOSED = 1.5  # gap between Gaussians that is closed [their spacing]: the diagonal of a square of four is 1.41
LEAK_RADII = (2, 3, 4, 5, 6, 8)  # half widths of the holes in shells that are closed [voxels]
STRAY = 0.01  # fraction of an object's points that may be below it, and of voxels in which others may be
ON_FLOOR = 4  # gap up to which it stands on the floor [voxels]
UNDERSIDE = 0.02  # quantile of the heights of points at which an unseen underside begins: walls are ragged below
FULLER = 1.5  # ratio of volumes above which it closes an object: then it makes a body of a shell
BASE = 0.1  # fraction of a body's voxels that are below the top of its base, or ON_FLOOR voxels more
MIN_CAVITY_RATIO = 1.5  # minimum half width of a cavity relative to that of its leaks


@dataclass(frozen=True)
class Bodies:
    """Particles of all objects, in the order of scene.objects."""

    x: Float[Tensor, "p 3"]
    body: Int[Tensor, "p"]  # index into scene.objects
    volume: Float[Tensor, "p"]
    spacing: float  # edge of a voxel; particles of thick bodies stay this far inside


@cached_in_scene
def sample_bodies(scene: Scene, count: int, seed: int = 0, skin: bool = False) -> Bodies:
    """Sample about `count` particles for all objects together, in bounded time and memory.

    With `skin` the outermost layer of voxels of thick bodies has particles too.

    Objects that stood on the floor in photos but would tip over as reconstructed are extended down to the floor.
    Raises InputError for an object without any usable Gaussian.
    """
    clouds, gaps = zip(*parallel_map(lambda o: _cloud(scene, o.id, seed), scene.objects), strict=True)
    others = [_others(scene, o.id) for o in scene.objects]
    photographed = scene.cameras is not None  # so the objects were at rest
    extent = max(float((c.max(0) - c.min(0)).max()) for c in clouds)
    # closing bridges up to eight voxels; smaller voxels would break a sparse object into pieces
    finest = max(extent / MAX_VOXELS_ALONG, max(gaps) / 8, 1e-4 * scene_size(scene), 1e-9)
    h = max(extent / 40, finest)
    for _ in range(5):  # filled bodies hold ~ h^-3 voxels, shells ~ h^-2
        rows = list(zip(clouds, gaps, others, strict=True))
        solids = parallel_map(lambda row, h=h: _solid(row[0], h, *row[1:], scene.floor, photographed, skin), rows)
        voxels = _without_overlap([v for v, _, _ in solids])
        ratio = sum(map(len, voxels)) / count
        if 0.9 < ratio < 1.05 or (ratio < 1 and h <= finest):
            break
        h = max(h * min(max(ratio, 0.1), 10) ** 0.4, finest)
    rng = np.random.default_rng(seed)
    points = [(v + 0.5 + 0.5 * (rng.random(v.shape) - 0.5)) * h for v in voxels]
    body = torch.arange(len(points)).repeat_interleave(torch.tensor([len(p) for p in points]))
    volume = h**3 * torch.tensor([ratio for _, ratio, _ in solids])[body]
    for o, (_, _, extended) in zip(scene.objects, solids, strict=True):
        if extended:
            log.info("object %d (%s) stood in the photos but would tip over as reconstructed; its unseen part is "
                     "extended down to the floor (see also `ngff refine`)", o.id, o.name)  # fmt: skip
    return Bodies(torch.from_numpy(np.concatenate(points)).float(), body, volume, h)


def scene_size(scene: Scene) -> float:
    """Largest side of the objects' bounding box, from the 1 and 99 % quantiles of the Gaussians [scene units]."""
    means = scene.gaussians.means[(scene.gaussians.object_id > 0) & scene.gaussians.means.isfinite().all(1)]
    if not len(means):
        return 1.0
    low, high = (torch.from_numpy(np.quantile(means.numpy(), q, axis=0)) for q in (0.01, 0.99))
    return max(float((high - low).max()), 1e-6)


def usable(g: Gaussians) -> Tensor:
    """Mask of Gaussians with finite parameters, positive size and sufficient opacity."""
    finite = g.means.isfinite().all(1) & g.scales.isfinite().all(1) & g.quats.isfinite().all(1)
    return finite & (g.scales > 0).all(1) & (g.quats.norm(dim=1) > 0) & (g.opacities > MIN_PARTICLE_OPACITY)


@cached_in_scene
def usable_means(scene: Scene, object_id: int) -> Float[Tensor, "n 3"]:
    """Centres of an object's usable Gaussians, on the CPU."""
    mine = scene.gaussians.to("cpu")[(scene.gaussians.object_id == object_id).cpu()]
    return mine.means[usable(mine)]


def surface_points(scene: Scene, object_id: int, seed: int) -> np.ndarray:
    """Points (m, 3) sampled from an object's Gaussians within 0.7 standard deviations, without outliers.

    Raises InputError for an object without any usable Gaussian.
    """
    mine = scene.gaussians.to("cpu")[(scene.gaussians.object_id == object_id).cpu()]
    good = mine[usable(mine)]
    if not len(good):  # fall back to the bare centres
        means = mine.means[mine.means.isfinite().all(1)]
        if not len(means):
            raise InputError(
                f"object {object_id} ({scene.name_of(object_id)}): none of its {len(mine)} Gaussians is usable "
                "(not finite, or transparent); label the scene again with `ngff segment`"
            )
        return means.double().numpy()
    good = good[inliers(good.means)]
    means = good.means.double()
    size = float((means.amax(0) - means.amin(0)).norm())
    gap = _spacing(means) or size / 50
    scales = good.scales.double().clamp(max=max(size / 6, 1e-9) if len(good) > 1 else float(good.scales.median()))
    area = scales.sort(1).values[:, 1:].prod(1) * 4 / max(gap, 1e-12) ** 2
    each = (area.clamp(1, 32) - 1e-3).ceil().long()  # at a whole number rounding must not decide
    each = (each * min(1.0, MAX_SURFACE_SAMPLES / float(each.sum()))).long().clamp_min(1)
    rng = torch.Generator().manual_seed(seed)
    of = torch.arange(len(good)).repeat_interleave(each)
    direction = torch.nn.functional.normalize(torch.randn(len(of), 3, generator=rng, dtype=torch.float64), dim=1)
    local = 0.7 * torch.rand(len(of), 1, generator=rng, dtype=torch.float64).pow(1 / 3) * direction * scales[of]
    points = means[of] + (matrix(good.quats.double())[of] @ local[..., None])[..., 0]
    return np.asfortranarray(torch.cat([means, points]))


def inliers(points: Float[Tensor, "n 3"]) -> Tensor:
    """Mask of points whose distance to the median centre is not an outlier (robust z-score)."""
    distance = (points - points.median(0).values).norm(dim=1)
    middle = distance.median()
    spread = (distance - middle).abs().median()
    return 0.6745 * (distance - middle) <= MAX_OUTLIER_SCORE * spread.clamp_min(1e-12 + 1e-3 * float(middle))


@cached_in_scene
def filled_voxels(scene: Scene, object_id: int, along: int, seed: int = 0) -> tuple[Float[Tensor, "m 3"], float]:
    """Centres of the voxels of an object's filled body, its skin included, and their edge.

    There are about `along` voxels along its longest side, fewer where its surface is sampled too coarsely. The object's
    lower bounds are within the first ones, so that rounding does not decide in which voxels flat sides are. Raises
    InputError for an object without any usable Gaussian.
    """
    points, gap = _cloud(scene, object_id, seed)
    spacing = _spacing(usable_means(scene, object_id).double())
    h = max(float((points.max(0) - points.min(0)).max()) / along, gap / 8, spacing / 3, 1e-9)
    first = points.min(0) + (0.5 - START) * h  # centre of the first voxel
    origin = first - h / 2
    floor = scene.floor - origin[2] if _stands(points, h, scene.floor) else None
    body, low = _closed_body(points - origin, h, gap, floor, _others(scene, object_id, origin))
    return torch.from_numpy(first + (np.argwhere(body) + low) * h), h


def _solid(
    points: np.ndarray, h: float, gap: float, others: np.ndarray | None, floor: float | None, photographed: bool,
    skin: bool,
) -> tuple[np.ndarray, float, bool]:  # fmt: skip
    """Voxels of an object: indices (m, 3) of voxels of edge h in its closed and filled body, and the number of voxels
    of volume that each represents; and whether it was extended down to the floor, as one that would tip over although
    it stood when `photographed`.
    """
    stands = _stands(points, h, floor)
    body, low = _closed_body(points, h, gap, floor if stands else None, others)
    extended = photographed and stands and _topples(body)
    if extended:
        bottom = int(body.any((0, 1)).argmax())
        body = np.logical_or.accumulate(body[:, :, ::-1], 2)[:, :, ::-1]  # all voxels below it
        body[:, :, :bottom] = False
    inside = body if skin else body & ~_thick_skin(body)
    if inside.sum() < MIN_PARTICLES:
        inside = body
    return np.argwhere(inside) + low, float(body.sum() / inside.sum()), extended


def _others(scene: Scene, object_id: int, origin: np.ndarray | float = 0.0) -> np.ndarray | None:
    """Centres (k, 3) of the Gaussians of the other objects of a scene whose unseen sides are missing, from `origin`."""
    if scene.cameras is None or "refine" in scene.commands:
        return None
    means = [usable_means(scene, o.id) for o in scene.objects if o.id != object_id]
    return torch.cat([*means, torch.empty(0, 3)]).double().numpy() - origin


def _stands(points: np.ndarray, h: float, floor: float | None) -> bool:
    """Whether an object with these points, without stray ones, ends within ON_FLOOR voxels of edge h of the floor."""
    return floor is not None and abs(float(np.quantile(points[:, 2], STRAY)) - floor) < ON_FLOOR * h


def _topples(body: np.ndarray) -> bool:
    """Whether a body of voxels would tip over."""
    at = torch.from_numpy(np.argwhere(body)).float()
    return topples(at[:, :2], at[at[:, 2] < float(np.quantile(at[:, 2].numpy(), BASE)) + ON_FLOOR, :2])


def _closed_body(
    points: np.ndarray, h: float, gap: float, floor: float | None, others: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """The closed and filled body of an object as voxels of edge h, and the index of its first voxel.

    It is filled as one that hangs, or closed from below by the `floor` on which it stands: what fills more. Photos show
    no undersides of what is at rest, and only parts of the surface around them. So those with points of `others` (k, 3)
    are also closed where that becomes sparse, whatever they lie on, if it makes a body of a shell and the others are
    not inside.
    """
    cells = np.floor(points / h).astype(np.int64)
    margin = 6  # room for closing
    low = cells.min(0) - margin
    shape = np.minimum(cells.max(0) - low + 1 + margin, MAX_VOXELS_ALONG + 3 * margin)
    cells -= low
    kept = (cells < shape - margin).all(1)
    if not kept.all():
        points, cells = points[kept], cells[kept]
    at = np.ravel_multi_index(tuple(cells.T), shape)
    shell = np.zeros(shape, bool)
    shell.ravel()[at] = True
    bridge = min(max(math.ceil(gap / h / 2), 1), 4)
    wide, offset = within(shell, bridge), points / h - low - cells - 0.5

    def filled(bottom: int | None, leaks: Sequence[int], sealed: bool = False) -> np.ndarray:
        return _trim(_largest(_fill(shell, wide, bridge, bottom, leaks, sealed)), offset, at)

    body = filled(None, LEAK_RADII)
    lowest = margin if floor is None else max(margin, int(np.floor(floor / h)) - int(low[2]))
    if floor is not None:
        # gaps that closing just misses leak too, but folds of a cloth on the floor look like cavities with wide leaks
        body = max(body, filled(lowest, (bridge + 1,)), key=np.count_nonzero)
    most = np.logical_or.accumulate(shell[:, :, : margin - 1 : -1], 2).sum()  # voxels that any way fills
    if others is not None and most > FULLER * body.sum():
        below = max(lowest, int(np.quantile(cells[:, 2], UNDERSIDE)))
        other = filled(below, LEAK_RADII, sealed=True)
        theirs = np.floor(others / h).astype(np.int64) - low
        theirs = np.unique(theirs[((theirs >= 0) & (theirs < shape)).all(1)], axis=0)
        added = other & ~body
        inside = np.count_nonzero(added[tuple(theirs.T)]) > STRAY * added.sum()
        if other.sum() > FULLER * body.sum() and not inside:
            body = other
    thick = opened(body)
    thin = body & ~thick
    fringe = thin & surrounded(thick)  # what trimming left at edges, not a sheet
    body, thin = body & ~fringe, thin & ~fringe
    if thin.any():
        body |= dilated(thin)
    while body.sum() < MIN_PARTICLES:
        body = dilated(np.pad(body, 1))
        low = low - 1
    return body, low


@cached_in_scene
def _cloud(scene: Scene, object_id: int, seed: int) -> tuple[np.ndarray, float]:
    """`surface_points` of an object, and the gap between them that is closed."""
    points = surface_points(scene, object_id, seed)
    return points, max(_gap(points), CLOSED * _spacing(usable_means(scene, object_id).double()))


def _spacing(means: Float[Tensor, "n 3"]) -> float:
    """Median distance of Gaussians to the nearest other; 0 for one alone or none."""
    if len(means) < 2:
        return 0.0
    some = means[:: max(1, len(means) // 2000)]
    _, index = knn(means, some, 2)
    return float((some - means[index[:, -1]]).norm(dim=1).median())


def _gap(points: np.ndarray) -> float:
    """Gap that closing must bridge: the 90 % quantile of the distance to the third neighbour."""
    some = torch.from_numpy(points)
    distance, _ = knn(some, some[:: max(1, len(some) // 1000)], 4)
    return float(distance[:, 3].quantile(0.9))


def _fill(
    shell: np.ndarray, wide: np.ndarray, gap: int, bottom: int | None, leaks: Sequence[int], sealed: bool
) -> np.ndarray:
    """The shell with gaps closed and the enclosed volume filled; `wide` is within `gap` of it.

    `bottom` is the layer that closes it from below, against wide leaks too if it is `sealed`; `leaks` as for _cavities.
    """
    walls = wide.copy()
    if bottom is not None:
        walls[:, :, : bottom + 1] = True
    outside = _outside(~walls)
    enclosed = ~(outside | walls)
    grown = within(enclosed, gap) & wide if enclosed.any() else enclosed
    closed = ~within(~wide, gap)
    body = shell | closed | enclosed | (grown & ~within(outside, gap))
    body |= _cavities(body | (walls & ~wide) if sealed else body, leaks)
    if bottom is not None:
        body[:, :, : int(shell.any((0, 1)).argmax())] = False
    return body


def _cavities(walls: np.ndarray, leaks: Sequence[int]) -> np.ndarray:
    """Cavities with leaks narrower than the cavity by MIN_CAVITY_RATIO: a jug is filled, a mug or a bowl is not.

    Reconstructed shells have holes; left hollow, they would crumple like paper bags. `leaks` are the half widths of the
    holes to close [voxels], increasing.
    """
    if not walls.any():
        return walls
    box = ndimage.find_objects(walls.view(np.uint8))[0]  # what is free on its faces is so further out too
    inner = walls[box]
    away = squared_distances(inner, math.ceil(MIN_CAVITY_RATIO * leaks[-1]))
    filled = np.zeros_like(inner)
    for leak in leaks:
        free, wide = away > leak**2, away >= (MIN_CAVITY_RATIO * leak) ** 2
        hollow = free & ~_outside(free) & ~filled
        if (hollow & wide).any():
            hollow = _components_with(hollow, wide)
            room = leak + 1  # margin, beyond which all is free
            outside = _outside(squared_distances(np.pad(inner, room), leak) > leak**2)
            from_outside = squared_distances(outside, room)[room:-room, room:-room, room:-room]
            filled |= _components_with(~inner & (from_outside > room**2), hollow)  # to the walls, not through the leaks
    out = np.zeros_like(walls)
    out[box] = filled
    return out


def _components_with(free: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The connected components of the free voxels that contain a seed."""
    labels, count = ndimage.label(free)
    kept = np.zeros(count + 1, bool)
    kept[labels[free & seeds]] = True
    return kept[labels]


def _outside(free: np.ndarray) -> np.ndarray:
    """The free voxels connected to the faces of the grid."""
    labels, count = ndimage.label(free)
    kept = np.zeros(count + 1, bool)
    for axis in range(3):
        for end in (0, -1):
            kept[labels.take(end, axis)] = True
    kept[0] = False
    return kept[labels]


def _trim(body: np.ndarray, offset: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Remove outermost voxels of thick parts whose centre lies outside the surface.

    Otherwise a body would grow by half a voxel all around. Points on the surface are at `offset` (n, 3) from the
    centres of the voxels `at` (n,) of the flat grid [voxels].
    """
    skin = _thick_skin(body)
    some = skin.ravel()[at]
    at, offset = at[some], offset[some]
    slope = np.gradient(ndimage.gaussian_filter(body.astype(np.float32), 1.0))  # points inward
    depth = sum(offset[:, a] * slope[a].ravel()[at] for a in range(3))
    return body & ~(skin & (np.bincount(at, depth, body.size).reshape(body.shape) > 0))


def _thick_skin(body: np.ndarray) -> np.ndarray:
    """The outermost voxels where the body is at least five voxels thick."""
    core = eroded(body, 2)
    return body & ~eroded(body) & dilated(core, 3)


def _largest(body: np.ndarray) -> np.ndarray:
    """Remove connected components smaller than a fiftieth of the largest."""
    labels, n = ndimage.label(body, np.ones((3, 3, 3)))
    if n <= 1:
        return body
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return (sizes >= sizes.max() / 50)[labels] & body


def _without_overlap(bodies: list[np.ndarray]) -> list[np.ndarray]:
    """Assign each voxel to one body, smaller bodies first, unless too few voxels would remain."""
    out, low = list(bodies), np.min([b.min(0) for b in bodies], axis=0)
    span = np.max([b.max(0) for b in bodies], axis=0) - low + 1
    order = sorted(range(len(bodies)), key=lambda i: len(bodies[i]))
    cells = np.concatenate([bodies[i] for i in order]) - low
    first = np.unique((cells[:, 0] * span[1] + cells[:, 1]) * span[2] + cells[:, 2], return_index=True)[1]
    free = np.zeros(len(cells), bool)
    free[first] = True
    for i, own in zip(order, np.split(free, np.cumsum([len(bodies[i]) for i in order])[:-1]), strict=True):
        if own.sum() >= MIN_PARTICLES:
            out[i] = bodies[i][own]
    return out
