"""Our force field with one of its choices taken away: what that choice is worth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.models.dynamics import Dynamics
from stages.core.models.field.contact_forces import ContactNet, ContactPoints
from stages.core.models.field.force_field import FieldScene, ForceField
from stages.core.models.field.rest_shape import RestShape
from stages.lab.training.train import TrainOptions

IMPULSE_VECTORS = (
    2  # vectors at the end of those of a contact: what would stop it, and what would push it along the normal
)


@dataclass(frozen=True)
class Ablation:
    """A choice, taken away by another network or by other options of training."""

    without: str
    network: Callable[[], Dynamics] = ForceField
    options: Callable[[TrainOptions], TrainOptions] = lambda options: options


class _UnfusedForceField(ForceField):
    """Without kernels for a whole step: they know the full network alone."""

    def _fused(self, scene: FieldScene) -> bool:
        return False


class NoReaction(_UnfusedForceField):
    """What touches a body pushes it, and feels nothing of that: each side has forces of its own."""

    def _returned(self, shape: RestShape, x: Float[Tensor, "b o m c"]) -> Float[Tensor, "b o c"]:
        return torch.zeros_like(x[:, :, 0])


class NoMaterialInputs(_UnfusedForceField):
    """All objects are of one stiffness, Poisson ratio and friction to the network; their mass it knows."""

    def encode(self, shape: RestShape) -> FieldScene:
        w = shape.initial
        same = replace(w, E=torch.full_like(w.E, 1e5), nu=torch.full_like(w.nu, 0.3),
                       friction=torch.full_like(w.friction, 0.5))  # fmt: skip
        return replace(super().encode(replace(shape, initial=same)), shape=shape)


class _NoImpulseFeatures(ContactNet):
    """Contacts that see how things move, but not which impulse would stop them."""

    def __init__(self, vectors: int, scalars: int, hidden: int, partner: bool):
        super().__init__(vectors - IMPULSE_VECTORS, scalars, hidden, partner)

    def encode(
        self, places: ContactPoints, share: Float[Tensor, "b o m n"], own: Float[Tensor, "b o h"],
        other: Float[Tensor, "b o m h"] | None = None,
    ) -> tuple[Float[Tensor, "b o m n h"], Float[Tensor, "b o m n"], Float[Tensor, "b o m h"]]:  # fmt: skip
        return super().encode(replace(places, vectors=places.vectors[..., :-IMPULSE_VECTORS, :]), share, own, other)

    def decode(
        self, message: Float[Tensor, "b o m n h"], weight: Float[Tensor, "b o m n"], context: Float[Tensor, "b o m h"],
        vectors: Float[Tensor, "b o m n k 3"],
    ) -> Float[Tensor, "b o m n 3"]:  # fmt: skip
        return super().decode(message, weight, context, vectors[..., :-IMPULSE_VECTORS, :])


class _ZeroFeatures(nn.Module):
    """Nothing, of some width."""

    def __init__(self, width: int):
        super().__init__()
        self.width = width

    def forward(self, x: Float[Tensor, "*b i"]) -> Float[Tensor, "*b h"]:
        return x.new_zeros(*x.shape[:-1], self.width)


def no_impulse_features() -> ForceField:
    model = _UnfusedForceField()
    h = model.config["hidden"]
    model.pairs, model.planes = _NoImpulseFeatures(10, 7, h, partner=True), _NoImpulseFeatures(8, 5, h, partner=False)
    return model


def no_context() -> ForceField:
    """Each place of contact answers for itself, not knowing of any other."""
    model = _UnfusedForceField()
    model.between = model.against = _ZeroFeatures(model.config["hidden"])
    return model


ABLATIONS = {
    "full": Ablation("nothing: the network as it is"),
    "deformation": Ablation("deformation: bodies are rigid", lambda: ForceField(deform=False)),
    "reaction": Ablation("reaction: a contact force acts on one body alone", NoReaction),
    "impulses": Ablation("the impulse that would stop a contact, as what it sees", no_impulse_features),
    "context": Ablation("what happens elsewhere: a contact knows of no other", no_context),
    "materials": Ablation("stiffness, Poisson ratio and friction as inputs", NoMaterialInputs),
    "keypoints": Ablation("three of four keypoints", options=lambda o: replace(o, keypoints=max(1, o.keypoints // 4))),
    "memory": Ablation("fading of gradients (`--memory 1`)", options=lambda o: replace(o, memory=1.0)),
    "axes": Ablation("the loss by axis of an object (`--loss square`)", options=lambda o: replace(o, loss="square")),
    "horizons": Ablation("rollouts longer than the first horizon",
                       options=lambda o: replace(o, horizons=str(o.frames[0]))),
}  # fmt: skip
