"""Learned deformation: displacements of each object's keypoints in its body frame, on top of the rigid motion."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.kernels.compilers import TRITON
from stages.core.kernels.threads import large_operation
from stages.core.models.field.equivariant import apply_layers, matvec, mlp, weighted_sum
from stages.core.models.field.kernel_choice import triton_allowed
from stages.core.models.field.rest_shape import NEIGHBOURHOOD_RADII, RestShape

if TRITON:
    from stages.core.kernels.field.skinny_matmul import skinny_matmul

# Upper limits of the learned springs, given by the stability of explicit steps of one FRAME; hand-chosen, no source.
MAX_STIFFNESS = 2500.0  # largest stiffness of the springs to the rest shape [1/s^2]: a period of 1/8 s, six frames
MAX_DAMPING = 100.0  # largest damping of the displacement rates [1/s]
MAX_SPRING_WEIGHT, MAX_DAMPER_WEIGHT = 8.0, 0.8  # largest weights of the additional springs and dampers of each scale
MAX_DISPLACEMENT = 1.5  # largest displacement of a keypoint [radii of gyration of its object]
SCALE_COUNT = 1 + len(NEIGHBOURHOOD_RADII)  # displacements: absolute, and relative to the mean of each neighbourhood
VECTOR_COUNT = 3 * SCALE_COUNT + 3  # vector features of a keypoint


class DeformationInputs(NamedTuple):
    """Per-step inputs of the deformation network, in the body frame."""

    u: Float[Tensor, "b o n 3"]  # displacements [m]
    du: Float[Tensor, "b o n 3"]  # rates of the displacements [m/s]
    contact: Float[Tensor, "b o n 3"]  # accelerations of the keypoints by contact [m/s^2]
    gravity: Float[Tensor, "b o 3"]  # [m/s^2]


class DeformationNet(nn.Module):
    """Acceleration of the displacements; springs to the rest shape are added by the integrator (`springs`).

    Attribute names are the keys of its state dict.
    """

    def __init__(self, hidden: int):
        super().__init__()
        self.input_layer = nn.Linear(VECTOR_COUNT * (VECTOR_COUNT + 1) // 2, hidden)  # input: invariant features
        self.embedding_projection = nn.Linear(hidden, hidden)  # input: the object's embedding
        self.decoder = mlp(hidden, hidden, 3 * SCALE_COUNT, output_scale=0.1)  # output: weights of the vector features
        self.spring_constants = mlp(hidden, hidden, 2)  # stiffness and damping from the embedding

    def springs(self, embedding: Float[Tensor, "b o h"]) -> tuple[Float[Tensor, "b o"], Float[Tensor, "b o"]]:
        """Return stiffness [1/s^2] and damping [1/s] of each object."""
        stiffness, damping = torch.sigmoid(self.spring_constants(embedding)).unbind(-1)
        return MAX_STIFFNESS * stiffness, MAX_DAMPING * damping

    def forward(
        self, shape: RestShape, embedding: Float[Tensor, "b o h"], compliance_scale: Float[Tensor, "b o"],
        inputs: DeformationInputs,
    ) -> Float[Tensor, "b o n 3"]:  # fmt: skip
        """Return accelerations in the body frame [m/s^2], without net force and torque.

        The driving part is multiplied by `compliance_scale`, which is at most 1 (linear elasticity: strain is
        stress / E).
        """
        u, du, contact = inputs.u, inputs.du, inputs.contact
        size = shape.size[..., None, None]
        mass_fraction = shape.initial.mass_fraction[..., None]
        means = _neighbourhood_means(shape.blur, torch.cat([contact, u, du], -1)).unflatten(-1, (3, 3))  # b o n s 3 3
        mean_contact, mean_u, mean_du = means.unbind(-2)
        virial = torch.einsum("boni,bonj->boij", mass_fraction * contact, shape.arm) / size**2
        arm = shape.arm / size
        springs = torch.cat([u[..., None, :], u[..., None, :] - mean_u], -2)
        dampers = torch.cat([du[..., None, :], du[..., None, :] - mean_du], -2)
        spread = matvec((virial + virial.mT)[:, :, None], shape.arm)[..., None, :]
        dynamic = torch.cat([20 * springs, 2 * dampers, mean_contact / 10, spread / 10], -2)
        gravity = (inputs.gravity / 5)[:, :, None].expand_as(arm)
        static = torch.stack([shape.normal, arm, gravity], -2)
        layers, offset = (self.input_layer, self.decoder[0], self.decoder[2]), self.embedding_projection(embedding)
        weights = apply_layers(arm[..., :0], layers, torch.cat([dynamic, static], -2), offset[:, :, None])
        # Only features that vanish at rest are weighted, so a body without contact keeps its rest shape. Springs and
        # dampers have negative weights: springs restore the shape, dampers slow the motion down.
        spring, damper, drive = weights.unflatten(-1, (3, SCALE_COUNT)).unbind(-2)
        drive = compliance_scale[..., None, None] * drive
        spring, damper = torch.sigmoid(spring - 3), torch.sigmoid(damper - 2)
        weights = torch.cat([-MAX_SPRING_WEIGHT * spring, -MAX_DAMPER_WEIGHT * damper, drive], -1)
        return projected(shape, 10 * weighted_sum(weights, dynamic))


def _neighbourhood_means(blur: Float[Tensor, "b o s n n"], x: Float[Tensor, "b o n 9"]) -> Float[Tensor, "b o n s 9"]:
    """Means of x over the s neighbourhoods of each point, with the rows of `blur` as weights."""
    if blur.dtype == torch.float16 and triton_allowed(x):
        s = blur.shape[2]
        rows = blur.flatten(2, 3)  # one product for all neighbourhoods
        return skinny_matmul(rows, x).unflatten(2, (s, -1)).transpose(2, 3)
    if x.is_cuda or torch.compiler.is_compiling():
        return _product(blur.to(x), x)
    with large_operation():
        return _product(blur.to(x), x)


def _product(blur: Float[Tensor, "b o s n n"], x: Float[Tensor, "b o n 9"]) -> Float[Tensor, "b o n s 9"]:
    """blur @ x, by the product of the transposes: twice as fast on a CPU."""
    return (x.mT[:, :, None] @ blur.mT).permute(0, 1, 4, 2, 3)


def projected(shape: RestShape, field: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o n 3"]:
    """Remove the mass-weighted mean and net rotation of a vector field on the keypoints; 0 where padded."""
    mass_fraction = shape.initial.mass_fraction[..., None]
    field = field - (mass_fraction * field).sum(2, keepdim=True)
    momentum = (mass_fraction * torch.linalg.cross(shape.arm, field)).sum(2)
    rotation = matvec(shape.keypoint_inverse, momentum)
    field = field - torch.linalg.cross(rotation[:, :, None].expand_as(field), shape.arm)
    return torch.where(shape.initial.valid[..., None], field, 0.0)


def bounded(shape: RestShape, u: Float[Tensor, "b o n 3"]) -> Float[Tensor, "b o n 3"]:
    """Limit displacements [m] to MAX_DISPLACEMENT times the size of the object, by one scale factor per object."""
    maximum = MAX_DISPLACEMENT * shape.size
    largest = u.detach().square().sum(-1).amax(-1).sqrt()
    return u * (maximum / torch.maximum(largest, maximum))[..., None, None]
