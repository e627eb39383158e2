"""A transformer baseline with the inputs of `ngff` but none of its built-in physics.

Layers attend alternately within objects and over the whole scene; the outputs are accelerations.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from stages.core.models.dynamics import PointDynamics, PointState, movable
from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions, centre_of_mass, offsets

ACCELERATION_UNIT = 20.0  # acceleration represented by a network output of 1 [m/s^2]
WALL_RANGE = 0.1  # distances to walls are clipped to this [m]


class TransformerBlock(nn.Module):
    """Pre-norm attention and feed-forward (Xiong et al. 2020, "On Layer Normalization in the Transformer")."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.before, self.between = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: Float[Tensor, "s p w"], keys: Bool[Tensor, "s p"]) -> Float[Tensor, "s p w"]:
        """Return the tokens of s sequences after attention and feed-forward; only tokens in `keys` are attended to."""
        q, k, v = self.qkv(self.before(x)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        y = scaled_dot_product_attention(q, k, v, attn_mask=keys[:, None, None])
        x = x + self.out(y.transpose(1, 2).flatten(2))
        return x + self.mlp(self.between(x))


def features(initial: InitialConditions, state: PointState) -> Float[Tensor, "b o n 29"]:
    """Input features of each keypoint, scaled to order one."""
    x, v = state.position, state.velocity
    com, drift = centre_of_mass(initial, x), centre_of_mass(initial, v)
    present = initial.present[..., None]
    middle = (com * present).sum(1, keepdim=True) / present.sum(1, keepdim=True).clamp_min(1)
    low, high = initial.box[..., None, 0, :], initial.box[..., None, 1, :]
    height = x[..., 2:] - low[..., 2:]
    walls = (torch.cat([x - low, high - x], -1) / WALL_RANGE).clamp(-1, 1)
    material = torch.stack(
        [(initial.E * initial.solidity).log10() - 5, initial.nu, initial.friction, initial.mass.log()], -1
    )
    shared = torch.cat([com - middle, drift, material, (initial.gravity / 5)[:, None].expand_as(com)], -1)
    shared = shared[:, :, None].expand(*x.shape[:3], -1)
    return torch.cat([x - com[:, :, None], offsets(initial, initial.points), v, height, walls, shared], -1)


class Transformer(PointDynamics):
    """Engine `transformer`: half of the layers attend within objects, half across the scene."""

    inputs = frozenset({
        "points", "mass_fraction", "mass", "E", "solidity", "nu", "friction", "velocity", "spin", "gravity", "box"
    })  # fmt: skip

    def __init__(self, hidden: int = 128, layers: int = 4, heads: int = 4):
        super().__init__()
        self.config = {"hidden": hidden, "layers": layers, "heads": heads}
        self.embed = nn.Linear(29, hidden)
        self.blocks = nn.ModuleList(TransformerBlock(hidden, heads) for _ in range(layers))
        self.head = nn.Sequential(nn.LayerNorm(hidden), nn.Linear(hidden, hidden), nn.GELU(), nn.Linear(hidden, 3))

    def derivative(
        self, initial: InitialConditions, t: Tensor | float, state: PointState, external: ExternalForces
    ) -> PointState:
        """Return velocity [m/s], and acceleration by network, gravity and forces [m/s^2]; 0 for immovable points."""
        b, o, n = initial.valid.shape
        # padded objects attend to their own padding, because a softmax over no keys is nan
        own = (initial.valid | ~initial.present[..., None]).flatten(0, 1)
        x = self.embed(features(initial, state))
        for i, block in enumerate(self.blocks):
            whole = i % 2 == 1
            x = block(x.reshape(b, -1, x.shape[-1]) if whole else x.reshape(b * o, n, -1),
                      initial.valid.flatten(1) if whole else own)  # fmt: skip
        acceleration = ACCELERATION_UNIT * self.head(x).reshape(b, o, n, 3) + initial.gravity[:, None, None]
        acceleration = acceleration + external.acceleration(initial, state.position, t)
        may_move = movable(initial, external)
        return PointState(state.velocity * may_move, acceleration * may_move)
