"""Rigid-body shape of each object: its convex hull, volume, centre of mass and inertia.

Round objects are balls (`ball_fit.py`) or cylinders (`cylinder_fit.py`). Any other object that fills its convex hull
has the moments of the hull; the rest have those of their filled voxels. Lengths are in the unit of the Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError, cKDTree
from torch import Tensor

from stages.core.geometry.extremes import EXTREMES, extreme_rows
from stages.core.kernels.threads import parallel_map
from stages.core.physics.ball_fit import DENT, Ball, fitted_ball
from stages.core.physics.cylinder_fit import Cylinder, fitted_cylinder
from stages.core.physics.keypoints import farthest_points
from stages.core.physics.solid_surface import solid_surface
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.scene import Scene

CONVEX = 0.9  # minimum fraction of its hull that a convex object fills; volumes of voxels are accurate to about 5 %
MAX_VERTICES = 200  # of a hull: approximates an egg to 1 %
THIN = 4.0  # mean hull thickness below which the volume of voxels is too inaccurate for CONVEX [voxels]
COVERED = 1.5  # distance from the nearest voxel of the body up to which a point on a thin hull is covered [voxels]
COVER = 0.98  # minimum fraction of the surface of a thin hull that is covered if the object fills it
HULL_SUBSET = 2000  # points whose hull is tested first: an object that does not fill it fills no larger hull
CORNERS = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), -1).reshape(-1, 3)
Moments = tuple[float, Float[Tensor, "3"], Float[Tensor, "3 3"]]  # volume, centre, inertia about it at density 1


@dataclass(frozen=True)
class Solid:
    """The filled body of an object."""

    voxels: np.ndarray  # (m, 3), centres
    h: float  # edge of a voxel
    surface: np.ndarray  # (n, 3), points on the surface
    seen: np.ndarray  # (k, 3), centres of the object's Gaussians
    moments: Moments


@dataclass(frozen=True)
class RigidShape:
    """Convex hull of an object and the mass properties of its filled body at density 1."""

    hull: Float[Tensor, "v 3"]  # vertices
    convex: bool  # the object fills its hull
    volume: float
    com: Float[Tensor, "3"]  # centre of mass
    inertia: Float[Tensor, "3 3"]  # about the centre of mass [unit^5]
    ball: Ball | None = None  # if the object is a ball; `hull` then has the ball's points in the directions EXTREMES
    cylinder: Cylinder | None = None  # if the object is a cylinder; `hull` then has points on its two rims


@cached_in_scene
def rigid_shapes(scene: Scene, seed: int = 0, bottom: float = -np.inf) -> list[RigidShape]:
    """The shape of each object, in the order of scene.objects.

    The part below the height `bottom` is cut off. Raises InputError for an object without any usable Gaussian.
    """
    solids, found = _solids(scene, seed, bottom), balls(scene, seed, bottom)

    def shape(row: int) -> RigidShape:
        ball = found[row]
        return _shape(solids[row], seed) if ball is None else _ball_shape(ball)

    return parallel_map(shape, range(len(solids)))


@cached_in_scene
def standing_shapes(scene: Scene, seed: int, floor: float) -> list[tuple[RigidShape, float]]:
    """The shape of each object above its support, as `rigid_shapes`, and the height of the support.

    The support is at `floor`, except for an object whose median height is below: that stands on something else, and
    its support is at its lowest point.
    """
    out = [(shape, floor) for shape in rigid_shapes(scene, seed, floor)]
    for row, o in enumerate(scene.objects):
        own = scene.gaussians.object_id == o.id
        if float(scene.gaussians.means[own, 2].median()) < floor:
            (shape,) = rigid_shapes(replace(scene, gaussians=scene.gaussians[own], objects=(o,)), seed)
            out[row] = shape, float(shape.hull[:, 2].min())
    return out


@cached_in_scene
def balls(scene: Scene, seed: int = 0, bottom: float = -np.inf) -> list[Ball | None]:
    """The ball that each object is, or None, in the order of scene.objects; arguments and errors as `rigid_shapes`."""
    solids = _solids(scene, seed, bottom)

    def fitted(row: int) -> Ball | None:
        ball = fitted_ball(solids[row].surface, bottom, all_seen=scene.cameras is None)
        clear = ball is not None and ball.clear_of(_around(solids, row, DENT * ball.radius))
        return ball if clear else None

    return parallel_map(fitted, range(len(solids)))


@cached_in_scene
def convex_hulls(scene: Scene, seed: int = 0, bottom: float = -np.inf) -> list[ConvexHull | None]:
    """The convex hull of each object that fills it, else None, in the order of scene.objects.

    Arguments and errors as `rigid_shapes`. Only the extreme points in the directions EXTREMES are used, because the
    hull of all points of a round object has a face for every few Gaussians.
    """
    return [_filled_hull(solid, _extreme(solid.seen)) for solid in _solids(scene, seed, bottom)]


@cached_in_scene
def _solids(scene: Scene, seed: int, bottom: float) -> list[Solid]:
    return parallel_map(lambda id: _solid(scene, id, seed, bottom), [o.id for o in scene.objects])


def _solid(scene: Scene, object_id: int, seed: int, bottom: float) -> Solid:
    body = solid_surface(scene, object_id, seed)
    voxels, inside, share = body.fitted.body_voxels()
    kept = voxels[:, 2] > min(bottom, float(voxels[inside, 2].max()) - body.h)
    inside = inside[kept]
    seen, surface = (np.column_stack([p[:, :2], p[:, 2].clip(min=bottom)]) for p in (body.seen, body.points))
    voxels = voxels[kept]
    moments = _voxel_moments(voxels, share[kept], body.h)
    return Solid(voxels[inside], body.h, surface, seen if len(seen) else voxels, moments)


def _around(solids: list[Solid], row: int, margin: float) -> np.ndarray:
    """Centres (n, 3) of the other solids' voxels within `margin` of the bounding box of solid `row`.

    Voxels in the solid or next to it are left out.
    """
    own = solids[row]
    low, high = own.voxels.min(0) - margin, own.voxels.max(0) + margin
    near = [s.voxels[((s.voxels > low) & (s.voxels < high)).all(1)] for k, s in enumerate(solids) if k != row]
    others = np.concatenate([np.empty((0, 3)), *near])
    return others[cKDTree(own.voxels).query(others, distance_upper_bound=own.h)[0] == np.inf]


def _ball_shape(ball: Ball) -> RigidShape:
    volume, centre = 4 / 3 * np.pi * ball.radius**3, torch.from_numpy(ball.centre).float()
    hull = centre + ball.radius * torch.from_numpy(EXTREMES)
    return RigidShape(hull, True, volume, centre, 0.4 * volume * ball.radius**2 * torch.eye(3), ball)


def _cylinder_shape(cylinder: Cylinder) -> RigidShape:
    hull, centre, inertia = (
        torch.from_numpy(x).float() for x in (cylinder.rims(MAX_VERTICES // 2), cylinder.centre, cylinder.inertia)
    )
    return RigidShape(hull, True, cylinder.volume, centre, inertia, cylinder=cylinder)


def _shape(solid: Solid, seed: int) -> RigidShape:
    filled = _filled_hull(solid, solid.seen)
    if filled is not None:
        if (cylinder := fitted_cylinder(solid.surface, filled)) is not None:
            return _cylinder_shape(cylinder)
        return RigidShape(_vertices(filled, seed), True, *_solid_moments(filled))
    hull = _hull(_extreme(solid.surface)) or ConvexHull(_extreme(_corners(solid.voxels, solid.h)))
    return RigidShape(_vertices(hull, seed), False, *solid.moments)


def _filled_hull(solid: Solid, points: np.ndarray) -> ConvexHull | None:
    """The convex hull of `points`, if the solid fills it."""
    for some in (
        points[:: -(-len(points) // HULL_SUBSET)],
        points,
    ):  # the hull of a subset is smaller and cheap to compute
        hull = _hull(some)
        if hull is None or (hull.volume * CONVEX >= solid.moments[0] and not _covers(solid, hull)):
            return None
    return hull


def _covers(solid: Solid, hull: ConvexHull) -> bool:
    """Whether the hull is only a few voxels thick and the body's voxels cover its surface, so that they fill it."""
    if 2 * hull.volume > THIN * solid.h * hull.area:
        return False
    corners = hull.points[hull.simplices]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng(0)
    shares = rng.dirichlet((1, 1, 1), HULL_SUBSET)
    x = (shares[..., None] * corners[rng.choice(len(area), HULL_SUBSET, p=area / area.sum())]).sum(1)
    near = cKDTree(solid.voxels).query(x, distance_upper_bound=COVERED * solid.h)[0] < np.inf
    return float(near.mean()) > COVER


def _voxel_moments(voxels: np.ndarray, share: np.ndarray, h: float) -> Moments:
    """Moments of voxels with centres (m, 3) and edge h, of each of which the fraction `share` (m,) is filled."""
    x, w = torch.from_numpy(voxels), torch.from_numpy(share / share.sum())
    com = w @ x
    r = x - com
    volume = float(share.sum()) * h**3
    second = (w[:, None] * r).mT @ r + h**2 / 12 * torch.eye(3, dtype=torch.float64)
    return volume, com.float(), (volume * (second.trace() * torch.eye(3, dtype=torch.float64) - second)).float()


def _hull(points: np.ndarray) -> ConvexHull | None:
    """The convex hull; None where the points span no volume."""
    try:
        return ConvexHull(points)
    except (QhullError, ValueError):
        return None


def _vertices(hull: ConvexHull, seed: int) -> Float[Tensor, "v 3"]:
    """At most MAX_VERTICES vertices of a hull, spread evenly."""
    corners = torch.from_numpy(hull.points[hull.vertices]).float()
    return corners[farthest_points(corners, MAX_VERTICES, seed)]


def _solid_moments(hull: ConvexHull) -> Moments:
    """Moments of a convex hull, summed over the tetrahedra between an inner point and its triangles."""
    middle = hull.points[hull.vertices].mean(0)
    t = hull.points[hull.simplices] - middle  # (m, 3, 3): corners of each triangle
    volume = np.abs(np.linalg.det(t)) / 6
    total = volume.sum()
    com = (volume[:, None] * t.sum(1)).sum(0) / (4 * total)
    # integral of x x^T over a tetrahedron with one corner at the origin: V / 20 (sum of corners' x x^T + s s^T)
    s = t.sum(1)
    second = np.einsum("n,nci,ncj->ij", volume, t, t) + np.einsum("n,ni,nj->ij", volume, s, s)
    second = second / 20 - total * np.outer(com, com)
    inertia = np.trace(second) * np.eye(3) - second
    return float(total), torch.from_numpy(middle + com).float(), torch.from_numpy(inertia).float()


def _extreme(points: np.ndarray) -> np.ndarray:
    """The points that are extreme in one of the directions EXTREMES."""
    return points[extreme_rows(points)] if len(points) > len(EXTREMES) else points


def _corners(voxels: np.ndarray, h: float) -> np.ndarray:
    """Corners (8 m, 3) of voxels (m, 3) of edge h."""
    return (voxels[:, None] + h * CORNERS).reshape(-1, 3)
