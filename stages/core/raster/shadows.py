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
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import C0
from stages.core.scene.gaussians import Gaussians

GAMMA = 2.2  # of the colours; irradiance is linear
MAX_BLOCKED = 0.999  # by one sphere: its logarithm is finite
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
    objects, of = spheres.object_id.unique(return_inverse=True)
    shades = _reached(points, spheres, of, len(objects), light) & (ids[:, None] != objects)
    if points.is_cuda:  # all objects in one pass: what counts is the number of launches
        parts = zip(*(t.split(max(1, GPU_CHUNK // max(len(of), 1))) for t in (points, shades)), strict=True)
        logs = torch.cat([_log_visibility(x, spheres, light, near[:, of]) for x, near in parts])
    else:  # only the points that an object reaches
        logs = points.new_zeros(len(points), 2)
        for i in range(len(objects)):
            own = Spheres(*(getattr(spheres, field.name)[of == i] for field in fields(spheres)))
            for part in shades[:, i].nonzero()[:, 0].split(max(1, CHUNK // len(own.radii))):
                logs[part] += _log_visibility(points[part], own, light)
    return tuple((1 - logs.exp()).unbind(1))


def _reached(points: Tensor, spheres: Spheres, of: Tensor, count: int, light: Light) -> Bool[Tensor, "n o"]:
    """Whether each object blocks a part of the sky or of the lamp that matters."""
    size = torch.zeros(count).to(points).index_add(0, of, torch.ones_like(spheres.radii))
    middle = torch.zeros(count, 3).to(points).index_add(0, of, spheres.centres) / size[:, None]
    R = torch.zeros(count).to(points)
    R = R.scatter_reduce(0, of, (spheres.centres - middle[of]).norm(dim=1) + spheres.radii, "amax")
    x, y, z = (a - b[:, None] for a, b in zip(middle.unbind(1), points.unbind(1), strict=True))
    square = x * x + y * y + z * z
    along = light.direction[0] * x + light.direction[1] * y + light.direction[2] * z
    across = (square - along * along).clamp_min(0).sqrt()
    sky = R * R * (z + R) > MIN_EFFECT * square**1.5
    return sky | ((along > -R) & (across < R + light.spread * (along + R)))


def _log_visibility(points: Tensor, spheres: Spheres, light: Light, counts: Tensor | None = None) -> Tensor:
    """Logarithm of V for the sky and for the lamp (n, 2); `counts` (n, m): which spheres shade which point."""
    c, r = spheres.centres, spheres.radii
    x, y, z = (a - b[:, None] for a, b in zip(c.unbind(1), points.unbind(1), strict=True))
    square = (x * x + y * y + z * z).clamp_min(1e-12)
    sky = (z * square.rsqrt()).clamp_min(0) * (r * r / square).clamp_max(1)
    along = light.direction[0] * x + light.direction[1] * y + light.direction[2] * z
    across = (square - along * along).clamp_min(0).sqrt()
    disc = (light.spread * along).clamp_min(1e-6)  # radius of the lamp, seen at the distance of the sphere
    edge = ((across - (disc - r).abs()) / (2 * torch.minimum(disc, r))).clamp(0, 1)
    lamp = (r / disc).square().clamp_max(1) * (1 - edge * edge * (3 - 2 * edge)) * (along > 0)
    weights = spheres.weights if counts is None else spheres.weights * counts
    return torch.stack([((1 - o.clamp_max(MAX_BLOCKED)).log() * weights).sum(1) for o in (sky, lamp)], 1)


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
