"""Rest shapes: quantities in the body frame that are computed once per rollout, without parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import threshold_

from stages.core.kernels.compilers import TRITON
from stages.core.kernels.field.normals import invert_spd, normals_and_spacing
from stages.core.models.initial_conditions import InitialConditions, inertia, offsets

if TRITON:
    from stages.core.kernels.field.neighbourhoods import neighbourhood_weights

NEIGHBOURHOOD_RADII = (0.12, 0.4)  # radii of Gaussian neighbourhoods [radii of gyration]; hand-chosen, no source
MIN_NEIGHBOUR_WEIGHT = 1e-20  # smaller weights are set to 0: subnormal numbers make a CPU several times slower
MIN_EXPONENT = math.log(MIN_NEIGHBOUR_WEIGHT) - 1  # lower limit of exponents, so that exp returns no subnormal numbers


@dataclass(frozen=True)
class RestShape:
    """Rest shapes of all objects of a batch of scenes."""

    initial: InitialConditions
    arm: Float[Tensor, "b o n 3"]  # keypoints relative to the centre of mass [m]
    normal: Float[Tensor, "b o n 3"]  # outward, of length up to 1; shorter where the outward side is uncertain
    spacing: Float[Tensor, "b o n"]  # distance to the nearest keypoints [m]
    size: Float[Tensor, "b o"]  # radius of gyration [m]
    inverse: Float[Tensor, "b o 3 3"]  # inverse of the body's inertia tensor per unit of mass, at rest [1/m^2]
    keypoint_inverse: Float[Tensor, "b o 3 3"]  # the same for the keypoints as point masses, a hollow body [1/m^2]
    principal: Float[Tensor, "b o 3"]  # eigenvalues of `keypoint_inverse`, ascending [1/m^2]
    blur: Float[Tensor, "b o s n n"]  # averaging weights of the neighbourhoods, rows sum to 1; 16-bit for the kernels
    others: Int[Tensor, "o m"]  # for each object the indices of its partners: the m = o - 1 others, or those near it
    back: Int[Tensor, "o m"]  # others[others[i, k], back[i, k]] is i

    def __getitem__(self, rows: slice | Tensor) -> RestShape:
        """The scenes `rows`, still a batch."""
        batched = ("initial", "arm", "normal", "spacing", "size", "inverse", "keypoint_inverse", "principal", "blur")
        return replace(self, **{name: getattr(self, name)[rows] for name in batched})

    def with_near_others(self, points: Float[Tensor, "b o n 3"], reach: float) -> RestShape:
        """Return a copy in which an object's partners are those with bounding boxes within `reach` [m] in any scene.

        `others` is padded with the object itself, which it never touches, if another object has more partners.
        """
        valid = self.initial.valid[..., None]
        low = points.masked_fill(~valid, torch.inf).amin(2)
        high = points.masked_fill(~valid, -torch.inf).amax(2)
        near = (low[:, :, None] < high[:, None] + reach).all(-1)
        near = (near & near.mT).any(0).fill_diagonal_(False)
        if (count := int(near.sum(1).max())) >= self.others.shape[1]:
            return self
        row = torch.arange(len(near), device=near.device)[:, None]
        column = torch.arange(count, device=near.device)
        real = column < near.sum(1, keepdim=True)
        first = (~near).int().argsort(dim=1, stable=True)[:, :count]  # near objects, in ascending order
        rank = near.cumsum(1) - 1  # position of each partner in the list of an object
        others = torch.where(real, first, row)
        return replace(self, others=others, back=torch.where(real, rank[others, row], column))


@torch.no_grad()
def rest_shape_of(initial: InitialConditions, half: bool = False) -> RestShape:
    """Compute the rest shapes of a batch.

    With `half` the neighbourhood weights are in half precision and computed by a Triton kernel.
    """
    arm = offsets(initial, initial.points)
    size = (initial.mass_fraction * arm.square().sum(-1)).sum(-1).clamp_min(1e-8).sqrt()
    normal, spacing = normals_and_spacing(arm, initial.valid)
    side = (normal * arm).sum(-1) / (0.1 * size[..., None])
    normal = normal * side.tanh()[..., None]  # flipped to point away from the centre of mass
    keypoint_inverse, principal = invert_spd(inertia(initial.mass_fraction.double(), arm.double()))
    inverse, _ = invert_spd(initial.body_inertia.double())
    radii = torch.stack([factor * size for factor in NEIGHBOURHOOD_RADII], -1)
    blur = neighbourhood_weights if half else _neighbourhoods
    others, back = _others(initial.valid.shape[1], arm.device)
    blurred = blur(arm, initial.valid, initial.mass_fraction, radii)
    inverses = inverse.to(arm), keypoint_inverse.to(arm)
    return RestShape(initial, arm, normal, spacing, size, *inverses, principal.to(arm), blurred, others, back)


def _neighbourhoods(
    arm: Float[Tensor, "b o n 3"], valid: Bool[Tensor, "b o n"], mass_fraction: Float[Tensor, "b o n"],
    radii: Float[Tensor, "b o s"],
) -> Float[Tensor, "b o s n n"]:  # fmt: skip
    """Mass-weighted Gaussian weights about each point for each of the `radii` [m]; rows sum to 1, or 0 where padded.

    Summing squared differences is accurate for near points, and was measured 50 times faster than cdist on a GPU.
    """
    squared = arm.new_zeros(*valid.shape, valid.shape[-1])
    for c in arm.unbind(-1):
        gap = c[..., :, None] - c[..., None, :]
        squared.addcmul_(gap, gap)
    exponent = (squared[:, :, None] * (-1 / radii.square())[..., None, None]).clamp_min_(MIN_EXPONENT)
    weight = threshold_(exponent.exp_(), MIN_NEIGHBOUR_WEIGHT, 0.0).mul_(mass_fraction[:, :, None, None])
    return weight.mul_(valid[:, :, None, :, None] / weight.sum(-1, keepdim=True).clamp_min_(1e-12))


def _others(count: int, device: torch.device) -> tuple[Int[Tensor, "o m"], Int[Tensor, "o m"]]:
    """Fields `others` and `back` of RestShape."""
    row = torch.arange(count, device=device)[:, None]
    column = torch.arange(max(count - 1, 0), device=device)[None]
    others = column + (column >= row)
    return others, (row - (row > others).long()).expand_as(others)
