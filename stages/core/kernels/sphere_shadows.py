"""Fractions of an overhead sky and of a lamp that spheres block at points: one thread per point, over all objects.

See `stages.core.raster.shadows` for the formula and its sources. The spheres of an object have one weight, so that an
object takes two logarithms, of products over its spheres.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.kernels.interop import device_of, kernel_device, launch, view
from stages.core.kernels.splat.simd import even_bounds, launch_ranges, num_threads

wp.set_module_options({"enable_backward": False})

MAX_BLOCKED = 0.999  # by one sphere: its logarithm is finite
MIN_EFFECT = 0.01  # objects that block less of the sky are left out
PIECES = 4  # of the points for each thread on a CPU: objects are near some of them only


class Lamp(NamedTuple):
    """Direction to the lamp, unit, and the tangent of its angular radius."""

    direction: tuple[float, float, float]
    spread: float


@wp.kernel
def _bound(
    centres: wp.array[wp.vec3], radii: wp.array[float], ids: wp.array[wp.int64], middles: wp.array[wp.vec3],
    reaches: wp.array[float], ends: wp.array[int],
):  # fmt: skip
    """At the first sphere of each object: the mean of its centres, how far it extends from there, and one past its last
    sphere."""
    first = wp.tid()
    ends[first] = first
    if first > 0 and ids[first - 1] == ids[first]:
        return
    end = int(first)
    middle = wp.vec3()
    while end < ids.shape[0] and ids[end] == ids[first]:
        middle += centres[end]
        end += 1
    middle /= float(end - first)
    reach = wp.float32(0.0)
    for j in range(first, end):
        reach = wp.max(reach, wp.length(centres[j] - middle) + radii[j])
    middles[first] = middle
    reaches[first] = reach
    ends[first] = end


@wp.kernel
def _block(
    start: int, piece: int, points: wp.array[wp.vec3], own: wp.array[wp.int64], centres: wp.array[wp.vec3],
    radii: wp.array[float], weights: wp.array[float], ids: wp.array[wp.int64], middles: wp.array[wp.vec3],
    reaches: wp.array[float], ends: wp.array[int], direction: wp.vec3, spread: float, out: wp.array2d[float],
):  # fmt: skip
    i = start + wp.tid()
    x = points[i]
    sky_log = wp.float32(0.0)
    lamp_log = wp.float32(0.0)
    first = wp.int32(0)
    while first < ids.shape[0]:
        end = ends[first]
        d = middles[first] - x
        R = reaches[first]
        square = wp.dot(d, d)
        along = wp.dot(direction, d)
        across = wp.sqrt(wp.max(square - along * along, 0.0))
        near = R * R * (d[2] + R) > wp.static(MIN_EFFECT) * square * wp.sqrt(square)
        near = near or (along > -R and across < R + spread * (along + R))
        if near and ids[first] != own[i]:
            sky = wp.float32(1.0)
            lamp = wp.float32(1.0)
            for j in range(first, end):
                c = centres[j] - x
                r = radii[j]
                square = wp.max(wp.dot(c, c), 1.0e-12)
                hidden = wp.max(c[2] / wp.sqrt(square), 0.0) * wp.min(r * r / square, 1.0)
                sky *= 1.0 - wp.min(hidden, wp.static(MAX_BLOCKED))
                along = wp.dot(direction, c)
                if along > 0.0:
                    across = wp.sqrt(wp.max(square - along * along, 0.0))
                    disc = wp.max(spread * along, 1.0e-6)  # radius of the lamp, seen at the distance of the sphere
                    edge = wp.clamp((across - wp.abs(disc - r)) / (2.0 * wp.min(disc, r)), 0.0, 1.0)
                    hidden = wp.min(r * r / (disc * disc), 1.0) * (1.0 - edge * edge * (3.0 - 2.0 * edge))
                    lamp *= 1.0 - wp.min(hidden, wp.static(MAX_BLOCKED))
                if j + 1 == end or wp.min(sky, lamp) < 1.0e-30:  # before the products vanish
                    sky_log += weights[first] * wp.log(sky)
                    lamp_log += weights[first] * wp.log(lamp)
                    sky = 1.0
                    lamp = 1.0
        first = end
    out[i, 0] = 1.0 - wp.exp(sky_log)
    out[i, 1] = 1.0 - wp.exp(lamp_log)


def blocked_light(
    points: Float[Tensor, "n 3"], own: Int[Tensor, "n"], centres: Float[Tensor, "m 3"], radii: Float[Tensor, "m"],
    weights: Float[Tensor, "m"], ids: Int[Tensor, "m"], lamp: Lamp,
) -> Float[Tensor, "n 2"]:  # fmt: skip
    """Fractions of the sky and of the lamp that the spheres block at points.

    `ids` are the objects of the spheres, those of an object next to each other and of one weight; they do not shade
    points of their `own` object.
    """
    where = kernel_device(points)
    if where != points.device:
        given = (t.to(where) for t in (points, own, centres, radii, weights, ids))
        return blocked_light(*given, lamp).to(points.device)
    device, m = device_of(points), len(radii)
    middles, reaches = torch.empty_like(centres), torch.empty_like(radii)
    ends, out = torch.empty(m, dtype=torch.int32, device=points.device), points.new_empty(len(points), 2)
    spheres = [view(centres.contiguous(), wp.vec3), view(radii.contiguous()), view(ids.contiguous())]
    bounds = [view(middles, wp.vec3), view(reaches), view(ends)]
    launch(_bound, m, spheres, bounds, device)
    inputs = [view(points.contiguous(), wp.vec3), view(own.contiguous()), *spheres[:2], view(weights.contiguous()),
              spheres[2], *bounds, wp.vec3(*lamp.direction), lamp.spread, view(out)]  # fmt: skip
    if device != "cpu":
        launch(_block, len(points), [0, 0, *inputs], device=device)
    else:
        launch_ranges(_block, even_bounds(len(points), PIECES * num_threads()), inputs)
    return out


def blocked_light_reference(
    points: Float[Tensor, "n 3"], own: Int[Tensor, "n"], centres: Float[Tensor, "m 3"], radii: Float[Tensor, "m"],
    weights: Float[Tensor, "m"], ids: Int[Tensor, "m"], lamp: Lamp,
) -> Float[Tensor, "n 2"]:  # fmt: skip
    """`blocked_light` in PyTorch, in any precision."""
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
