"""Objects of several materials: assign points to parts, and average the parts into one material."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.physics.materials import MODELS, Material, MaterialChoice
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import SceneObject


def part_of_points(choice: MaterialChoice, x: Float[Tensor, "p 3"]) -> Int[Tensor, "p"]:
    """Index into `choice.parts` of the part that contains each point of an object at rest [scene units].

    Heights are relative to the lowest point.
    """
    index = torch.full((len(x),), len(choice.parts) - 1)
    height = x[:, 2] - x[:, 2].min()
    for k in reversed(range(len(choice.parts) - 1)):
        part = choice.parts[k]
        inside = torch.ones(len(x), dtype=torch.bool)
        if part.below is not None:
            inside &= height < part.below
        if part.box is not None:
            inside &= ((x >= torch.tensor(part.box[:3])) & (x <= torch.tensor(part.box[3:]))).all(1)
        if part.segment is not None:
            inside &= part.segment.contains(x)
        index[inside] = k
    return index


def located(choice: MaterialChoice, gaussians: Gaussians, o: SceneObject) -> MaterialChoice:
    """The choice with its segments mapped to the object's Gaussians. Raises InputError as `Segment.of_object`."""
    parts = [p if p.segment is None else replace(p, segment=p.segment.of_object(gaussians, o)) for p in choice.several]
    return replace(choice, several=tuple(parts))


def segment_files(choices: Mapping[int, MaterialChoice]) -> list[Path]:
    """The labelled PLY files whose segments are parts of objects."""
    return sorted({part.segment.path for c in choices.values() for part in c.parts if part.segment is not None})


def averaged(choice: MaterialChoice, x: Float[Tensor, "p 3"], volume: Float[Tensor, "p"]) -> MaterialChoice:
    """The choice with the average of its parts as its material; unchanged if it has one part.

    Density, Poisson's ratio and loss are volume-weighted means, which keeps the total mass; friction is the
    mass-weighted mean; Young's modulus is the volume-weighted harmonic mean, as for parts stacked on each other. If a
    part is plastic, the whole has the model of the first such part.
    """
    if len(choice.parts) == 1:
        return choice
    share = torch.zeros(len(choice.parts)).index_add(0, part_of_points(choice, x), volume).double()
    materials = [part.material for part in choice.parts]
    of = {name: torch.tensor([getattr(m, name) for m in materials], dtype=torch.float64)
          for name in ("E", "density", "nu", "friction", "loss")}  # fmt: skip
    mass, total = share * of["density"], share.sum()
    plastic = next((m for m in materials if MODELS[m.model].plastic), materials[-1])
    mean = Material(
        E=float(total / (share / of["E"]).sum()), density=float(mass.sum() / total),
        nu=float((share * of["nu"]).sum() / total), friction=float((mass * of["friction"]).sum() / mass.sum()),
        loss=float((share * of["loss"]).sum() / total), model=plastic.model, plastic=plastic.plastic,
        source="the average of its parts",
    )  # fmt: skip
    return replace(choice, material=mean)


def uneven_moments(
    choice: MaterialChoice, x: Float[Tensor, "p 3"], volume: Float[Tensor, "p"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]:
    """Change of an object's centre of mass, and of the inertia about it per unit of mass, due to its parts' densities.

    Both are relative to a uniform object of the same shape, and zero if the object is uniform.
    """
    if len(choice.parts) == 1:
        return torch.zeros(3), torch.zeros(3, 3)
    density = torch.tensor([part.material.density for part in choice.parts])[part_of_points(choice, x)]
    (com, inertia), (middle, uniform) = (_moments(x.double(), m.double()) for m in (density * volume, volume))
    return (com - middle).float(), (inertia - uniform).float()


def _moments(x: Float[Tensor, "p 3"], mass: Float[Tensor, "p"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]:
    """Centre of mass, and inertia about it per unit of mass, of point masses."""
    share = (mass / mass.sum())[:, None]
    com = (share * x).sum(0)
    r = x - com
    second = (share * r).mT @ r
    return com, second.trace() * torch.eye(3, dtype=x.dtype) - second
