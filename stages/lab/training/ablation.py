"""Ablations of the force field: its network or training options with one component removed."""

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
from stages.lab.training.options import TrainOptions

IMPULSE_VECTORS = 2  # last vector features of a contact: the impulses that stop its motion and its normal motion


@dataclass(frozen=True)
class Ablation:
    """Removal of one component, by another network or by other training options."""

    without: str  # description of the component for the table
    network: Callable[[], Dynamics] = ForceField
    options: Callable[[TrainOptions], TrainOptions] = lambda options: options


class _UnfusedForceField(ForceField):
    """A force field without the fused kernels, which implement only the full network."""

    def _use_fused_step(self, scene: FieldScene) -> bool:
        return False


class NoReaction(_UnfusedForceField):
    """Contact forces act on one body only: each side of a contact predicts its own, independent force."""

    def _reaction(self, shape: RestShape, x: Float[Tensor, "b o m c"]) -> Float[Tensor, "b o c"]:
        return torch.zeros_like(x.sum(2))


class NoMaterialInputs(_UnfusedForceField):
    """Constant stiffness, Poisson ratio and friction as network inputs for all objects; masses stay true."""

    def encode(self, shape: RestShape) -> FieldScene:
        """Embeddings and springs for E = 1e5 Pa, Poisson ratio 0.3 and friction 0.5; `shape` is returned unchanged."""
        w = shape.initial
        same = replace(w, E=torch.full_like(w.E, 1e5), nu=torch.full_like(w.nu, 0.3),
                       friction=torch.full_like(w.friction, 0.5))  # fmt: skip
        return replace(super().encode(replace(shape, initial=same)), shape=shape)


class _NoImpulseFeatures(ContactNet):
    """Contact features without the impulses that would stop the relative motion."""

    def __init__(self, vectors: int, scalars: int, hidden: int, partner: bool):
        super().__init__(vectors - IMPULSE_VECTORS, scalars, hidden, partner)

    def encode(
        self, contacts: ContactPoints, mass_fraction: Float[Tensor, "b o m n"], own: Float[Tensor, "b o h"],
        other: Float[Tensor, "b o m h"] | None = None,
    ) -> tuple[Float[Tensor, "b o m n h"], Float[Tensor, "b o m n"], Float[Tensor, "b o m h"]]:  # fmt: skip
        contacts = replace(contacts, vectors=contacts.vectors[..., :-IMPULSE_VECTORS, :])
        return super().encode(contacts, mass_fraction, own, other)

    def decode(
        self, message: Float[Tensor, "b o m n h"], weight: Float[Tensor, "b o m n"], context: Float[Tensor, "b o m h"],
        vectors: Float[Tensor, "b o m n k 3"],
    ) -> Float[Tensor, "b o m n 3"]:  # fmt: skip
        return super().decode(message, weight, context, vectors[..., :-IMPULSE_VECTORS, :])


class _ZeroFeatures(nn.Module):
    """A module whose output is zeros of a given width."""

    def __init__(self, width: int):
        super().__init__()
        self.width = width

    def forward(self, x: Float[Tensor, "*b i"]) -> Float[Tensor, "*b h"]:
        return x.new_zeros(*x.shape[:-1], self.width)


def no_impulse_features() -> ForceField:
    """The force field with impulses removed from its contact features."""
    model = _UnfusedForceField()
    h = model.config["hidden"]
    model.pairs, model.planes = _NoImpulseFeatures(10, 7, h, partner=True), _NoImpulseFeatures(8, 5, h, partner=False)
    return model


def no_context() -> ForceField:
    """The force field without message passing between contact points."""
    model = _UnfusedForceField()
    model.between = model.against = _ZeroFeatures(model.config["hidden"])
    return model


ABLATIONS = {
    "full": Ablation("nothing (the full network)"),
    "deformation": Ablation("deformation (bodies are rigid)", lambda: ForceField(deform=False)),
    "reaction": Ablation("action equals reaction (a contact force acts on one body only)", NoReaction),
    "impulses": Ablation("the impulse that would stop a contact, as a feature", no_impulse_features),
    "context": Ablation("messages between contact points", no_context),
    "materials": Ablation("stiffness, Poisson ratio and friction as inputs", NoMaterialInputs),
    "keypoints": Ablation("three of four keypoints", options=lambda o: replace(o, keypoints=max(1, o.keypoints // 4))),
    "discount": Ablation("gradient discount (`--gradient-discount 1`)",
                       options=lambda o: replace(o, gradient_discount=1.0)),
    "axes": Ablation("the loss by axis of an object (`--loss square`)", options=lambda o: replace(o, loss="square")),
    "horizons": Ablation("rollouts longer than the first horizon",
                       options=lambda o: replace(o, horizons=str(o.frames[0]))),
}  # fmt: skip
