"""The published graph baseline: graph convolutions over a radius graph of all keypoints.

Source of the layer: Kipf and Welling 2017, "Semi-Supervised Classification with Graph Convolutional Networks", eq. 2.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from stages.core.models.dynamics import FRAME, PointDynamics, PointState, movable
from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions

RADIUS = 0.1  # points closer than this are connected, also across objects [m]


@torch.no_grad()
def adjacency(points: Float[Tensor, "b p 3"], valid: Bool[Tensor, "b p"]) -> Float[Tensor, "b p p"]:
    """D^-1/2 (A + I) D^-1/2 of the radius graph, with the degrees D of A + I; 0 where padded."""
    x = points - points.mean(1, keepdim=True)
    with torch.autocast(x.device.type, enabled=False):
        squared = x.float().square().sum(-1)
        gap = squared[:, :, None] + squared[:, None] - 2 * x.float() @ x.float().mT
    near = (gap < RADIUS**2) & valid[:, :, None] & valid[:, None]
    near |= torch.diag_embed(valid)  # rounding may give a point a non-zero distance to itself
    scale = near.sum(-1).clamp_min(1).to(x).rsqrt()
    return near * scale[:, :, None] * scale[:, None]


class GraphConv(nn.Module):
    """A X W^T + b, with the normalised adjacency matrix A and node features X."""

    def __init__(self, inner: int, outer: int):
        super().__init__()
        self.linear = nn.Linear(inner, outer, bias=False)
        self.bias = nn.Parameter(torch.zeros(outer))
        nn.init.xavier_uniform_(self.linear.weight)

    def forward(self, x: Float[Tensor, "b p w"], A: Float[Tensor, "b p p"]) -> Float[Tensor, "b p v"]:
        """Return A x W^T + b for node features `x`; `A` is from `adjacency`."""
        return A.to(x) @ self.linear(x) + self.bias


class GCN(PointDynamics):
    """Engine `gcn`: predicts the change of positions and velocities per FRAME from the current graph.

    The change is applied as a rate.
    """

    inputs = frozenset({"points", "velocity", "spin"})

    def __init__(self, hidden: int = 128, layers: int = 4):
        super().__init__()
        self.config = {"hidden": hidden, "layers": layers}
        widths = [6] + [hidden] * layers
        self.convolutions = nn.ModuleList(GraphConv(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.head = nn.Linear(hidden, 6)

    def derivative(
        self, initial: InitialConditions, t: Tensor | float, state: PointState, external: ExternalForces
    ) -> PointState:
        """Return rates [m/s, m/s^2] from the current radius graph and external forces; 0 for immovable points."""
        position = state.position.flatten(1, 2)
        A = adjacency(position, initial.valid.flatten(1))
        x = torch.cat([position, state.velocity.flatten(1, 2)], -1)
        for convolution in self.convolutions:
            x = torch.relu(convolution(x, A))
        change = (self.head(x) / FRAME).unflatten(1, initial.valid.shape[1:])
        applied = external.acceleration(initial, state.position, t)
        may_move = movable(initial, external)
        return PointState(change[..., :3] * may_move, (change[..., 3:] + applied) * may_move)
