"""Output of a perfect network for ray-cast photos: true point maps, poses and Gaussians."""

import torch

from stages.core.models.pi3.network import Geometry
from stages.core.models.pi3.splat import CHANNELS
from stages.core.scene.cameras import Cameras
from stages.core.scene.images import to_bytes
from stages.reconstruct import network_input
from stages.reconstruct.depth import unproject
from stages.reconstruct.photos import Photos
from tests.reconstruct.raycast import photograph

C0 = 0.28209479177387814


def photos_of(cameras: Cameras, folder) -> Photos:
    """Ray-cast photos by these cameras."""
    images = tuple(torch.from_numpy(to_bytes(photograph(cameras, i)[0])) for i in range(len(cameras)))
    return Photos(images, cameras.names, (0.0,) * len(cameras), folder)


def truth(cameras: Cameras, scale: float, seed: int = 0) -> Geometry:
    """True point maps and poses, randomly rotated, shifted, and scaled by `scale`."""
    R = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed)))[0]
    R = R * torch.linalg.det(R)
    points, poses = [], []
    for i in range(len(cameras)):
        _, depth = photograph(cameras, i)
        _, local = unproject(depth, cameras.Ks[i], torch.eye(4))
        pose = torch.linalg.inv(cameras.viewmats[i])
        moved = torch.eye(4)
        moved[:3, :3] = R @ pose[:3, :3]
        moved[:3, 3] = scale * R @ pose[:3, 3] + 1.0
        points.append(scale * local)
        poses.append(moved)
    points = torch.stack(points)
    return Geometry(points, torch.full(points.shape[:3], 0.9), torch.stack(poses))


def true_splats(photos: Photos, size: tuple[int, int], geometry: Geometry, focal: float) -> torch.Tensor:
    """Raw parameters of nearly opaque Gaussians with the size and colour of a pixel."""
    images = network_input.make_batch(list(photos.images), size).permute(0, 2, 3, 1)
    raw = torch.zeros(*images.shape[:3], CHANNELS)
    raw[..., 0] = 4.0
    wanted = 0.7 * geometry.points[..., 2] / focal / 0.001  # output of the softplus
    raw[..., 1:4] = torch.where(wanted > 20, wanted, wanted.expm1().clamp_min(1e-6).log())[..., None]
    raw[..., 7] = 1.0
    raw[..., 8::9] = (images - 0.5) / C0
    return raw
