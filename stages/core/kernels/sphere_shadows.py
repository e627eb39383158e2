"""Fractions of an overhead sky and of a lamp that spheres block at points, one thread per point.

See `stages.core.raster.shadows` for the formula and its sources. All spheres of an object have the same weight, so
each object takes only two logarithms, of the products over its spheres.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.kernels.interop import device_of, empty_arrays, kernel_device, launch, view, with_arrays
from stages.core.kernels.simd import even_bounds, launch_ranges, num_threads

wp.set_module_options({"enable_backward": False})

MAX_BLOCKED = 0.999  # largest fraction that one sphere blocks, so that the logarithm of the rest is finite
MIN_EFFECT = 0.01  # objects that block less than this fraction of the sky, and none of the lamp, are skipped
PIECES = 4  # parts of the points per CPU thread, to balance the load: objects are near only some of the points


class Lamp(NamedTuple):
    """Direction to the lamp, unit, and the tangent of its angular radius."""

    direction: tuple[float, float, float]
    spread: float


@dataclass(frozen=True)
class Spheres:
    """Spheres of all objects; the spheres of each object are contiguous."""

    centres: Float[Tensor, "m 3"]
    radii: Float[Tensor, "m"]
    weights: Float[Tensor, "m"]  # exponent w of a sphere's visibility, equal for all spheres of an object
    object_id: Int[Tensor, "m"]

    def to(self, device: torch.device | str) -> Spheres:
        """Return a copy on a device."""
        return Spheres(*(getattr(self, field.name).to(device) for field in fields(self)))


@wp.struct
class ShadedPoints:
    """Shaded points, and the object that each belongs to and is not shaded by."""

    at: wp.array[wp.vec3]
    own: wp.array[wp.int64]


@wp.struct
class SphereArrays:
    """Spheres for kernels. The bounds of an object are stored at the index of its first sphere."""

    centres: wp.array[wp.vec3]
    radii: wp.array[float]
    weights: wp.array[float]
    object_id: wp.array[wp.int64]
    middles: wp.array[wp.vec3]  # centre of the object's bounding sphere: the mean of its sphere centres
    reaches: wp.array[float]  # radius of the object's bounding sphere
    ends: wp.array[int]  # index one past the object's last sphere


@wp.struct
class LampDisc:
    """Lamp for kernels."""

    direction: wp.vec3
    spread: float


@wp.kernel
def _bound(spheres: SphereArrays):
    """Compute the bounding sphere of each object, in the thread of its first sphere."""
    first = wp.tid()
    spheres.ends[first] = first
    if first > 0 and spheres.object_id[first - 1] == spheres.object_id[first]:
        return
    end = int(first)
    middle = wp.vec3()
    while end < spheres.object_id.shape[0] and spheres.object_id[end] == spheres.object_id[first]:
        middle += spheres.centres[end]
        end += 1
    middle /= float(end - first)
    reach = wp.float32(0.0)
    for j in range(first, end):
        reach = wp.max(reach, wp.length(spheres.centres[j] - middle) + spheres.radii[j])
    spheres.middles[first] = middle
    spheres.reaches[first] = reach
    spheres.ends[first] = end


@wp.kernel
def _block(
    start: int, piece: int, points: ShadedPoints, spheres: SphereArrays, lamp: LampDisc, out: wp.array2d[float]
):  # fmt: skip
    i = start + wp.tid()
    x = points.at[i]
    sky_log = wp.float32(0.0)
    lamp_log = wp.float32(0.0)
    first = wp.int32(0)
    while first < spheres.object_id.shape[0]:
        end = spheres.ends[first]
        d = spheres.middles[first] - x
        R = spheres.reaches[first]
        square = wp.dot(d, d)
        along = wp.dot(lamp.direction, d)
        across = wp.sqrt(wp.max(square - along * along, 0.0))
        near = R * R * (d[2] + R) > wp.static(MIN_EFFECT) * square * wp.sqrt(square)
        near = near or (along > -R and across < R + lamp.spread * (along + R))
        if near and spheres.object_id[first] != points.own[i]:
            past_sky = wp.float32(1.0)
            past_lamp = wp.float32(1.0)
            for j in range(first, end):
                c = spheres.centres[j] - x
                r = spheres.radii[j]
                square = wp.max(wp.dot(c, c), 1.0e-12)
                hidden = wp.max(c[2] / wp.sqrt(square), 0.0) * wp.min(r * r / square, 1.0)
                past_sky *= 1.0 - wp.min(hidden, wp.static(MAX_BLOCKED))
                along = wp.dot(lamp.direction, c)
                if along > 0.0:
                    across = wp.sqrt(wp.max(square - along * along, 0.0))
                    disc = wp.max(lamp.spread * along, 1.0e-6)  # radius of the lamp's cone at the sphere's distance
                    edge = wp.clamp((across - wp.abs(disc - r)) / (2.0 * wp.min(disc, r)), 0.0, 1.0)
                    hidden = wp.min(r * r / (disc * disc), 1.0) * (1.0 - edge * edge * (3.0 - 2.0 * edge))
                    past_lamp *= 1.0 - wp.min(hidden, wp.static(MAX_BLOCKED))
                if j + 1 == end or wp.min(past_sky, past_lamp) < 1.0e-30:  # before the products underflow
                    sky_log += spheres.weights[first] * wp.log(past_sky)
                    lamp_log += spheres.weights[first] * wp.log(past_lamp)
                    past_sky = 1.0
                    past_lamp = 1.0
        first = end
    out[i, 0] = 1.0 - wp.exp(sky_log)
    out[i, 1] = 1.0 - wp.exp(lamp_log)


def blocked_light(
    points: Float[Tensor, "n 3"], own: Int[Tensor, "n"], spheres: Spheres, lamp: Lamp
) -> Float[Tensor, "n 2"]:  # fmt: skip
    """Return the fractions of the sky and of the lamp that the spheres block at each point.

    `own` is the object that each point belongs to; the spheres of an object do not shade its own points.
    """
    where = kernel_device(points)
    if where != points.device:
        return blocked_light(points.to(where), own.to(where), spheres.to(where), lamp).to(points.device)
    device, m, out = device_of(points), len(spheres.radii), points.new_empty(len(points), 2)
    shading = empty_arrays(SphereArrays, device, (m,), centres=None, radii=None, weights=None, object_id=None)
    with_arrays(shading, {name: getattr(spheres, name) for name in ("centres", "radii", "weights")})
    shading.object_id = view(spheres.object_id.contiguous())
    shaded, disc = ShadedPoints(), LampDisc()
    shaded.at, shaded.own = view(points.contiguous(), wp.vec3), view(own.contiguous())
    disc.direction, disc.spread = wp.vec3(*lamp.direction), lamp.spread
    launch(_bound, m, [shading], device=device)
    inputs = [shaded, shading, disc, view(out)]
    if device != "cpu":
        launch(_block, len(points), [0, 0, *inputs], device=device)
    else:
        launch_ranges(_block, even_bounds(len(points), PIECES * num_threads()), inputs)
    return out


def blocked_light_reference(
    points: Float[Tensor, "n 3"], own: Int[Tensor, "n"], spheres: Spheres, lamp: Lamp
) -> Float[Tensor, "n 2"]:  # fmt: skip
    """`blocked_light` in PyTorch, in any precision."""
    centres, radii, weights, ids = spheres.centres, spheres.radii, spheres.weights, spheres.object_id
    objects, of = ids.unique(return_inverse=True)
    light = torch.tensor(lamp.direction).to(points)
    middle = torch.stack([centres[of == k].mean(0) for k in range(len(objects))])
    R = torch.stack([((centres - middle[k]).norm(dim=1) + radii)[of == k].max() for k in range(len(objects))])
    d = middle - points[:, None]
    square, along = d.square().sum(2), d @ light
    across = (square - along.square()).clamp_min(0).sqrt()
    near = R * R * (d[..., 2] + R) > MIN_EFFECT * square**1.5
    near |= (along > -R) & (across < R + lamp.spread * (along + R))
    counts = (near & (own[:, None] != objects))[:, of]
    c = centres - points[:, None]
    square, along = c.square().sum(2).clamp_min(1e-12), c @ light
    sky = (c[..., 2] / square.sqrt()).clamp_min(0) * (radii**2 / square).clamp_max(1)
    across = (square - along.square()).clamp_min(0).sqrt()
    disc = (lamp.spread * along).clamp_min(1e-6)
    edge = ((across - (disc - radii).abs()) / (2 * torch.minimum(disc, radii))).clamp(0, 1)
    shaded = (radii / disc).square().clamp_max(1) * (1 - edge * edge * (3 - 2 * edge)) * (along > 0)
    logs = [((1 - part.clamp_max(MAX_BLOCKED)).log() * weights * counts).sum(1) for part in (sky, shaded)]
    return 1 - torch.stack(logs, 1).exp()
