"""Depth maps -> the Gaussians that photometric refinement starts from."""

from __future__ import annotations

import logging
from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import spacing
from stages.core.geometry.planes import Plane
from stages.core.raster.rasterise import rasterise
from stages.core.scene.gaussians import Gaussians
from stages.reconstruct.depth import DepthMap, look_up_points, unproject
from stages.reconstruct.photos import Views

log = logging.getLogger(__name__)
C0 = 0.28209479177387814  # the constant spherical harmonic
MAX_POINTS = 6_000_000  # before thinning; bounds memory at about 1 GB


@dataclass(frozen=True)
class OrientedPoints:
    """Oriented coloured points."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]  # toward the camera that saw them
    colours: Float[Tensor, "n 3"]
    footprint: Float[Tensor, "n"]  # size of a pixel at the point [scene units]
    support: Float[Tensor, "n"]  # photos that confirm it

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index) -> OrientedPoints:
        return OrientedPoints(*(getattr(self, f.name)[index] for f in fields(self)))


def concatenate_points(clouds: list[OrientedPoints]) -> OrientedPoints:
    return OrientedPoints(*(torch.cat([getattr(c, f.name) for c in clouds]) for f in fields(OrientedPoints)))


def unproject_view(views: Views, i: int, depth: Float[Tensor, "h w"], support: Float[Tensor, "h w"]) -> OrientedPoints:
    """Every pixel of a view as an oriented point (h * w of them, in row order)."""
    K, viewmat = views.cameras.Ks[i], views.cameras.viewmats[i]
    _, points = unproject(depth, K, viewmat)
    padded = F.pad(points.permute(2, 0, 1)[None], (2, 2, 2, 2), mode="replicate")[0].permute(1, 2, 0)
    across, down = padded[2:-2, 4:] - padded[2:-2, :-4], padded[4:, 2:-2] - padded[:-4, 2:-2]
    normals = F.normalize(torch.linalg.cross(down, across), dim=-1)  # y down: this order points to the camera
    towards = F.normalize(-viewmat[:3, :3].mT @ viewmat[:3, 3] - points, dim=-1)
    normals = torch.where((normals * towards).sum(-1, keepdim=True) > 0.1, normals, towards)
    parts = points, normals, views.image(i), depth / K[0, 0], support
    return OrientedPoints(*(part.flatten(0, 1) for part in parts))


def fuse(views: Views, maps: list[DepthMap], least: int) -> OrientedPoints:
    """Points that at least `least` other photos confirm and that do not float before a confirmed surface."""
    pixels = sum(m.depth.numel() for m in maps)
    clouds = []
    for i, m in enumerate(maps):
        keep = (m.support >= least).flatten()
        if pixels > MAX_POINTS:
            generator = torch.Generator().manual_seed(i)
            keep &= torch.rand(len(keep), generator=generator) < MAX_POINTS / pixels
        clouds.append(unproject_view(views, i, m.depth, m.support)[keep])
    cloud = concatenate_points(clouds)
    blocked = free_space_violations(cloud.points, views, maps, least)
    return cloud[blocked <= 0.5 * cloud.support]


def free_space_violations(
    points: Float[Tensor, "n 3"], views: Views, maps: list[DepthMap], least: int
) -> Float[Tensor, "n"]:
    """How many views see a confirmed surface clearly behind each point, which therefore cannot be there."""
    count = torch.zeros(len(points))
    for j, m in enumerate(maps):
        K, viewmat = views.cameras.Ks[j], views.cameras.viewmats[j]
        sure = torch.where(m.support >= least, m.depth, torch.zeros_like(m.depth))
        surface, inside = look_up_points(sure, points, K, viewmat)
        behind = surface @ viewmat[2, :3] + viewmat[2, 3]
        count += inside & (behind > 1.04 * (points @ viewmat[2, :3] + viewmat[2, 3]))
    return count


def downsample(cloud: OrientedPoints, target: int, focus: Float[Tensor, "3"], radius: float) -> OrientedPoints:
    """About `target` points: one a cell, the cell a power of two times the pixel's size at the point.

    So detail near the cameras stays and far walls need few; what is in focus, within a third of the cameras'
    distance `radius`, keeps cells up to 3 times finer than the rest. The cell size is found by bisection.
    """
    if len(cloud) <= target:
        return cloud
    size = cloud.footprint * ((cloud.points - focus).norm(dim=1) / radius * 3).clamp(1, 3)
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
    lost = normals.norm(dim=1) < 0.5
    normals[lost] = torch.tensor([0.0, 0.0, 1.0])
    return OrientedPoints(mean(cloud.points), normals, mean(cloud.colours), mean(cloud.footprint), mean(cloud.support))


def _cells(points: Float[Tensor, "n 3"], size: Float[Tensor, "n"]) -> Int[Tensor, "n"]:
    """A number for the cell each point falls in; its side is the power of two nearest to `size`."""
    level = size.log2().round()
    index = (points / 2.0 ** level[:, None]).floor().long()
    mixed = index[:, 0] * 73856093 ^ index[:, 1] * 19349663 ^ index[:, 2] * 83492791  # Teschner et al. 2003
    return mixed * 64 + (level.long() & 63)


def fill_unmatched(
    views: Views, maps: list[DepthMap], cloud: OrientedPoints, plane: Plane | None, least: int, far: float,
    stride: int = 3, device: str = "cpu",
) -> OrientedPoints:  # fmt: skip
    """Points for what the photos show but no depth was confirmed at: every `stride`-th pixel not yet covered.

    In this order: on the supporting plane where it is known nearby or the matched depth is close to it; at the
    matched depth if at least one photo confirms it; at the depth interpolated from confirmed pixels where these
    surround the pixel; else at the depth `far`, where a wrong point hides nothing. What would stand before a
    surface that a photo confirms is moved there too.
    """
    clouds, solid = [], to_gaussians(cloud, torch.full((len(cloud),), 0.8), degree=0).to(device)
    for i, m in enumerate(maps):
        sure = m.support >= least
        away = torch.full_like(m.depth, far)
        depth = torch.where(surrounded_pixels(sure), interpolate_depth(m.depth, sure), away)
        depth = torch.where(m.support >= 1, m.depth, depth)
        if plane is not None:
            depth = _depth_on_plane(views, i, depth, m.depth, cloud, plane)
        rows = torch.zeros_like(sure)
        rows[stride // 2 :: stride, stride // 2 :: stride] = True
        wanted = (rows & ~covered_pixels(views, i, solid)).flatten()
        close = unproject_view(views, i, depth, torch.zeros_like(depth))[wanted]
        intrudes = free_space_violations(close.points, views, maps, 1) > 0
        distant = unproject_view(views, i, away, torch.zeros_like(depth))[wanted]
        clouds += [close[~intrudes], distant[intrudes]]
    found = concatenate_points(clouds)
    return found[free_space_violations(found.points, views, maps, least) == 0]


def surrounded_pixels(sure: Bool[Tensor, "h w"], reach: int = 16) -> Bool[Tensor, "h w"]:
    """Whether at least 3 in 10 pixels around each are sure: a hole in a surface, not the open side of it."""
    share = F.avg_pool2d(sure[None, None].float(), 2 * reach + 1, 1, reach, count_include_pad=True)
    return share[0, 0] > 0.3


def interpolate_depth(depth: Float[Tensor, "h w"], sure: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Depth everywhere: confirmed pixels spread over a pyramid of ever coarser means of inverse depth."""
    value, weight = (torch.where(sure, 1 / depth, torch.zeros_like(depth)))[None, None], sure[None, None].float()
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
        solid = (4 * weight).clamp(max=1)
        inverse = solid * value / weight.clamp_min(1e-9) + (1 - solid) * inverse
    return 1 / inverse[0, 0].clamp_min(1e-9)


def _depth_on_plane(
    views: Views, i: int, depth: Float[Tensor, "h w"], matched: Float[Tensor, "h w"], cloud: OrientedPoints,
    plane: Plane,
) -> Float[Tensor, "h w"]:
    """`depth`, but that of the supporting plane where the ray meets it near points known to lie on it, or
    where `matched` is within 3 % of it."""
    K, viewmat = views.cameras.Ks[i], views.cameras.viewmats[i]
    _, ones = unproject(torch.ones_like(depth), K, viewmat)
    eye = -viewmat[:3, :3].mT @ viewmat[:3, 3]
    along = ((ones - eye) @ plane.normal).clamp(max=-1e-6)
    z = -plane.heights(eye) / along
    met = eye + z[..., None] * (ones - eye)
    size = float((cloud.points - cloud.points.median(0).values).norm(dim=1).median())
    known = cloud.points[plane.heights(cloud.points).abs() < 0.02 * size]
    if not len(known):
        return depth
    cell = 0.1 * size
    side = torch.full((1,), cell)
    near = torch.isin(_cells(met.flatten(0, 1), side).reshape(depth.shape), _cells(known, side).unique())
    near |= (matched - z).abs() < 0.03 * z
    return torch.where(near & (z > 0) & (along < -0.05), z, depth)


@torch.no_grad()
def covered_pixels(views: Views, i: int, gaussians: Gaussians) -> Bool[Tensor, "h w"]:
    """Pixels of a view that the Gaussians hide by half or more."""
    height, width = views.images[i].shape[:2]
    viewmats, Ks = (x[[i]].to(gaussians.means) for x in (views.cameras.viewmats, views.cameras.Ks))
    return rasterise(gaussians, viewmats, Ks, width, height).alpha[0].cpu() > 0.5


def to_gaussians(cloud: OrientedPoints, opacity: Float[Tensor, "n"], degree: int) -> Gaussians:
    """Discs that just overlap: as wide as half the distance to their neighbours, a fifth as thick."""
    width = (0.6 * spacing(cloud.points)).clamp(min=0.3 * cloud.footprint, max=8 * cloud.footprint)
    quats = quats_from_normals(cloud.normals)
    sh = torch.zeros(len(cloud), (degree + 1) ** 2, 3)
    sh[:, 0] = (cloud.colours - 0.5) / C0
    scales = torch.stack([width, width, 0.2 * width], 1)
    return Gaussians(cloud.points, quats, scales, opacity, sh, torch.zeros(len(cloud), dtype=torch.int64))


def quats_from_normals(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Quaternions w x y z that turn the z axis into each normal by the smallest angle."""
    x, y, z = normals.unbind(1)
    opposite = z < -0.99999  # half a turn about x
    half = torch.stack([1 + z, -y, x, torch.zeros_like(z)], 1)
    half[opposite] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return F.normalize(half, dim=1)
