"""A network's points -> cameras with intrinsics, and depth maps of what can be trusted."""

from __future__ import annotations

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

MIN_CONFIDENCE = 0.1  # below it a pixel is not trusted
MAX_DEPTH_JUMP = 0.03  # share of its depth by which a pixel's neighbours may differ
DEPTH_TOLERANCE = 0.03  # share of its depth within which another view sees the same
MAX_CHECK_VIEWS = 8  # other views asked


def solve_intrinsics(
    points: Float[Tensor, "h w 3"], sure: Bool[Tensor, "h w"] | None = None, centre: float = 0.5
) -> Float[Tensor, "3 3"]:
    """K [px] under which the points of a view, in its camera's frame, best project to their pixels.

    The principal point is the image centre; fx and fy are least-squares fits over the pixels that are `sure`.
    Pixel centres are at +`centre`: the published code has them at 0.
    """
    height, width = points.shape[:2]
    y, x = torch.meshgrid(*(torch.arange(s, device=points.device) + centre for s in (height, width)), indexing="ij")
    wanted = torch.stack([x - width / 2, y - height / 2], -1)
    ratio = points[..., :2] / points[..., 2:]
    weight = torch.ones_like(ratio[..., :1]) if sure is None else sure[..., None].to(ratio)
    fx, fy = ((weight * ratio * wanted).sum((0, 1)) / (weight * ratio * ratio).sum((0, 1)).clamp_min(1e-12)).tolist()
    return torch.tensor([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])


def depth_edges(depth: Float[Tensor, "h w"], share: float = MAX_DEPTH_JUMP) -> Bool[Tensor, "h w"]:
    """Pixels where one surface ends before another: depth spans more than `share` of itself in 3 x 3 pixels."""
    farthest = F.max_pool2d(depth[None, None], 3, 1, 1)[0, 0]
    nearest = -F.max_pool2d(-depth[None, None], 3, 1, 1)[0, 0]
    return (farthest - nearest) / depth > share


def confident_pixels(geometry: Geometry) -> Bool[Tensor, "v h w"]:
    """Pixels that the network is confident of and that are on no edge."""
    depth = geometry.points[..., 2]
    edges = torch.stack([depth_edges(d) for d in depth])
    return (geometry.confidence > MIN_CONFIDENCE) & ~edges & (depth > 0) & geometry.points.isfinite().all(-1)


def cameras_from_pointmaps(geometry: Geometry, sure: Bool[Tensor, "v h w"], names: tuple[str, ...]) -> Cameras:
    """The cameras, in pixels of the network's images and in its unit of length.

    All photos share one shape, and mostly one lens: a view with too little to fit takes the median focal length.
    """
    _, height, width = geometry.confidence.shape
    Ks = torch.stack([solve_intrinsics(p, s) for p, s in zip(geometry.points, sure, strict=True)])
    fitted = (sure.flatten(1).float().mean(1) > 0.01) & (Ks[:, :2, :2].diagonal(dim1=1, dim2=2) > 0.1 * width).all(1)
    usual = Ks[fitted].median(0).values if fitted.any() else torch.tensor(
        [[1.2 * width, 0, width / 2], [0, 1.2 * width, height / 2], [0, 0, 1]]
    )  # fmt: skip
    Ks = torch.where(fitted[:, None, None], Ks, usual)
    sizes = torch.tensor([[width, height]]).repeat(len(names), 1)
    return Cameras(torch.linalg.inv(geometry.poses), Ks, sizes, names)


def depth_maps(depths: Float[Tensor, "v h w"], sure: Bool[Tensor, "v h w"], cameras: Cameras) -> list[DepthMap]:
    """Depth of every pixel; its support is 0 where it is not to be trusted, else 1 and one for each of the nearest
    other views whose trusted depth is the same."""
    far = torch.cdist(centres(cameras.viewmats), centres(cameras.viewmats))
    known = torch.where(sure, depths, torch.zeros_like(depths))
    out = []
    for i in range(len(cameras)):
        _, points = unproject(depths[i], cameras.Ks[i], cameras.viewmats[i])
        support = torch.ones_like(depths[i])
        for j in far[i].argsort()[: MAX_CHECK_VIEWS + 1].tolist():
            if j == i:
                continue
            there, seen = look_up_points(known[j], points, cameras.Ks[j], cameras.viewmats[j])
            z = there @ cameras.viewmats[i][2, :3] + cameras.viewmats[i][2, 3]
            support += seen & ((z - depths[i]).abs() < DEPTH_TOLERANCE * depths[i])
        out.append(DepthMap(depths[i], support * sure[i]))
    return out


def views_at_size(cropped: list[UInt8[Tensor, "_ _ 3"]], cameras: Cameras, side: int) -> Views:
    """The photos' middles, at most `side` wide or high, with the cameras in their pixels."""
    images, Ks = [], []
    for image, K, old in zip(cropped, cameras.Ks, cameras.sizes.tolist(), strict=True):
        height, width = image.shape[:2]
        shrink = min(1.0, side / max(width, height))
        size = round(width * shrink), round(height * shrink)
        images.append(resize_bytes(image, *size) if shrink < 1 else image)
        Ks.append(resize(K, size[0] / old[0], size[1] / old[1]))
    sizes = torch.tensor([[image.shape[1], image.shape[0]] for image in images])
    return Views(tuple(images), Cameras(cameras.viewmats, torch.stack(Ks), sizes, cameras.names))


def upsample(m: DepthMap, size: tuple[int, int]) -> DepthMap:
    """The map at (height, width); support is that of the nearest pixel, so no depth is trusted across an edge."""
    depth = F.interpolate(m.depth[None, None], size, mode="bilinear", align_corners=False)[0, 0]
    return DepthMap(depth, F.interpolate(m.support[None, None], size, mode="nearest-exact")[0, 0])
