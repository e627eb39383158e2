"""Small worlds and models for the tests of dynamics models."""

import torch
from torch import Tensor

from stages.core.models.checkpoints import build
from stages.core.models.dynamics import Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions

SMALL = {
    "ngff": {"hidden": 8},
    "ngff-paper": {"hidden": 16, "layers": 2},
    "ngff-paper-rigid": {"hidden": 16, "layers": 2},
    "gcn": {"hidden": 16, "layers": 2},
    "pointformer": {"hidden": 16, "layers": 2},
    "transformer": {"hidden": 16, "layers": 2, "heads": 2},
}


def small(name: str, seed: int = 0) -> Dynamics:
    """An untrained model in double precision, so that only mistakes make differences."""
    torch.manual_seed(seed)
    return build(name, **SMALL[name]).double().eval()


def crowd(b: int = 2, o: int = 3, n: int = 12, seed: int = 0) -> InitialConditions:
    """Objects that overlap a little above the floor, all materials and sizes different; everything moves."""
    rng = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=rng, dtype=torch.float64)

    place = torch.cat([0.2 * rand(b, o, 2), rand(b, o, 1) * 0.2 - 0.8], -1)
    points = place[:, :, None] + 0.3 * (rand(b, o, n, 3) - 0.5)
    return InitialConditions.of(
        points, mass=0.5 + rand(b, o), E=10 ** (3 + 4 * rand(b, o)), nu=0.2 + 0.2 * rand(b, o), friction=rand(b, o),
        velocity=rand(b, o, 3) - 0.5, spin=2 * (rand(b, o, 3) - 0.5),
    )  # fmt: skip


def padded(initial: InitialConditions, objects: int, keypoints: int) -> InitialConditions:
    """The same world with room for more; the padding of the fields is rubbish, which nobody may read."""
    b, o, n, _ = initial.points.shape
    valid = torch.zeros(b, o + objects, n + keypoints, dtype=torch.bool)
    valid[:, :o, :n] = initial.valid
    points = torch.full((b, o + objects, n + keypoints, 3), 7.0, dtype=initial.points.dtype)
    points[:, :o, :n] = initial.points

    def more(x: Tensor, value: float) -> Tensor:
        return torch.cat([x, x.new_full((b, objects, *x.shape[2:]), value)], 1)

    return InitialConditions.of(
        points, valid, mass=more(initial.mass, 3.0), E=more(initial.E, 2e4), nu=more(initial.nu, 0.1),
        friction=more(initial.friction, 0.7), velocity=more(initial.velocity, 1.0), spin=more(initial.spin, 1.0),
        gravity=initial.gravity, box=more(initial.box, 5.0),
    )  # fmt: skip


def push(
    initial: InitialConditions, row: int, force=(0.0, 0.0, 0.0), torque=(0.0, 0.0, 0.0), start=-1.0, end=1e9, point=-1
) -> ExternalForces:
    """One push in every scene."""
    b = len(initial)
    real = {"dtype": initial.points.dtype}
    return ExternalForces(
        torch.full((b, 1), row), torch.tensor(force, **real).expand(b, 1, 3),
        torch.tensor(torque, **real).expand(b, 1, 3), torch.full((b, 1), start, **real),
        torch.full((b, 1), end, **real), torch.full((b, 1), point), ExternalForces.none(initial).pinned,
    )  # fmt: skip
