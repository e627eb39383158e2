"""Conversion of a network's point maps to cameras with intrinsics, and to depth maps of confident pixels."""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from stages.core.geometry.cameras import centres, resize
from stages.core.models.pi3.network import Geometry
from stages.core.scene.cameras import Cameras
from stages.reconstruct.depth import DepthMap, look_up_points, unproject
from stages.reconstruct.network_input import resize_bytes
from stages.reconstruct.photos import Views

MIN_CONFIDENCE = 0.1  # smallest confidence of the network for a pixel to be used
MAX_DEPTH_JUMP = 0.03  # largest range of depth in 3 x 3 pixels of a surface, relative to the depth
DEPTH_TOLERANCE = 0.03  # largest relative difference of consistent depths in two views
MAX_CHECK_VIEWS = 8  # number of nearest views that each view is checked against


def solve_intrinsics(
    points: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"] | None = None, centre: float = 0.5
) -> Float[Tensor, "3 3"]:
    """Least-squares K [px] that projects the points of a view, in camera axes, to their pixels.

    The principal point is the image centre; fx and fy are fitted over the pixels in `mask`. `centre` is the offset of
    pixel centres, which is 0 in the published code.
    """
    height, width = points.shape[:2]
    y, x = torch.meshgrid(*(torch.arange(s, device=points.device) + centre for s in (height, width)), indexing="ij")
    target = torch.stack([x - width / 2, y - height / 2], -1)
    ratio = points[..., :2] / points[..., 2:]
    weight = torch.ones_like(ratio[..., :1]) if mask is None else mask[..., None].to(ratio)
    fx, fy = ((weight * ratio * target).sum((0, 1)) / (weight * ratio * ratio).sum((0, 1)).clamp_min(1e-12)).tolist()
    return torch.tensor([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])


def depth_edges(depth: Float[Tensor, "h w"], max_jump: float = MAX_DEPTH_JUMP) -> Bool[Tensor, "h w"]:
    """Pixels at depth discontinuities: the range of depth in 3 x 3 pixels exceeds `max_jump` times the depth."""
    farthest = F.max_pool2d(depth[None, None], 3, 1, 1)[0, 0]
    nearest = -F.max_pool2d(-depth[None, None], 3, 1, 1)[0, 0]
    return (farthest - nearest) / depth > max_jump


def confident_pixels(geometry: Geometry) -> Bool[Tensor, "v h w"]:
    """Pixels with enough confidence, positive depth and no depth discontinuity."""
    depth = geometry.points[..., 2]
    edges = torch.stack([depth_edges(d) for d in depth])
    return (geometry.confidence > MIN_CONFIDENCE) & ~edges & (depth > 0) & geometry.points.isfinite().all(-1)


def cameras_from_pointmaps(geometry: Geometry, confident: Bool[Tensor, "v h w"], names: tuple[str, ...]) -> Cameras:
    """The cameras of the views, in pixels of the network's images and in its unit of length.

    Views with too few confident pixels get the median intrinsics of the others.
    """
    _, height, width = geometry.confidence.shape
    Ks = torch.stack([solve_intrinsics(p, m) for p, m in zip(geometry.points, confident, strict=True)])
    focals = Ks[:, :2, :2].diagonal(dim1=1, dim2=2)
    fitted = (confident.flatten(1).float().mean(1) > 0.01) & (focals > 0.1 * width).all(1)
    median = Ks[fitted].median(0).values if fitted.any() else torch.tensor(
        [[1.2 * width, 0, width / 2], [0, 1.2 * width, height / 2], [0, 0, 1]]
    )  # fmt: skip
    Ks = torch.where(fitted[:, None, None], Ks, median)
    sizes = torch.tensor([[width, height]]).repeat(len(names), 1)
    return Cameras(torch.linalg.inv(geometry.poses), Ks, sizes, names)


def depth_maps(depths: Float[Tensor, "v h w"], confident: Bool[Tensor, "v h w"], cameras: Cameras) -> list[DepthMap]:
    """Depth maps; support is 0 for pixels that are not confident, otherwise 1 plus the number of consistent views."""
    distances = torch.cdist(centres(cameras.viewmats), centres(cameras.viewmats))
    known = torch.where(confident, depths, torch.zeros_like(depths))
    out = []
    for i in range(len(cameras)):
        _, points = unproject(depths[i], cameras.Ks[i], cameras.viewmats[i])
        support = torch.ones_like(depths[i])
        for j in distances[i].argsort()[: MAX_CHECK_VIEWS + 1].tolist():
            if j == i:
                continue
            other, inside = look_up_points(known[j], points, cameras.Ks[j], cameras.viewmats[j])
            z = other @ cameras.viewmats[i][2, :3] + cameras.viewmats[i][2, 3]
            support += inside & ((z - depths[i]).abs() < DEPTH_TOLERANCE * depths[i])
        out.append(DepthMap(depths[i], support * confident[i]))
    return out


def views_at_size(cropped: list[UInt8[Tensor, "_ _ 3"]], cameras: Cameras, side: int) -> Views:
    """The cropped photos, at most `side` wide or high, with the cameras in their pixels."""
    images, Ks = [], []
    for image, K, old in zip(cropped, cameras.Ks, cameras.sizes.tolist(), strict=True):
        height, width = image.shape[:2]
        shrink = min(1.0, side / max(width, height))
        size = round(width * shrink), round(height * shrink)
        images.append(resize_bytes(image, *size) if shrink < 1 else image)
        Ks.append(resize(K, size[0] / old[0], size[1] / old[1]))
    sizes = torch.tensor([[image.shape[1], image.shape[0]] for image in images])
    return Views(tuple(images), replace(cameras, Ks=torch.stack(Ks), sizes=sizes))


def upsample(m: DepthMap, size: tuple[int, int]) -> DepthMap:
    """A depth map resized to (height, width): depth bilinear, support nearest, so that edges stay unsupported."""
    depth = F.interpolate(m.depth[None, None], size, mode="bilinear", align_corners=False)[0, 0]
    return DepthMap(depth, F.interpolate(m.support[None, None], size, mode="nearest-exact")[0, 0])
