"""Soft shadows that moved objects cast on Gaussians: a factor for the colour of each Gaussian.

Objects are sets of spheres. At a point x the irradiance, relative to that without any object, is

    E = 1 - sky (1 - V_sky) - lamp (1 - V_lamp),    V = prod over spheres (1 - o_i)^w,

where o_i is the fraction that a sphere of radius r at distance d blocks: of a cosine-weighted overhead sky
cos(theta) r^2/d^2 (Quilez, "Sphere ambient occlusion"), of a lamp the overlap of two discs (Oat and Sander 2007,
"Ambient aperture lighting"). Visibilities multiply as in Ren et al. 2006, "Real-time soft shadows in dynamic scenes
using spherical harmonic exponentiation"; w, the projected area of an object over the sum of those of its spheres, makes
overlapping spheres count once from afar.

The colours of a photographed scene hold the shadows of the rest frame already, so they are multiplied by E now over
E at rest (in linear light). web/shaders.js of the player computes the same.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import C0
from stages.core.scene.gaussians import Gaussians

GAMMA = 2.2  # of the colours; irradiance is linear
MAX_BLOCKED = 0.999  # by one sphere; the product over those of an object is no denormal number
MIN_EFFECT = 0.01  # objects that block less of the sky are left out
CHUNK = 2**15  # pairs of a Gaussian and a sphere at a time on a CPU: they fit into the cache
GPU_CHUNK = 2**24  # on a GPU, where each chunk is some twenty launches


@dataclass(frozen=True)
class Light:
    """An overhead sky and a lamp, with their shares of the irradiance of a level surface."""

    sky: float
    lamp: float
    direction: tuple[float, float, float]  # to the lamp, unit
    spread: float  # tangent of the lamp's angular radius
    in_colours: bool  # whether the colours hold the shadows of the rest frame, which can then be lifted
    beneath: float = 1.0  # irradiance of which the colours beneath objects are: no photo shows them


OVERHEAD = Light(0.5, 0.3, (0.0, 0.0, 1.0), 0.6, in_colours=False)  # where the photos show no shadows


@dataclass(frozen=True)
class Spheres:
    """Spheres of the objects, those of an object next to each other."""

    centres: Float[Tensor, "m 3"]
    radii: Float[Tensor, "m"]
    weights: Float[Tensor, "m"]  # w, the same for all spheres of an object
    object_id: Int[Tensor, "m"]

    def to(self, device: torch.device | str) -> Spheres:
        """The spheres on a device."""
        return Spheres(*(getattr(self, field.name).to(device) for field in fields(self)))


def irradiance(
    points: Float[Tensor, "n 3"], ids: Int[Tensor, "n"], spheres: Spheres, light: Light
) -> Float[Tensor, "n"]:
    """E at points of objects `ids`, which the spheres of their own object do not shade; 1 where nothing is near."""
    sky, lamp = blocked(points, ids, spheres, light)
    return 1 - light.sky * sky - light.lamp * lamp


def blocked(
    points: Float[Tensor, "n 3"], ids: Int[Tensor, "n"], spheres: Spheres, light: Light
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """The fractions 1 - V of the sky and of the lamp that the spheres block at points of objects `ids`."""
    logs, pairs = points.new_zeros(len(points), 2), GPU_CHUNK if points.is_cuda else CHUNK
    for id in spheres.object_id.unique().tolist():
        own = spheres.object_id == id
        c, r, w = spheres.centres[own], spheres.radii[own], float(spheres.weights[own][0])
        rows = (_reached(points, c, r, light) & (ids != id)).nonzero()[:, 0]
        for part in rows.split(max(1, pairs // len(c))):
            logs[part] += w * _visibility(points[part], c, r, light).log()
    return tuple((1 - logs.exp()).unbind(1))


def _reached(points: Tensor, c: Tensor, r: Tensor, light: Light) -> Tensor:
    """Whether an object of spheres (c, r) blocks a part of the sky or of the lamp that matters."""
    middle = c.mean(0)
    R = float(((c - middle).norm(dim=1) + r).max())
    v = middle - points
    d = v.norm(dim=1)
    along = v @ v.new_tensor(light.direction)
    across = (d * d - along * along).clamp_min(0).sqrt()
    sky = R * R * (v[:, 2] + R) > MIN_EFFECT * d**3
    return sky | ((along > -R) & (across < R + light.spread * (along + R)))


def _visibility(points: Tensor, c: Tensor, r: Tensor, light: Light) -> Tensor:
    """Product over spheres of 1 - o, for the sky and for the lamp (n, 2)."""
    x, y, z = (a - b[:, None] for a, b in zip(c.unbind(1), points.unbind(1), strict=True))
    square = (x * x + y * y + z * z).clamp_min(1e-12)
    sky = (z * square.rsqrt()).clamp_min(0) * (r * r / square).clamp_max(1)
    along = light.direction[0] * x + light.direction[1] * y + light.direction[2] * z
    across = (square - along * along).clamp_min(0).sqrt()
    disc = (light.spread * along).clamp_min(1e-6)  # radius of the lamp, seen at the distance of the sphere
    edge = ((across - (disc - r).abs()) / (2 * torch.minimum(disc, r))).clamp(0, 1)
    lamp = (r / disc).square().clamp_max(1) * (1 - edge * edge * (3 - 2 * edge)) * (along > 0)
    return torch.stack([(1 - o.clamp_max(MAX_BLOCKED)).prod(1) for o in (sky, lamp)], 1)


def shadow_factor(now: Float[Tensor, "n"], rest: Float[Tensor, "n"], light: Light) -> Float[Tensor, "n"]:
    """Factor of colours of which the irradiance was `rest` in the photos and is `now`; 1 where it is unchanged.

    It is above 1 where a shadow in the colours is lifted: beneath objects only as far as their colours are dark.
    """
    held = torch.maximum(rest, now.clamp_max(light.beneath))
    return (now / torch.where(now < rest, rest, held)) ** (1 / GAMMA)


def shaded(g: Gaussians, factor: Float[Tensor, "n"]) -> Gaussians:
    """The Gaussians with their colours multiplied by a factor."""
    sh = factor[:, None, None] * g.sh
    sh[:, 0] += (0.5 / C0 * (factor - 1))[:, None]
    return replace(g, sh=sh)
