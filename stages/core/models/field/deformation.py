"""Deformation: a displacement field on the keypoints of each object, on top of its rigid motion."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.kernels.compilers import TRITON
from stages.core.models.field.equivariant import apply_layers, matvec, mlp, weighted_sum
from stages.core.models.field.rest_shape import NEIGHBOURHOOD_RADII, RestShape

if TRITON:
    from stages.core.kernels.field.skinny_matmul import skinny_matmul

MAX_STIFFNESS = 2500.0  # [1/s^2]: a swing of an eighth of a second, six frames
MAX_DAMPING = 100.0  # damping [1/s]
MAX_SPRING_WEIGHT, MAX_DAMPER_WEIGHT = 8.0, 0.8  # of springs and dampers, so weak that steps of a frame are stable
MAX_DISPLACEMENT = 1.5  # a point can be displaced by so many sizes of its object
SCALE_COUNT = 1 + len(NEIGHBOURHOOD_RADII)  # at which displacements are seen: whole, and in neighbourhoods
VECTOR_COUNT = 3 * SCALE_COUNT + 3  # of vectors


class DeformationNet(nn.Module):
    """Acceleration of the displacements; what springs and dampers add is left to the integrator."""

    def __init__(self, hidden: int):
        super().__init__()
        self.see = nn.Linear(VECTOR_COUNT * (VECTOR_COUNT + 1) // 2, hidden)
        self.own = nn.Linear(hidden, hidden)
        self.say = mlp(hidden, hidden, 3 * SCALE_COUNT, quiet=0.1)
        self.spring = mlp(hidden, hidden, 2)

    def springs(self, code: Float[Tensor, "b o h"]) -> tuple[Float[Tensor, "b o"], Float[Tensor, "b o"]]:
        """Stiffness [1/s^2] and damping [1/s] of an object."""
        stiffness, damping = torch.sigmoid(self.spring(code)).unbind(-1)
        return MAX_STIFFNESS * stiffness, MAX_DAMPING * damping

    def forward(
        self, shape: RestShape, code: Float[Tensor, "b o h"], compliance_scale: Float[Tensor, "b o"], u: Float[Tensor,
        "b o n 3"],
        du: Float[Tensor, "b o n 3"], touch: Float[Tensor, "b o n 3"], gravity: Float[Tensor, "b o 3"],
    ) -> Float[Tensor, "b o n 3"]:  # fmt: skip
        """Acceleration in the object's frame [m/s^2], without any that would move or turn the whole.

        `touch` is the acceleration at the points by contact, `gravity` as the object's axes see it; what does not
        `yield` is driven less.
        """
        size = shape.size[..., None, None]
        mass_fraction = shape.initial.mass_fraction[..., None]
        felt = _blurred(shape.blur, torch.cat([touch, u, du], -1)).unflatten(-1, (3, 3))  # b o n s 3 3
        pushed, mean_u, mean_du = felt.unbind(-2)
        virial = torch.einsum("boni,bonj->boij", mass_fraction * touch, shape.arm) / size**2
        arm = shape.arm / size
        springs = torch.cat([u[..., None, :], u[..., None, :] - mean_u], -2)
        dampers = torch.cat([du[..., None, :], du[..., None, :] - mean_du], -2)
        spread = matvec((virial + virial.mT)[:, :, None], shape.arm)[..., None, :]
        moving = torch.cat([20 * springs, 2 * dampers, pushed / 10, spread / 10], -2)
        still = torch.stack([shape.normal, arm, (gravity / 5)[:, :, None].expand_as(arm)], -2)
        said = apply_layers(arm[..., :0], (self.see, self.say[0], self.say[2]), torch.cat([moving, still], -2),
                     self.own(code)[:, :, None])  # fmt: skip
        # only what vanishes at rest: an untouched body stays as it is; springs pull back and dampers slow
        pull, slow, drive = said.unflatten(-1, (3, SCALE_COUNT)).unbind(-2)
        drive = compliance_scale[..., None, None] * drive
        said = torch.cat(
            [-MAX_SPRING_WEIGHT * torch.sigmoid(pull - 3), -MAX_DAMPER_WEIGHT * torch.sigmoid(slow - 2), drive], -1
        )
        return projected(shape, 10 * weighted_sum(said, moving))


def _blurred(blur: Float[Tensor, "b o s n n"], x: Float[Tensor, "b o n 9"]) -> Float[Tensor, "b o n s 9"]:
    """Averages of x over the neighbourhoods of each point."""
    if blur.dtype == torch.float16 and not torch.is_grad_enabled():
        s = blur.shape[2]
        rows = blur.flatten(2, 3)  # all neighbourhoods at once
        return skinny_matmul(rows, x).unflatten(2, (s, -1)).transpose(2, 3)
    return (x.mT[:, :, None] @ blur.to(x).mT).permute(0, 1, 4, 2, 3)  # on a CPU twice as fast as what it means


def projected(shape: RestShape, field: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o n 3"]:
    """A field on the points without its mean and without its net rotation; 0 where padded."""
    mass_fraction = shape.initial.mass_fraction[..., None]
    field = field - (mass_fraction * field).sum(2, keepdim=True)
    momentum = (mass_fraction * torch.linalg.cross(shape.arm, field)).sum(2)
    turn = matvec(shape.inverse, momentum)
    field = field - torch.linalg.cross(turn[:, :, None].expand_as(field), shape.arm)
    return torch.where(shape.initial.valid[..., None], field, 0.0)


def bounded(shape: RestShape, u: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o n 3"]:
    """Displacements kept below a share of the object's size, all of an object by the same, given factor."""
    most = MAX_DISPLACEMENT * shape.size
    largest = u.detach().square().sum(-1).amax(-1).sqrt()
    return u * (most / torch.maximum(largest, most))[..., None, None]
