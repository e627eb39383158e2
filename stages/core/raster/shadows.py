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

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import C0
from stages.core.kernels.sphere_shadows import Lamp, Spheres, blocked_light
from stages.core.scene.gaussians import Gaussians

GAMMA = 2.2  # of the colours; irradiance is linear


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
    shade = blocked_light(points, ids, spheres, Lamp(light.direction, light.spread))
    return shade[:, 0], shade[:, 1]


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
