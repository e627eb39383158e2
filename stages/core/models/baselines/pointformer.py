"""The published transformer baseline: attention between all keypoints, with only their positions as input."""

from __future__ import annotations

from torch import Tensor, nn

from stages.core.models.dynamics import FRAME, PointDynamics, PointState, movable
from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions


class Pointformer(PointDynamics):
    """Engine `pointformer`: predicts the change of positions per FRAME, which is applied as a velocity.

    The published model has no velocity input. Here the velocity of the state, which is that of the initial conditions
    plus the impulses of external forces, is added to the network's output; the network cannot change it.
    """

    inputs = frozenset({"points", "velocity", "spin"})

    def __init__(self, hidden: int = 128, layers: int = 3, dropout: float = 0.1):
        super().__init__()
        self.config = {"hidden": hidden, "layers": layers, "dropout": dropout}
        self.embed = nn.Sequential(nn.Linear(3, hidden), nn.ReLU(), nn.Linear(hidden, hidden))
        self.blocks = nn.ModuleList(
            nn.TransformerEncoderLayer(hidden, 1, hidden, dropout, batch_first=True) for _ in range(layers)
        )
        self.norm = nn.LayerNorm(hidden)
        self.head = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 3))

    def derivative(
        self, initial: InitialConditions, t: Tensor | float, state: PointState, external: ExternalForces
    ) -> PointState:
        """Return network output plus velocity [m/s], and external accelerations [m/s^2]; 0 for immovable points."""
        x = self.embed(state.position.flatten(1, 2))
        padding = ~initial.valid.flatten(1)
        for block in self.blocks:
            x = block(x, src_key_padding_mask=padding)
        moved = (0.1 / FRAME * self.head(self.norm(x))).unflatten(1, initial.valid.shape[1:])
        may_move = movable(initial, external)
        applied = external.acceleration(initial, state.position, t)
        return PointState((moved + state.velocity) * may_move, applied * may_move)
