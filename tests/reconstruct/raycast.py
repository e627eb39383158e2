"""Ray-cast photos of a textured table with a block on it, with exact depth and known cameras."""

import json
from pathlib import Path

import torch
import torch.nn.functional as F

from stages.core.geometry.cameras import intrinsics, orbit
from stages.core.scene.cameras import Cameras
from stages.core.scene.images import write_png

BLOCK = (0.25, 0.2, 0.2)  # half sides along x and y, and height; the block is at the origin


def arc(count: int = 6, size: tuple[int, int] = (160, 120), sweep: float = 60.0) -> Cameras:
    """Cameras on an arc around the block, inclined downwards by 35 degrees."""
    viewmats = orbit(count, torch.tensor([0.0, 0.0, 0.05]), 1.6, elevation=35.0, azimuth=200.0, sweep=sweep)
    K = intrinsics(*size, focal=1.2 * size[0])
    names = tuple(f"photo_{i:02d}.png" for i in range(count))
    return Cameras(viewmats, K.expand(count, 3, 3).clone(), torch.tensor(size).expand(count, 2).clone(), names)


def texture(u: torch.Tensor, v: torch.Tensor, seed: int) -> torch.Tensor:
    """Colour (..., 3) at surface coordinates: noise at four scales, so that every image window has texture."""
    generator = torch.Generator().manual_seed(seed)
    colour = 0
    for octave in (16, 48, 96, 160):
        noise = torch.rand(1, 3, octave, octave, generator=generator)
        grid = torch.stack([u, v], -1).reshape(1, -1, 1, 2) / 3
        sample = F.grid_sample(noise, grid, mode="bilinear", padding_mode="reflection", align_corners=False)
        colour = colour + sample[0, :, :, 0].T.reshape(*u.shape, 3)
    return ((colour / 4 - 0.5) * 2.2 + 0.5).clamp(0, 1)


def rays_of(cameras: Cameras, i: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The centre of a camera, and the ray of each pixel (h, w, 3) scaled to depth 1."""
    (width, height), K, viewmat = cameras.sizes[i].tolist(), cameras.Ks[i], cameras.viewmats[i]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1) @ viewmat[:3, :3]
    return -viewmat[:3, :3].T @ viewmat[:3, 3], rays


def photograph(cameras: Cameras, i: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The photo (h, w, 3) and depth (h, w) of one camera."""
    eye, rays = rays_of(cameras, i)
    depth = -eye[2] / rays[..., 2]
    depth = torch.where(depth > 0, depth, torch.full_like(depth, 50.0))
    hit_point = eye + depth[..., None] * rays
    image = texture(hit_point[..., 0], hit_point[..., 1], seed=0)
    a, b, top = BLOCK
    for axis, offset, seed in ((2, top, 1), (0, a, 2), (0, -a, 3), (1, b, 4), (1, -b, 5)):
        t = (offset - eye[axis]) / rays[..., axis]
        p = eye + t[..., None] * rays
        limits = torch.tensor([a, b, top]) + 1e-4
        inside = (p[..., :2].abs() <= limits[:2]).all(-1) & (p[..., 2] >= 0) & (p[..., 2] <= limits[2])
        hit = inside & (t > 0) & (t < depth)
        u, v = (p[hit][:, k] for k in range(3) if k != axis)
        image[hit] = texture(u, v, seed)
        depth = torch.where(hit, t, depth)
    return image, depth


def with_mirror(cameras: Cameras, i: int, position: float = -0.5) -> torch.Tensor:
    """The photo with a vertical mirror at x = `position`, for which the mirrored camera is used too."""
    image, depth = photograph(cameras, i)
    eye, rays = rays_of(cameras, i)
    reflection = torch.diag(torch.tensor([-1.0, 1, 1, 1]))
    reflection[0, 3] = 2 * position
    other, _ = photograph(Cameras(cameras.viewmats @ reflection, cameras.Ks, cameras.sizes, cameras.names), i)
    t = (position - eye[0]) / rays[..., 0]
    _, y, z = (eye + t[..., None] * rays).unbind(-1)
    hit = (t > 0) & (t < depth) & (y.abs() < 0.5) & (z > 0) & (z < 0.6)
    return torch.where(hit[..., None], 0.9 * other, image)


def write_set(folder: Path, cameras: Cameras) -> Path:
    """Write photos to folder/images and their cameras to folder/transforms.json, whose path is returned."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, name in enumerate(cameras.names):
        write_png(folder / "images" / name, photograph(cameras, i)[0])
        c2w = torch.linalg.inv(cameras.viewmats[i].double()) @ torch.diag(torch.tensor([1.0, -1, -1, 1]).double())
        frames.append({"file_path": f"images/{name}", "transform_matrix": c2w.tolist()})
    K, (w, h) = cameras.Ks[0], cameras.sizes[0].tolist()
    lens = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    path = folder / "transforms.json"
    path.write_text(json.dumps({**lens, "w": w, "h": h, "frames": frames}))
    return path
