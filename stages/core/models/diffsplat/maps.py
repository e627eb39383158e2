"""The four cameras of DiffSplat, their rays as network inputs, and the output maps of Gaussians.

DiffSplat's frame: y up, the object at the origin within [-1, 1], the first camera on the side of +z.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import centres
from stages.core.geometry.harmonics import rgb_to_sh
from stages.core.scene.gaussians import Gaussians

AZIMUTHS = (0.0, 90.0, 180.0, 270.0)  # azimuths of the cameras, from +z towards +x [degrees]
RADIUS = 1.4  # distance of the cameras from the origin
FOCAL = 1422.222 / 1024  # focal length of the cameras in G-Objaverse, the training data [image sides]
SCALES = (0.0005, 0.02)  # minimum and maximum standard deviation of Gaussians
CHANNELS = 12  # channels of a map: rgb 3, scale 3, rotation w x y z, opacity, depth; all in -1..1


def cameras(elevation: float) -> Float[Tensor, "4 4 4"]:
    """World-to-camera matrices (x right, y down, z forward) of the four views at `elevation` degrees above horizon."""
    up, tilt = torch.tensor([0.0, 1.0, 0.0]), math.radians(elevation)
    viewmats = torch.eye(4).repeat(len(AZIMUTHS), 1, 1)
    for viewmat, azimuth in zip(viewmats, map(math.radians, AZIMUTHS), strict=True):
        flat = torch.tensor([math.sin(azimuth), 0.0, math.cos(azimuth)])
        forward = -(math.cos(tilt) * flat + math.sin(tilt) * up)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
        viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
        viewmat[2, 3] = RADIUS  # the origin lies straight ahead
    return viewmats


def plucker(viewmats: Float[Tensor, "v 4 4"], side: int) -> Float[Tensor, "v 6 s s"]:
    """Pluecker coordinates (o x d, d) of each pixel's ray, with the offset of the published training code.

    That code adds the half-pixel offset after dividing by the side, so the rays cover only the quarter of the image
    plane to the right of and below its centre. The weights were trained with this offset.
    """
    across = torch.arange(side) / (side - 1) / FOCAL
    y, x = torch.meshgrid(across, across, indexing="ij")
    d = torch.stack([x, y, torch.ones_like(x)], -1) @ viewmats[:, None, :3, :3]  # row vectors times R: camera to world
    d = torch.nn.functional.normalize(d, dim=-1)
    o = centres(viewmats)[:, None, None].expand_as(d)
    return torch.cat([torch.linalg.cross(o, d), d], -1).permute(0, 3, 1, 2)


def to_gaussians(maps: Float[Tensor, "v 12 s s"], viewmats: Float[Tensor, "v 4 4"]) -> Gaussians:
    """Convert maps to one Gaussian per pixel in DiffSplat's frame, without those of zero opacity or zero quaternion.

    Depth is along the viewing axis, relative to the camera distance; corner pixels lie on the image corners. The
    published renderer uses unnormalised quaternions; here they are normalised, as everywhere in a scene.
    Source: the Gaussian renderer and the unprojection of depth in the public code.
    """
    rgb, scale, quats, opacity, depth = (m.permute(0, 2, 3, 1) for m in maps.split([3, 3, 4, 1, 1], 1))
    across = (torch.arange(maps.shape[-1]) / (maps.shape[-1] - 1) - 0.5).to(maps) / FOCAL
    y, x = torch.meshgrid(across, across, indexing="ij")
    eyes = centres(viewmats)[:, None, None]
    z = depth + eyes.norm(dim=-1, keepdim=True)
    means = torch.stack([x, y, torch.ones_like(x)], -1) * z @ viewmats[:, None, :3, :3] + eyes
    fraction = scale / 2 + 0.5
    opacities = (opacity / 2 + 0.5).flatten()
    kept = (opacities > 0) & (quats.norm(dim=-1).flatten() > 1e-6)
    fields = means, torch.nn.functional.normalize(quats, dim=-1), SCALES[0] * fraction + SCALES[1] * (1 - fraction), rgb
    means, quats, scales, rgb = (f.flatten(0, 2)[kept] for f in fields)
    return Gaussians(means, quats, scales, opacities[kept], rgb_to_sh(rgb / 2 + 0.5),
                     torch.ones(len(means), dtype=torch.int64))  # fmt: skip
