"""Deformation: a displacement field on the keypoints of each object, on top of its rigid motion."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stages.kernels.compilers import TRITON
from stages.models.shape import Shape
from stages.models.vectors import apply, chain, mlp, weigh

if TRITON:
    from stages.kernels.thin import thin_product

STIFFEST = 2500.0  # [1/s^2]: a swing of an eighth of a second, six frames
THICKEST = 100.0  # damping [1/s]
FARTHEST = 0.3  # a point can be displaced by so much of the object's size, times two


class Stress(nn.Module):
    """Acceleration of the displacements; what springs and dampers add is left to the integrator."""

    def __init__(self, hidden: int):
        super().__init__()
        self.see = nn.Linear(8 * 9 // 2 + 1, hidden)
        self.own = nn.Linear(hidden, hidden)
        self.say = mlp(hidden, hidden, 6, quiet=0.1)
        self.spring = mlp(hidden, hidden, 2)

    def springs(self, code: Float[Tensor, "b o h"]) -> tuple[Float[Tensor, "b o"], Float[Tensor, "b o"]]:
        """Stiffness [1/s^2] and damping [1/s] of an object."""
        stiffness, damping = torch.sigmoid(self.spring(code)).unbind(-1)
        return STIFFEST * stiffness, THICKEST * damping

    def forward(
        self, shape: Shape, code: Float[Tensor, "b o h"], u: Float[Tensor, "b o n 3"], du: Float[Tensor, "b o n 3"],
        touch: Float[Tensor, "b o n 3"], gravity: Float[Tensor, "b o 3"],
    ) -> Float[Tensor, "b o n 3"]:  # fmt: skip
        """Acceleration in the object's frame [m/s^2], without any that would move or turn the whole.

        `touch` is the acceleration at the points by contact, `gravity` as the object's axes see it.
        """
        size = shape.size[..., None, None]
        share = shape.world.share[..., None]
        felt = _blurred(shape.blur, torch.cat([touch, u, du], -1))
        virial = torch.einsum("boni,bonj->boij", share * touch, shape.arm) / size**2
        arm = shape.arm / size
        moving = torch.stack([
            20 * u, 2 * du, 20 * (u - felt[..., 3:6]), 2 * (du - felt[..., 6:]), felt[..., :3] / 10,
            apply((virial + virial.mT)[:, :, None], shape.arm) / 10,
        ], -2)  # fmt: skip
        vectors = torch.cat([moving, torch.stack([shape.normal, arm], -2)], -2)
        pull = (arm * gravity[:, :, None] / 5).sum(-1, keepdim=True)
        said = chain(pull, (self.see, self.say[0], self.say[2]), vectors, self.own(code)[:, :, None])
        # only what vanishes at rest: an untouched body stays as it is
        return projected(shape, 10 * weigh(said, moving))


def _blurred(blur: Float[Tensor, "b o n n"], x: Float[Tensor, "b o n 9"]) -> Float[Tensor, "b o n 9"]:
    """blur @ x."""
    if blur.dtype == torch.float16 and not torch.is_grad_enabled():
        return thin_product(blur, x)
    return (x.mT @ blur.to(x).mT).mT  # on a CPU twice as fast as what it means


def projected(shape: Shape, field: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o n 3"]:
    """A field on the points without its mean and without its net rotation; 0 where padded."""
    share = shape.world.share[..., None]
    field = field - (share * field).sum(2, keepdim=True)
    momentum = (share * torch.linalg.cross(shape.arm, field)).sum(2)
    turn = apply(shape.inverse, momentum)
    field = field - torch.linalg.cross(turn[:, :, None].expand_as(field), shape.arm)
    return torch.where(shape.world.valid[..., None], field, 0.0)


def bounded(shape: Shape, u: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o n 3"]:
    """Displacements kept below a share of the object's size, all of an object by the same factor."""
    most = 2 * FARTHEST * shape.size
    largest = u.square().sum(-1).amax(-1).clamp_min(1e-12).sqrt()
    return u * (most / torch.maximum(largest, most))[..., None, None]
