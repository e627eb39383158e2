"""Initial Gaussians of the photometric fit, from depth maps."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import C0
from stages.core.geometry.neighbours import spacing
from stages.core.geometry.planes import Plane
from stages.core.raster.rasterise import rasterise
from stages.core.scene.gaussians import Gaussians
from stages.reconstruct.depth import DepthMap, look_up_points, unproject
from stages.reconstruct.photos import Views

MAX_INITIAL_POINTS = 6_000_000  # most points before downsampling, which bounds memory to about 1 GB
FREE_SPACE_MARGIN = 1.04  # a surface farther than this times the depth of a point proves that the point is free space
FOCUS_DETAIL = 3.0  # largest ratio between the voxel sizes outside and in the focus


@dataclass(frozen=True)
class DepthViews:
    """Views with their depth maps; a depth is consistent if at least `min_support` other views agree with it."""

    views: Views
    maps: list[DepthMap]
    min_support: int

    def consistent(self, i: int) -> Bool[Tensor, "h w"]:
        """The pixels of view i with consistent depth."""
        return self.maps[i].support >= self.min_support

    def to(self, device: str) -> DepthViews:
        """Move the depth maps to a device; photos and cameras stay where they are."""
        maps = [DepthMap(m.depth.to(device), m.support.to(device)) for m in self.maps]
        return DepthViews(self.views, maps, self.min_support)


@dataclass(frozen=True)
class OrientedPoints:
    """Coloured points with normals."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]  # unit, towards the camera
    colours: Float[Tensor, "n 3"]
    footprint: Float[Tensor, "n"]  # width of a pixel at the point [scene units]
    support: Float[Tensor, "n"]  # number of views that agree with it

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index) -> OrientedPoints:
        return OrientedPoints(*(getattr(self, f.name)[index] for f in fields(self)))

    def to(self, device: torch.device | str) -> OrientedPoints:
        """Move the points to a device."""
        return OrientedPoints(*(getattr(self, f.name).to(device) for f in fields(self)))


def concatenate_points(clouds: list[OrientedPoints]) -> OrientedPoints:
    """Concatenate clouds in order."""
    return OrientedPoints(*(torch.cat([getattr(c, f.name) for c in clouds]) for f in fields(OrientedPoints)))


def unproject_view(views: Views, i: int, depth: Float[Tensor, "h w"], support: Float[Tensor, "h w"]) -> OrientedPoints:
    """Every pixel of view i as an oriented point, h * w in row order; normals are central differences over 4 px."""
    K, viewmat = views.cameras.Ks[i].to(depth), views.cameras.viewmats[i].to(depth)
    _, points = unproject(depth, K, viewmat)
    padded = F.pad(points.permute(2, 0, 1)[None], (2, 2, 2, 2), mode="replicate")[0].permute(1, 2, 0)
    across, down = padded[2:-2, 4:] - padded[2:-2, :-4], padded[4:, 2:-2] - padded[:-4, 2:-2]
    normals = F.normalize(torch.linalg.cross(down, across), dim=-1)  # y down: this order points to the camera
    towards = F.normalize(-viewmat[:3, :3].mT @ viewmat[:3, 3] - points, dim=-1)
    normals = torch.where((normals * towards).sum(-1, keepdim=True) > 0.1, normals, towards)
    parts = points, normals, views.image(i, depth.device), depth / K[0, 0], support
    return OrientedPoints(*(part.flatten(0, 1) for part in parts))


def fuse(observed: DepthViews) -> OrientedPoints:
    """Fuse the consistent depth of all views to points, without points in the free space in front of a surface.

    A point is dropped if more than half as many views contradict it as support it.
    """
    pixels = sum(m.depth.numel() for m in observed.maps)
    clouds = []
    for i, m in enumerate(observed.maps):
        keep = observed.consistent(i).flatten()
        if pixels > MAX_INITIAL_POINTS:
            generator = torch.Generator().manual_seed(i)
            keep &= (torch.rand(len(keep), generator=generator) < MAX_INITIAL_POINTS / pixels).to(keep.device)
        clouds.append(unproject_view(observed.views, i, m.depth, m.support)[keep])
    cloud = concatenate_points(clouds)
    violations = free_space_violations(cloud.points, observed, observed.min_support)
    return cloud[violations <= 0.5 * cloud.support]


def free_space_violations(points: Float[Tensor, "n 3"], observed: DepthViews, min_support: int) -> Float[Tensor, "n"]:
    """Number of views in which each point is in free space: in front of a surface with at least `min_support`."""
    count, cameras = torch.zeros_like(points[:, 0]), observed.views.cameras
    for K, viewmat, m in zip(cameras.Ks.to(points), cameras.viewmats.to(points), observed.maps, strict=True):
        known = torch.where(m.support >= min_support, m.depth, torch.zeros_like(m.depth))
        surface, inside = look_up_points(known, points, K, viewmat)
        surface_depth = surface @ viewmat[2, :3] + viewmat[2, 3]
        count += inside & (surface_depth > FREE_SPACE_MARGIN * (points @ viewmat[2, :3] + viewmat[2, 3]))
    return count


def downsample(cloud: OrientedPoints, target: int, focus: Float[Tensor, "3"], radius: float) -> OrientedPoints:
    """Reduce a cloud to about `target` points: the weighted mean of the points in each voxel.

    The voxel size is proportional to the pixel size at the point, rounded to a power of two, so that detail near the
    cameras is kept; within a third of the cameras' distance `radius` from `focus` voxels are up to 3 times finer. The
    factor of proportionality is found by bisection.
    """
    if len(cloud) <= target:
        return cloud
    size = cloud.footprint * ((cloud.points - focus).norm(dim=1) / radius * FOCUS_DETAIL).clamp(1, FOCUS_DETAIL)
    low, high = 0.5, 64.0
    for _ in range(9):
        middle = (low * high) ** 0.5
        count = len(_cells(cloud.points, size * middle).unique())
        low, high = (middle, high) if count > target else (low, middle)
    _, cell = _cells(cloud.points, size * high).unique(return_inverse=True)
    count = int(cell.max()) + 1
    weight = 1 + cloud.support
    total = torch.zeros(count).index_add_(0, cell, weight)

    def mean(values: Tensor) -> Tensor:
        w = weight.reshape(-1, *[1] * (values.ndim - 1))
        out = torch.zeros(count, *values.shape[1:]).index_add_(0, cell, values * w)
        return out / total.reshape(-1, *[1] * (values.ndim - 1))

    normals = F.normalize(mean(cloud.normals), dim=1)
    undefined = normals.norm(dim=1) < 0.5
    normals[undefined] = torch.tensor([0.0, 0.0, 1.0])
    return OrientedPoints(mean(cloud.points), normals, mean(cloud.colours), mean(cloud.footprint), mean(cloud.support))


def _cells(points: Float[Tensor, "n 3"], size: Float[Tensor, "n"]) -> Int[Tensor, "n"]:
    """A number for the voxel of each point, whose side is the power of two nearest to `size`.

    Different voxels have different numbers, unless they are 2^19 sides or 64 levels apart.
    """
    level = size.log2().round()
    x, y, z = ((points / 2.0 ** level[:, None]).floor().long() & (2**19 - 1)).unbind(1)
    return ((x << 19 | y) << 19 | z) << 6 | level.long() & 63


def fill_unmatched(
    observed: DepthViews, cloud: OrientedPoints, plane: Plane | None, far: float, stride: int = 3
) -> OrientedPoints:
    """Points for pixels without consistent depth: every `stride`-th pixel that `cloud` does not cover.

    Their depth is the first of these: that of the supporting plane, if points on the plane are near or the matched
    depth is close to it; the matched depth, if at least one view agrees; the depth interpolated from consistent pixels,
    if these surround the pixel and it is not in a backdrop; and `far`, where a wrong point occludes nothing. Points in
    the free space in front of a surface that a view confirms are moved to `far` too. The points are on the device of
    the depth maps.
    """
    views, clouds, device = observed.views, [], observed.maps[0].depth.device
    opaque = to_gaussians(cloud, torch.full((len(cloud),), 0.8), degree=0).to(device)
    on_plane = None if plane is None else _PlanePoints.of(cloud, plane, device)
    for i, m in enumerate(observed.maps):
        consistent = observed.consistent(i)
        away = torch.full_like(m.depth, far)
        hole = surrounded_pixels(consistent) & (m.support >= 0)
        depth = torch.where(hole, interpolate_depth(m.depth, consistent), away)
        depth = torch.where(m.support >= 1, m.depth, depth)
        if on_plane is not None:
            depth = _depth_on_plane(views, i, depth, m.depth, on_plane)
        grid = torch.zeros_like(consistent)
        grid[stride // 2 :: stride, stride // 2 :: stride] = True
        missing = (grid & ~covered_pixels(views, i, opaque)).flatten()
        close = unproject_view(views, i, depth, torch.zeros_like(depth))[missing]
        floating = free_space_violations(close.points, observed, 1) > 0
        distant = unproject_view(views, i, away, torch.zeros_like(depth))[missing]
        clouds += [close[~floating], distant[floating]]
    found = concatenate_points(clouds)
    return found[free_space_violations(found.points, observed, observed.min_support) == 0]


def surrounded_pixels(known: Bool[Tensor, "h w"], radius: int = 16) -> Bool[Tensor, "h w"]:
    """Mask of pixels with more than 30 % known pixels within `radius`: holes in a surface, not its open boundary."""
    fraction, side = known[None, None].float(), 2 * radius + 1
    for window, border in (((side, 1), (radius, 0)), ((1, side), (0, radius))):
        fraction = F.avg_pool2d(fraction, window, 1, border, count_include_pad=True)
    return fraction[0, 0] > 0.3


def interpolate_depth(depth: Float[Tensor, "h w"], known: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Depth at every pixel by pull-push interpolation of the inverse depth of known pixels over an image pyramid.

    Source: Gortler et al. 1996, "The Lumigraph" (pull-push).
    """
    value, weight = (torch.where(known, 1 / depth, torch.zeros_like(depth)))[None, None], known[None, None].float()
    levels = []
    while True:
        levels.append((value, weight))
        if min(value.shape[2:]) < 2:
            break
        value, weight = (F.avg_pool2d(x, 2, ceil_mode=True, count_include_pad=False) for x in (value, weight))
    value, weight = levels.pop()
    inverse = value.sum() / weight.sum().clamp_min(1e-9) * torch.ones_like(value)
    while levels:
        value, weight = levels.pop()
        inverse = F.interpolate(inverse, value.shape[2:], mode="bilinear", align_corners=False)
        blend = (4 * weight).clamp(max=1)
        inverse = blend * value / weight.clamp_min(1e-9) + (1 - blend) * inverse
    return 1 / inverse[0, 0].clamp_min(1e-9)


@dataclass(frozen=True)
class _PlanePoints:
    """The supporting plane, and the cells that contain points on it."""

    plane: Plane
    side: float  # side of a cell [scene units]
    cells: Int[Tensor, "c"]  # hashes of the cells

    @classmethod
    def of(cls, cloud: OrientedPoints, plane: Plane, device: torch.device) -> _PlanePoints | None:
        """Find the points of `cloud` on the plane; None if there are none."""
        size = float((cloud.points - cloud.points.median(0).values).norm(dim=1).median())
        known = cloud.points[plane.heights(cloud.points).abs() < 0.02 * size]
        cells = _cells(known, torch.full((1,), 0.1 * size)).unique().to(device)
        return cls(Plane(plane.normal.to(device), plane.offset), 0.1 * size, cells) if len(known) else None


def _depth_on_plane(
    views: Views, i: int, depth: Float[Tensor, "h w"], matched: Float[Tensor, "h w"], on: _PlanePoints
) -> Float[Tensor, "h w"]:
    """Replace `depth` by that of the supporting plane near points on the plane, or where `matched` agrees with it.

    Depths agree if they differ by less than 3 %.
    """
    K, viewmat = views.cameras.Ks[i].to(depth), views.cameras.viewmats[i].to(depth)
    _, ones = unproject(torch.ones_like(depth), K, viewmat)
    eye = -viewmat[:3, :3].mT @ viewmat[:3, 3]
    along = ((ones - eye) @ on.plane.normal).clamp(max=-1e-6)
    z = -on.plane.heights(eye) / along
    hit = eye + z[..., None] * (ones - eye)
    near = torch.isin(_cells(hit.flatten(0, 1), depth.new_full((1,), on.side)).reshape(depth.shape), on.cells)
    near |= (matched - z).abs() < 0.03 * z
    return torch.where(near & (z > 0) & (along < -0.05), z, depth)


@torch.no_grad()
def covered_pixels(views: Views, i: int, gaussians: Gaussians) -> Bool[Tensor, "h w"]:
    """Mask of the pixels of view i where the Gaussians have an alpha above 0.5."""
    height, width = views.images[i].shape[:2]
    viewmats, Ks = (x[[i]].to(gaussians.means) for x in (views.cameras.viewmats, views.cameras.Ks))
    return rasterise(gaussians, viewmats, Ks, width, height).alpha[0] > 0.5


def to_gaussians(cloud: OrientedPoints, opacity: Float[Tensor, "n"], degree: int) -> Gaussians:
    """Flat Gaussians at the points, with standard deviations of 0.6 neighbour distances; a fifth along the normal."""
    width = (0.6 * spacing(cloud.points)).clamp(min=0.3 * cloud.footprint, max=8 * cloud.footprint)
    quats = quats_from_normals(cloud.normals)
    sh = torch.zeros(len(cloud), (degree + 1) ** 2, 3)
    sh[:, 0] = (cloud.colours - 0.5) / C0
    scales = torch.stack([width, width, 0.2 * width], 1)
    return Gaussians(cloud.points, quats, scales, opacity, sh, torch.zeros(len(cloud), dtype=torch.int64))


def quats_from_normals(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Quaternions w x y z of the smallest rotation from the z axis to each unit normal."""
    x, y, z = normals.unbind(1)
    opposite = z < -0.99999  # 180 degrees about x
    half = torch.stack([1 + z, -y, x, torch.zeros_like(z)], 1)
    half[opposite] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return F.normalize(half, dim=1)
