"""Pinhole camera geometry: x right, y down, z forward; pixel centres at +0.5."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def project(
    points: Float[Tensor, "n 3"], viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "n 2"]:
    """Pixel coordinates [px] of world points; only valid where `depths` is positive."""
    p = (points @ viewmat[:3, :3].mT + viewmat[:3, 3]) @ K.mT
    return p[:, :2] / p[:, 2:]


def depths(points: Float[Tensor, "n 3"], viewmat: Float[Tensor, "4 4"]) -> Float[Tensor, "n"]:
    """Distance of world points along the viewing axis; negative behind the camera."""
    return points @ viewmat[2, :3] + viewmat[2, 3]


def centres(viewmats: Float[Tensor, "c 4 4"]) -> Float[Tensor, "c 3"]:
    """Camera centres in the world: -R^T t."""
    return -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]


def look_at(eye: Float[Tensor, "*b 3"], target: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """World-to-camera matrix of a camera at `eye` that looks at `target` without roll (world z up).

    The viewing direction must not be vertical.
    """
    forward = torch.nn.functional.normalize(target - eye, dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0]).to(eye).expand_as(eye)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    R = torch.stack([right, torch.linalg.cross(forward, right), forward], -2)
    viewmat = torch.zeros(*eye.shape[:-1], 4, 4).to(eye)
    viewmat[..., :3, :3] = R
    viewmat[..., :3, 3] = -(R @ eye[..., None])[..., 0]
    viewmat[..., 3, 3] = 1
    return viewmat


def intrinsics(width: int, height: int, focal: float) -> Float[Tensor, "3 3"]:
    """K of a camera with square pixels and the principal point at the image centre; `focal` in pixels."""
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def resize(K: Float[Tensor, "*b 3 3"], sx: float, sy: float) -> Float[Tensor, "*b 3 3"]:
    """K for an image resized by sx across and sy down (exact with pixel centres at +0.5)."""
    return K * torch.tensor([[sx], [sy], [1.0]]).to(K)


def orbit(
    count: int,
    centre: Float[Tensor, "3"],
    radius: float,
    elevation: float,
    azimuth: float = 120.0,
    sweep: float = 360.0,
) -> Float[Tensor, "c 4 4"]:
    """World-to-camera matrices of `count` cameras on a circle about the vertical through `centre`; angles in degrees.

    Azimuth 120 and elevation 20 give the views of GSCollision, whose horizontal axes are
    (1, 1, 0) / sqrt 2 and (1, -1, 0) / sqrt 2.
    """
    az = torch.deg2rad(azimuth + sweep * torch.arange(count) / count)
    el = math.radians(elevation)
    h1, h2 = torch.tensor([[1.0, 1, 0], [1, -1, 0]]) / 2**0.5
    flat = torch.cos(az)[:, None] * h1 + torch.sin(az)[:, None] * h2
    offset = math.cos(el) * flat + math.sin(el) * torch.tensor([0.0, 0, 1])
    eye = centre + radius * offset
    return look_at(eye, centre.expand_as(eye))
