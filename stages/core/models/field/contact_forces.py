"""Forces where things touch: at keypoints near other objects, the floor and the walls.

Each place of contact sees invariant numbers, is heard by its pair of objects, hears what else happens to them, and
answers with a force: a weighted sum of the vectors it saw.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from stages.core.models.field.equivariant import apply_layers, mlp, weighted_sum

CONTACT_SATURATION = 2e-3  # share of an object in contact at which it is felt by half
ACCELERATION_UNIT = 20.0  # acceleration that a vector of length 1 stands for [m/s^2]


@dataclass(frozen=True)
class ContactPoints:
    """Keypoints n of object o near m things."""

    vectors: Float[Tensor, "b o m n k 3"]  # in units in which they are of order one
    scalars: Float[Tensor, "b o m n s"]
    gate: Float[Tensor, "b o m n"]  # 1 near, 0 far
    row: Int[Tensor, "b o m n"]  # which keypoints of the object these are


class ContactNet(nn.Module):
    """The network of one kind of contact. `listen` first, `answer` with what else is known."""

    def __init__(self, vectors: int, scalars: int, hidden: int, partner: bool):
        super().__init__()
        self.see = nn.Linear(vectors * (vectors + 1) // 2 + scalars, hidden)
        self.own = nn.Linear(hidden, hidden)
        self.other = nn.Linear(hidden, hidden) if partner else None
        self.hear = mlp(hidden, hidden, hidden + 1)
        self.tell = nn.Linear(hidden, hidden)
        self.say = mlp(hidden, hidden, vectors, quiet=0.1)

    def encode(
        self, places: ContactPoints, mass_fraction: Float[Tensor, "b o m n"], own: Float[Tensor, "b o h"],
        other: Float[Tensor, "b o m h"] | None = None,
    ) -> tuple[Float[Tensor, "b o m n h"], Float[Tensor, "b o m n"], Float[Tensor, "b o m h"]]:  # fmt: skip
        """What each place has to say, its weight, and what the object hears from all places together.

        Weights of an object sum to 1 in firm contact and go to 0 with its last gate, so that neither the number of
        keypoints nor a distant one matters.
        """
        known = self.own(own)[:, :, None, None]
        if self.other is not None:
            known = known + self.other(other)[:, :, :, None]
        x = _at(places.gate > 0, self._heard, places.vectors, places.scalars, known)
        attention = torch.exp(4 * torch.tanh(x[..., -1] / 4))
        weight = places.gate * mass_fraction * attention
        weight = weight / (weight.sum(-1, keepdim=True) + CONTACT_SATURATION)
        return x[..., :-1], weight, (weight[..., None] * x[..., :-1]).sum(-2)

    def _heard(self, vectors: Tensor, scalars: Tensor, known: Tensor, near: Tensor | None = None) -> Tensor:
        return apply_layers(scalars, (self.see, self.hear[0], self.hear[2]), vectors, known, near=near)

    def decode(
        self, message: Float[Tensor, "b o m n h"], weight: Float[Tensor, "b o m n"], context: Float[Tensor, "b o m h"],
        vectors: Float[Tensor, "b o m n k 3"],
    ) -> Float[Tensor, "b o m n 3"]:  # fmt: skip
        """Acceleration by every place, weighted [m/s^2]."""
        inputs = self.tell(context)[:, :, :, None]
        return _at(weight > 0, self._said, message, inputs, vectors, weight[..., None])

    def _said(
        self, message: Tensor, inputs: Tensor, vectors: Tensor, weight: Tensor, near: Tensor | None = None
    ) -> Tensor:
        said = apply_layers(message, (self.say[0], self.say[2]), known=inputs, active=True, near=near)
        return weight * ACCELERATION_UNIT * weighted_sum(said, vectors)


def _at(near: Bool[Tensor, "b o m n"], f: Callable[..., Tensor], *given: Tensor) -> Float[Tensor, "b o m n _"]:
    """What f makes of the rows of `given`, which matters only where near: a CPU takes out those rows, then 0 elsewhere.

    A GPU does not: it would have to tell the host how many rows there are.
    """
    if near.is_cuda or torch.compiler.is_compiling():
        return f(*given, near)
    rows, n = near.flatten().nonzero()[:, 0], near.shape[-1]
    each = [x.expand(*near.shape[:3], *x.shape[3:]).flatten(0, 3) for x in given]
    found = f(*(x[rows if len(x) == near.numel() else rows // n] for x in each))
    return found.new_zeros(near.numel(), found.shape[-1]).index_copy(0, rows, found).unflatten(0, near.shape)
