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
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.special import gammainccinv, gammaincinv
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.neighbours import KDTree, knn
from stages.core.geometry.rotations import matrix
from stages.core.kernels.threads import parallel_map
from stages.core.perception.support import topples
from stages.core.physics.body_filling import (
    MAX_VOXELS_ALONG,
    MIN_PARTICLES,
    STRAY,
    SurfaceCloud,
    closed_body,
    thick_skin,
)
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene

log = logging.getLogger(__name__)

MIN_PARTICLE_OPACITY = 0.02  # Gaussians of lower opacity are ignored, as published
MAX_OUTLIER_SCORE = 3.5  # robust z-score of the distance to the median centre (Iglewicz and Hoaglin 1993)
MAX_SURFACE_SAMPLES = 1_000_000  # maximum number of points sampled from the Gaussians of an object
START = 0.25  # position of the object's lower bounds within the first voxel [voxels]
CLOSED = 1.5  # largest gap between evenly spaced Gaussians [their spacing]: the diagonal of a square of four is 1.41
AROUND = 4  # number of neighbours at equal distance in a square lattice
MEDIAN_AROUND = gammaincinv(AROUND, 0.5)  # median of pi density distance^2 to the fourth of random neighbours
RANDOM = (math.log(2) / MEDIAN_AROUND) ** 0.5  # ratio of median distances to the first and fourth of random neighbours
ON_FLOOR = 4  # gap up to which an object stands on the floor [voxels]
BASE = 0.1  # a body's base reaches up to ON_FLOOR voxels above this quantile of its voxels' heights


@dataclass(frozen=True)
class Bodies:
    """Particles of all objects, in the order of scene.objects."""

    x: Float[Tensor, "p 3"]
    body: Int[Tensor, "p"]  # index into scene.objects
    volume: Float[Tensor, "p"]
    spacing: float  # edge of a voxel; without `skin`, particles of thick bodies stay this far inside the surface
    extended: frozenset[int] = frozenset()  # indices of the objects that are extended down to the floor


@cached_in_scene
def sample_bodies(scene: Scene, count: int, seed: int = 0, skin: bool = False) -> Bodies:
    """Sample about `count` particles for all objects together, in bounded time and memory.

    With `skin` the outermost layer of voxels of thick bodies also has particles. Objects that stood on the floor when
    photographed but would tip over as reconstructed are extended down to the floor. Raises InputError for an object
    without any usable Gaussian.
    """
    found = parallel_map(lambda o: _cloud(scene, o.id, seed), scene.objects)
    clouds = [SurfaceCloud(*row, _others(scene, o.id)) for row, o in zip(found, scene.objects, strict=True)]
    extent = max(float((c.points.max(0) - c.points.min(0)).max()) for c in clouds)
    # closing bridges up to eight voxels, so smaller voxels would break a sparse object into pieces
    finest = max(extent / MAX_VOXELS_ALONG, max(c.hole for c in clouds) / 8, 1e-4 * scene_size(scene), 1e-9)
    h, ratio = max(extent / 40, finest), 1.0
    for _ in range(5):
        h = max(h * min(max(ratio, 0.1), 10) ** 0.4, finest)  # filled bodies hold ~ h^-3 voxels, shells ~ h^-2
        solids = parallel_map(lambda cloud, h=h: _solid(scene, cloud, h, skin), clouds)
        voxels = _without_overlap([v for v, _, _ in solids])
        ratio = sum(map(len, voxels)) / count
        if 0.9 < ratio < 1.05 or (ratio < 1 and h <= finest):
            break
    rng = np.random.default_rng(seed)
    points = [(v + 0.5 + 0.5 * (rng.random(v.shape) - 0.5)) * h for v in voxels]
    body = torch.arange(len(points)).repeat_interleave(torch.tensor([len(p) for p in points]))
    volume = h**3 * torch.tensor([ratio for _, ratio, _ in solids])[body]
    extended = frozenset(row for row, solid in enumerate(solids) if solid[2])
    for o in (scene.objects[row] for row in sorted(extended)):
        log.info("object %d (%s) stands in the photos but its reconstruction would tip over; its unseen part is "
                 "extended down to the floor (`ngff refine` completes it)", o.id, o.name)  # fmt: skip
    return Bodies(torch.from_numpy(np.concatenate(points)).float(), body, volume, h, extended)


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
    return _usable(scene, object_id).means


@cached_in_scene
def _usable(scene: Scene, object_id: int) -> Gaussians:
    """An object's usable Gaussians, on the CPU, without colours."""
    g = scene.gaussians
    g = replace(g, sh=g.sh[:, :0])[g.object_id == object_id].to("cpu")
    return g[usable(g)]


def surface_points(scene: Scene, object_id: int, seed: int) -> np.ndarray:
    """Points (m, 3) sampled from an object's Gaussians within 0.7 standard deviations, without outliers.

    Raises InputError for an object without any usable Gaussian.
    """
    good = _usable(scene, object_id)
    if not len(good):  # fall back to all finite centres
        mine = scene.gaussians.means[scene.gaussians.object_id == object_id].cpu()
        means = mine[mine.isfinite().all(1)]
        if not len(means):
            raise InputError(
                f"object {object_id} ({scene.name_of(object_id)}): none of its {len(mine)} Gaussians is usable "
                "(not finite, or transparent); label the scene again with `ngff segment`"
            )
        return means.double().numpy()
    good = good[connected(good.means)]
    means = good.means.double()
    size = float((means.amax(0) - means.amin(0)).norm())
    gap = _spacing(means) or size / 50
    scales = good.scales.double().clamp(max=max(size / 6, 1e-9) if len(good) > 1 else float(good.scales.median()))
    area = scales.sort(1).values[:, 1:].prod(1) * 4 / max(gap, 1e-12) ** 2
    each = (area.clamp(1, 32) - 1e-3).ceil().long()  # the offset keeps rounding errors from changing whole numbers
    each = (each * min(1.0, MAX_SURFACE_SAMPLES / float(each.sum()))).long().clamp_min(1)
    rng = torch.Generator().manual_seed(seed)
    of = torch.arange(len(good)).repeat_interleave(each)
    direction = torch.nn.functional.normalize(torch.randn(len(of), 3, generator=rng, dtype=torch.float64), dim=1)
    local = 0.7 * torch.rand(len(of), 1, generator=rng, dtype=torch.float64).pow(1 / 3) * direction * scales[of]
    points = means[of] + (matrix(good.quats.double())[of] @ local[..., None])[..., 0]
    return np.asfortranarray(torch.cat([means, points]))


def inliers(points: Float[Tensor, "n 3"]) -> Tensor:
    """Mask of the points whose distance from the median centre is no outlier (robust z-score)."""
    distance = (points - points.median(0).values).norm(dim=1)
    middle = distance.median()
    spread = (distance - middle).abs().median()
    return 0.6745 * (distance - middle) <= MAX_OUTLIER_SCORE * spread.clamp_min(1e-12 + 1e-3 * float(middle))


def connected(points: Float[Tensor, "n 3"]) -> Tensor:
    """Mask of the `inliers` and of the points connected to them, such as the tip of a cone or a long handle.

    Points are connected if they are closer than the radius of the largest hole in the surface, or CLOSED spacings.
    """
    kept = inliers(points)
    if bool(kept.all()):
        return kept
    near = points[kept].double()
    link = max(largest_hole(near) / 2, CLOSED * _spacing(near))
    rest = (~kept).nonzero()[:, 0]
    while len(rest) and len(near):
        reached = KDTree(near).query(points[rest].double(), within=link)[0][:, 0] < math.inf
        kept[rest[reached]] = True
        near, rest = points[rest[reached]].double(), rest[~reached]
    return kept


@cached_in_scene
def filled_voxels(scene: Scene, object_id: int, along: int, seed: int = 0) -> tuple[Float[Tensor, "m 3"], float]:
    """Centres of the voxels of an object's filled body, including its outermost layer, and their edge length.

    There are about `along` voxels along its longest side, fewer if its surface is sampled too coarsely. The object's
    lower bounds lie inside the first voxels, not on their faces, so that rounding does not decide which voxels contain
    a flat side. Raises InputError for an object without any usable Gaussian.
    """
    points, gap, hole = _cloud(scene, object_id, seed)
    spacing = _usable_spacing(scene, object_id)
    h = max(float((points.max(0) - points.min(0)).max()) / along, hole / 8, spacing / 3, 1e-9)
    first = points.min(0) + (0.5 - START) * h  # centre of the first voxel
    origin = first - h / 2
    floor = scene.floor - origin[2] if _stands(points, h, scene.floor) else None
    cloud = SurfaceCloud(points - origin, gap, hole, _others(scene, object_id, origin))
    body, low = closed_body(cloud, h, floor)
    return torch.from_numpy(first + (np.argwhere(body) + low) * h), h


def _solid(scene: Scene, cloud: SurfaceCloud, h: float, skin: bool) -> tuple[np.ndarray, float, bool]:
    """Voxelise an object with voxels of edge h.

    Returns the indices (m, 3) of the voxels that get a particle, the volume that each represents [voxels], and whether
    the body was extended down to the floor because it stood there when photographed but would tip over.
    """
    stands = _stands(cloud.points, h, scene.floor)
    body, low = closed_body(cloud, h, scene.floor if stands else None)
    photographed = scene.cameras is not None  # so the objects were at rest
    extended = photographed and stands and _topples(body)
    if extended:
        bottom = int(body.any((0, 1)).argmax())
        body = np.logical_or.accumulate(body[:, :, ::-1], 2)[:, :, ::-1]  # all voxels below it
        body[:, :, :bottom] = False
    inside = body if skin else body & ~thick_skin(body)
    if inside.sum() < MIN_PARTICLES:
        inside = body
    return np.argwhere(inside) + low, float(body.sum() / inside.sum()), extended


def _others(scene: Scene, object_id: int, origin: np.ndarray | float = 0.0) -> np.ndarray | None:
    """Centres (k, 3) of the other objects' Gaussians relative to `origin`, or None if no unseen sides are missing.

    Unseen sides are missing in scenes with cameras that `ngff refine` has not processed.
    """
    if scene.cameras is None or "refine" in scene.commands:
        return None
    means = [usable_means(scene, o.id) for o in scene.objects if o.id != object_id]
    return torch.cat([*means, torch.empty(0, 3)]).double().numpy() - origin


def _stands(points: np.ndarray, h: float, floor: float | None) -> bool:
    """Whether an object's lowest point, apart from stray ones, is within ON_FLOOR voxels of edge h of the floor."""
    return floor is not None and abs(float(np.quantile(points[:, 2], STRAY)) - floor) < ON_FLOOR * h


def _topples(body: np.ndarray) -> bool:
    """Whether a body of voxels would tip over."""
    at = torch.from_numpy(np.argwhere(body)).float()
    return topples(at[:, :2], at[at[:, 2] < float(np.quantile(at[:, 2].numpy(), BASE)) + ON_FLOOR, :2])


@cached_in_scene
def _cloud(scene: Scene, object_id: int, seed: int) -> tuple[np.ndarray, float, float]:
    """`surface_points` of an object, the usual gap between them, and the widest gap within a closed surface."""
    points = surface_points(scene, object_id, seed)
    gap = max(_gap(points), CLOSED * _usable_spacing(scene, object_id))
    return points, gap, max(gap, largest_hole(usable_means(scene, object_id).double()))


@cached_in_scene
def _usable_spacing(scene: Scene, object_id: int) -> float:
    """`_spacing` of an object's usable Gaussians."""
    return _spacing(usable_means(scene, object_id).double())


def _spacing(means: Float[Tensor, "n 3"], neighbour: int = 1) -> float:
    """Median distance of Gaussians to their k-th nearest neighbour; 0 if there are not enough."""
    if len(means) <= neighbour:
        return 0.0
    some = means[:: max(1, len(means) // 2000)]
    _, index = knn(means, some, neighbour + 1)
    return float((some - means[index[:, -1]]).norm(dim=1).median())


def largest_hole(means: Float[Tensor, "n 3"]) -> float:
    """Width of the largest hole to be expected between Gaussians spread evenly or at random over a closed surface.

    Random points leave much wider holes than a lattice of equal density: of the 2 n circles through three of n points
    with no other point inside, the fraction (1 + x) exp(-x) is larger than x / pi times the area per point (Miles 1970,
    "On the homogeneous planar Poisson point process"). The width is interpolated between that of a lattice and that of
    random points by the ratio of the median distances to the nearest and the fourth neighbour.
    """
    near, around = _spacing(means), _spacing(means, AROUND)
    if not around:  # too few points, or more than AROUND in one place
        return CLOSED * near
    even = np.clip((near / around - RANDOM) / (1 - RANDOM), 0.0, 1.0)
    at_random = 2 * math.sqrt(float(gammainccinv(2, 0.5 / len(means))) / MEDIAN_AROUND)
    return float(even * CLOSED + (1 - even) * at_random) * around


def _gap(points: np.ndarray) -> float:
    """Gap that closing must bridge: the 90 % quantile of the distance to the third-nearest neighbour."""
    some = torch.from_numpy(points)
    distance, _ = knn(some, some[:: max(1, len(some) // 1000)], 4)
    return float(distance[:, 3].quantile(0.9))


def _without_overlap(bodies: list[np.ndarray]) -> list[np.ndarray]:
    """Assign each voxel to one body, smaller bodies first; a body that would keep too few voxels keeps all of them."""
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
