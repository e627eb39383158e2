"""Forces where things touch: at keypoints near other objects, the floor and the walls.

Each place of contact sees invariant numbers, is heard by its pair of objects, hears what else happens to them, and
answers with a force: a weighted sum of the vectors it saw.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stages.models.vectors import mlp, products, weigh

GRIP = 2e-3  # share of an object in contact at which it is felt by half
STRENGTH = 20.0  # acceleration that a vector of length 1 stands for [m/s^2]


@dataclass(frozen=True)
class Places:
    """Keypoints n of object o near m things."""

    vectors: Float[Tensor, "b o m n k 3"]  # in units in which they are of order one
    scalars: Float[Tensor, "b o m n s"]
    gate: Float[Tensor, "b o m n"]  # 1 near, 0 far


class Touch(nn.Module):
    """The network of one kind of contact. `listen` first, `answer` with what else is known."""

    def __init__(self, vectors: int, scalars: int, hidden: int, partner: bool):
        super().__init__()
        self.see = nn.Linear(vectors * (vectors + 1) // 2 + scalars, hidden)
        self.own = nn.Linear(hidden, hidden)
        self.other = nn.Linear(hidden, hidden) if partner else None
        self.hear = mlp(hidden, hidden, hidden + 1)
        self.tell = nn.Linear(hidden, hidden)
        self.say = mlp(hidden, hidden, vectors, quiet=0.1)

    def listen(
        self, places: Places, share: Float[Tensor, "b o n"], own: Float[Tensor, "b o h"],
        other: Float[Tensor, "b o m h"] | None = None,
    ) -> tuple[Float[Tensor, "b o m n h"], Float[Tensor, "b o m n"], Float[Tensor, "b o m h"]]:  # fmt: skip
        """What each place has to say, its weight, and what the object hears from all places together.

        Weights of an object sum to 1 in firm contact and go to 0 with its last gate, so that neither the number of
        keypoints nor a distant one matters.
        """
        x = self.see(torch.cat([products(places.vectors), places.scalars], -1))
        x = x + self.own(own)[:, :, None, None]
        if self.other is not None:
            x = x + self.other(other)[:, :, :, None]
        x = self.hear(torch.nn.functional.silu(x))
        attention = torch.exp(4 * torch.tanh(x[..., -1] / 4))
        weight = places.gate * share[:, :, None] * attention
        weight = weight / (weight.sum(-1, keepdim=True) + GRIP)
        return x[..., :-1], weight, (weight[..., None] * x[..., :-1]).sum(-2)

    def answer(
        self, message: Float[Tensor, "b o m n h"], context: Float[Tensor, "b o m h"],
        vectors: Float[Tensor, "b o m n k 3"],
    ) -> Float[Tensor, "b o m n 3"]:  # fmt: skip
        """Acceleration at every place [m/s^2], not yet weighted."""
        x = torch.nn.functional.silu(message + self.tell(context)[:, :, :, None])
        return STRENGTH * weigh(self.say(x), vectors)
