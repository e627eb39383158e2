"""Soft shadows that moved objects cast on Gaussians: a factor for the colour of each Gaussian.

Objects are approximated by spheres. At a point x the irradiance, relative to that without any object, is

    E = 1 - sky (1 - V_sky) - lamp (1 - V_lamp),    V = prod over spheres (1 - o_i)^w,

where o_i is the fraction that a sphere of radius r at distance d blocks: cos(theta) r^2/d^2 of a cosine-weighted
overhead sky (Quilez, "Sphere ambient occlusion"), and the overlap of two discs for a lamp (Oat and Sander 2007,
"Ambient aperture lighting"). Visibilities multiply as in Ren et al. 2006, "Real-time soft shadows in dynamic scenes
using spherical harmonic exponentiation". The exponent w is the projected area of an object over the sum of the
projected areas of its spheres, so that from afar overlapping spheres are not counted twice.

The colours of a photographed scene already contain the shadows of the rest frame, so they are multiplied by the ratio
of E now to E at rest (in linear light). web/shaders.js of the player computes the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import C0
from stages.core.kernels.sphere_shadows import Lamp, Spheres, blocked_light
from stages.core.scene.gaussians import Gaussians

GAMMA = 2.2  # exponent from colours to linear light


@dataclass(frozen=True)
class Light:
    """An overhead sky and a lamp."""

    sky: float  # fraction of the irradiance of a level surface
    lamp: float  # fraction of the irradiance of a level surface
    direction: tuple[float, float, float]  # to the lamp, unit
    spread: float  # tangent of the lamp's angular radius
    in_colours: bool  # whether the colours contain the shadows of the rest frame, which can then be removed
    beneath: float = 1.0  # irradiance to which the colours beneath objects correspond; no photo shows these places


OVERHEAD = Light(0.5, 0.3, (0.0, 0.0, 1.0), 0.6, in_colours=False)  # default if the photos show no shadows


def irradiance(
    points: Float[Tensor, "n 3"], ids: Int[Tensor, "n"], spheres: Spheres, light: Light
) -> Float[Tensor, "n"]:
    """E at points of the objects `ids`; the spheres of its own object do not shade a point. 1 if nothing is near."""
    sky, lamp = blocked(points, ids, spheres, light)
    return 1 - light.sky * sky - light.lamp * lamp


def blocked(
    points: Float[Tensor, "n 3"], ids: Int[Tensor, "n"], spheres: Spheres, light: Light
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """The fractions 1 - V of the sky and of the lamp that the spheres block at points of the objects `ids`."""
    shade = blocked_light(points, ids, spheres, Lamp(light.direction, light.spread))
    return shade[:, 0], shade[:, 1]


def shadow_factor(now: Float[Tensor, "n"], rest: Float[Tensor, "n"], light: Light) -> Float[Tensor, "n"]:
    """Factor for colours whose irradiance was `rest` in the photos and is `now`; 1 if it is unchanged.

    It is above 1 where a shadow in the colours is removed; beneath objects only as far as the colours there are dark.
    """
    held = torch.maximum(rest, now.clamp_max(light.beneath))
    return (now / torch.where(now < rest, rest, held)) ** (1 / GAMMA)


def shaded(g: Gaussians, factor: Float[Tensor, "n"]) -> Gaussians:
    """The Gaussians with their colours multiplied by a factor."""
    sh = factor[:, None, None] * g.sh
    sh[:, 0] += (0.5 / C0 * (factor - 1))[:, None]
    return replace(g, sh=sh)
