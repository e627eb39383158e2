"""What can be known of objects before they move: surfaces, inertia, neighbourhoods. All of it turns with them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.kernels.compilers import TRITON
from stages.core.kernels.field.normals import invert_spd, normals_and_spacing
from stages.core.models.initial_conditions import InitialConditions, inertia, offsets

if TRITON:
    from stages.core.kernels.field.neighbourhoods import neighbourhood_weights

NEIGHBOURHOOD_RADII = (0.12, 0.4)  # radii of neighbourhoods, in sizes of the object
MIN_NEIGHBOUR_WEIGHT = 1e-20  # weights in them that are 0: subnormal numbers take a CPU several times as long


@dataclass(frozen=True)
class RestShape:
    """The objects of a world at rest."""

    initial: InitialConditions
    arm: Float[Tensor, "b o n 3"]  # keypoints about the centre of mass [m]
    normal: Float[Tensor, "b o n 3"]  # outwards, at most of length 1; short where out and in are not to be told apart
    spacing: Float[Tensor, "b o n"]  # distance to the nearest keypoints [m]
    size: Float[Tensor, "b o"]  # radius of gyration [m]
    inverse: Float[Tensor, "b o 3 3"]  # of the inertia tensor per unit of mass [1/m^2]
    principal: Float[Tensor, "b o 3"]  # eigenvalues of `inverse`, ascending [1/m^2]
    blur: Float[Tensor, "b o s n n"]  # weights that average over the neighbourhoods of BLUR; perhaps 16-bit
    others: Int[Tensor, "o m"]  # for each object the rows of the others
    back: Int[Tensor, "o m"]  # others[others[i, k], back[i, k]] is i

    def __getitem__(self, rows: slice | Tensor) -> RestShape:
        """Some of the scenes, still a batch."""
        each = ("initial", "arm", "normal", "spacing", "size", "inverse", "principal", "blur")
        return replace(self, **{name: getattr(self, name)[rows] for name in each})


@torch.no_grad()
def rest_shape_of(initial: InitialConditions, half: bool = False) -> RestShape:
    """Everything about the rest shape; with `half` the neighbourhoods in half precision, which takes Triton."""
    arm = offsets(initial, initial.points)
    size = (initial.mass_fraction * arm.square().sum(-1)).sum(-1).clamp_min(1e-8).sqrt()
    normal, spacing = normals_and_spacing(arm, initial.valid)
    side = (normal * arm).sum(-1) / (0.1 * size[..., None])
    normal = normal * side.tanh()[..., None]  # outwards
    inverse, principal = invert_spd(inertia(initial.mass_fraction.double(), arm.double()))
    reach = torch.stack([radius * size for radius in NEIGHBOURHOOD_RADII], -1)
    blur = neighbourhood_weights if half else _neighbourhoods
    others, back = _others(initial.valid.shape[1], arm.device)
    blurred = blur(arm, initial.valid, initial.mass_fraction, reach)
    return RestShape(initial, arm, normal, spacing, size, inverse.to(arm), principal.to(arm), blurred, others, back)


def _neighbourhoods(
    arm: Float[Tensor, "b o n 3"], valid: Bool[Tensor, "b o n"], mass_fraction: Float[Tensor, "b o n"],
    reach: Float[Tensor, "b o s"],
) -> Float[Tensor, "b o s n n"]:  # fmt: skip
    """Gaussians of each radius [m] about each point, normalised by rows; 0 where padded.

    Sums of squared differences are exact for near points, and fifty times faster than cdist on a GPU.
    """
    squared = arm.new_zeros(*valid.shape, valid.shape[-1])
    for c in arm.unbind(-1):
        gap = c[..., :, None] - c[..., None, :]
        squared.addcmul_(gap, gap)
    weight = (squared[:, :, None] * (-1 / reach.square())[..., None, None]).exp_()
    weight.mul_(weight > MIN_NEIGHBOUR_WEIGHT).mul_(mass_fraction[:, :, None, None])
    return weight.mul_(valid[:, :, None, :, None] / weight.sum(-1, keepdim=True).clamp_min_(1e-12))


def _others(count: int, device: torch.device) -> tuple[Int[Tensor, "o m"], Int[Tensor, "o m"]]:
    row = torch.arange(count, device=device)[:, None]
    column = torch.arange(max(count - 1, 0), device=device)[None]
    others = column + (column >= row)
    return others, (row - (row > others).long()).expand_as(others)
