"""Small scenes and models for the tests of dynamics models."""

import torch
from torch import Tensor

from stages.core.models.checkpoints import build
from stages.core.models.dynamics import Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions

SMALL_CONFIGS = {
    "ngff": {"hidden": 8},
    "ngff-paper": {"hidden": 16, "layers": 2},
    "ngff-paper-rigid": {"hidden": 16, "layers": 2},
    "gcn": {"hidden": 16, "layers": 2},
    "pointformer": {"hidden": 16, "layers": 2},
    "transformer": {"hidden": 16, "layers": 2, "heads": 2},
}


def small_model(name: str, seed: int = 0) -> Dynamics:
    """Untrained model in double precision, so that rounding cannot hide errors."""
    torch.manual_seed(seed)
    return build(name, **SMALL_CONFIGS[name]).double().eval()


def overlapping_objects(b: int = 2, o: int = 3, n: int = 12, seed: int = 0) -> InitialConditions:
    """Moving, slightly overlapping objects above the floor, with different materials."""
    rng = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=rng, dtype=torch.float64)

    centre = torch.cat([0.2 * rand(b, o, 2), rand(b, o, 1) * 0.2 - 0.8], -1)
    points = centre[:, :, None] + 0.3 * (rand(b, o, n, 3) - 0.5)
    return InitialConditions.of(
        points, mass=0.5 + rand(b, o), E=10 ** (3 + 4 * rand(b, o)), nu=0.2 + 0.2 * rand(b, o), friction=rand(b, o),
        velocity=rand(b, o, 3) - 0.5, spin=2 * (rand(b, o, 3) - 0.5),
    )  # fmt: skip


def add_padding(initial: InitialConditions, objects: int, keypoints: int) -> InitialConditions:
    """The same scenes with `objects` and `keypoints` of padding; padded fields hold arbitrary values."""
    b, o, n, _ = initial.points.shape
    valid = torch.zeros(b, o + objects, n + keypoints, dtype=torch.bool)
    valid[:, :o, :n] = initial.valid
    points = torch.full((b, o + objects, n + keypoints, 3), 7.0, dtype=initial.points.dtype)
    points[:, :o, :n] = initial.points

    def extended(x: Tensor, value: float) -> Tensor:
        return torch.cat([x, x.new_full((b, objects, *x.shape[2:]), value)], 1)

    return InitialConditions.of(
        points, valid, mass=extended(initial.mass, 3.0), E=extended(initial.E, 2e4), nu=extended(initial.nu, 0.1),
        friction=extended(initial.friction, 0.7),
        velocity=extended(initial.velocity, 1.0), spin=extended(initial.spin, 1.0),
        gravity=initial.gravity, box=extended(initial.box, 5.0),
    )  # fmt: skip


def external_force(
    initial: InitialConditions, row: int, force=(0.0, 0.0, 0.0), torque=(0.0, 0.0, 0.0), start=-1.0, end=1e9, point=-1
) -> ExternalForces:
    """The same external force on object `row` of every scene."""
    b = len(initial)
    dtype = {"dtype": initial.points.dtype}
    return ExternalForces(
        torch.full((b, 1), row), torch.tensor(force, **dtype).expand(b, 1, 3),
        torch.tensor(torque, **dtype).expand(b, 1, 3), torch.full((b, 1), start, **dtype),
        torch.full((b, 1), end, **dtype), torch.full((b, 1), point), ExternalForces.none(initial).pinned,
    )  # fmt: skip
