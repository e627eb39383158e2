"""Contact message passing: learned forces at keypoints near other objects, the floor and the walls.

Each contact point is encoded from rotation-invariant features (encode); the messages are averaged per pair of bodies
(aggregate); each body and pair combines them with the object embeddings into a context (update, in `force_field`); each
contact point then gets a force, a weighted sum of its own vector features (decode).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from stages.core.models.field.equivariant import apply_layers, mlp, weighted_sum

CONTACT_SATURATION = 2e-3  # mass fraction in contact at which a message has half its weight; hand-chosen, no source
ACCELERATION_UNIT = 20.0  # acceleration represented by a network output of 1 times a unit vector [m/s^2]


@dataclass(frozen=True)
class ContactPoints:
    """Features of k vectors and s scalars at n contact points of each object o with each of m partners.

    Partners are the other objects, or one plane (floor or nearest wall, m = 1).
    """

    vectors: Float[Tensor, "b o m n k 3"]  # scaled to order one
    scalars: Float[Tensor, "b o m n s"]  # scaled to order one
    gate: Float[Tensor, "b o m n"]  # 1 in contact, fading to exactly 0 at the cutoff distance
    row: Int[Tensor, "b o m n"]  # index of the keypoint within its object


class ContactNet(nn.Module):
    """Network of one kind of contact (pairs of objects, or planes): `encode` messages, then `decode` them into forces.

    Attribute names are the keys of its state dict.
    """

    def __init__(self, vectors: int, scalars: int, hidden: int, partner: bool):
        super().__init__()
        self.input_layer = nn.Linear(vectors * (vectors + 1) // 2 + scalars, hidden)  # input: invariant features
        self.own_projection = nn.Linear(hidden, hidden)  # input: the object's embedding
        self.partner_projection = nn.Linear(hidden, hidden) if partner else None  # input: the partner's embedding
        self.message = mlp(hidden, hidden, hidden + 1)  # output: message and attention logit
        self.context_projection = nn.Linear(hidden, hidden)  # input: the context
        self.decoder = mlp(hidden, hidden, vectors, output_scale=0.1)  # output: weights of the vector features

    def encode(
        self, contacts: ContactPoints, mass_fraction: Float[Tensor, "b o m n"], own: Float[Tensor, "b o h"],
        other: Float[Tensor, "b o m h"] | None = None,
    ) -> tuple[Float[Tensor, "b o m n h"], Float[Tensor, "b o m n"], Float[Tensor, "b o m h"]]:  # fmt: skip
        """Return message and weight of each contact point, and the weighted mean message per object and partner.

        `mass_fraction` is that of each point; `own` and `other` are the embeddings of the object and of its partners.
        Weights sum to almost 1 in firm contact and go to 0 with the gates, so results depend neither on the number of
        keypoints nor on points at the cutoff distance.
        """
        embedding_term = self.own_projection(own)[:, :, None, None]
        if self.partner_projection is not None:
            embedding_term = embedding_term + self.partner_projection(other)[:, :, :, None]
        x = at_contacts(contacts.gate > 0, self._message, contacts.vectors, contacts.scalars, embedding_term)
        attention = torch.exp(4 * torch.tanh(x[..., -1] / 4))
        weight = contacts.gate * mass_fraction * attention
        weight = weight / (weight.sum(-1, keepdim=True) + CONTACT_SATURATION)
        return x[..., :-1], weight, (weight[..., None] * x[..., :-1]).sum(-2)

    def _message(self, vectors: Tensor, scalars: Tensor, offset: Tensor, needed: Tensor | None = None) -> Tensor:
        layers = self.input_layer, self.message[0], self.message[2]
        return apply_layers(scalars, layers, vectors, offset, needed=needed)

    def decode(
        self, message: Float[Tensor, "b o m n h"], weight: Float[Tensor, "b o m n"], context: Float[Tensor, "b o m h"],
        vectors: Float[Tensor, "b o m n k 3"],
    ) -> Float[Tensor, "b o m n 3"]:  # fmt: skip
        """Return the acceleration of the object due to each contact point, times the point's weight [m/s^2]."""
        context_term = self.context_projection(context)[:, :, :, None]
        return at_contacts(weight > 0, self._force, message, context_term, vectors, weight[..., None])

    def _force(
        self, message: Tensor, offset: Tensor, vectors: Tensor, weight: Tensor, needed: Tensor | None = None
    ) -> Tensor:
        layers = self.decoder[0], self.decoder[2]
        coefficients = apply_layers(message, layers, offset=offset, active=True, needed=needed)
        return weight * ACCELERATION_UNIT * weighted_sum(coefficients, vectors)


def at_contacts(
    needed: Bool[Tensor, "b o m n"], f: Callable[..., Tensor], *inputs: Tensor
) -> Float[Tensor, "b o m n _"]:
    """Apply f to the rows of `inputs`, on a CPU only to those `needed`, with 0 in the other rows.

    On a GPU all rows are evaluated: gathering would make the host wait for their count.
    """
    if needed.is_cuda or torch.compiler.is_compiling():
        return f(*inputs, needed=needed)
    rows, n = needed.flatten().nonzero()[:, 0], needed.shape[-1]
    flat = [x.expand(*needed.shape[:3], *x.shape[3:]).flatten(0, 3) for x in inputs]
    values = f(*(x[rows if len(x) == needed.numel() else rows // n] for x in flat))
    return values.new_zeros(needed.numel(), values.shape[-1]).index_copy(0, rows, values).unflatten(0, needed.shape)
