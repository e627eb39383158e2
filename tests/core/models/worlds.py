"""Small worlds and models for the tests of dynamics models."""

import torch
from torch import Tensor

from stages.core.models.checkpoints import build
from stages.core.models.dynamics import Dynamics
from stages.core.models.external_forces import Pushes
from stages.core.models.initial_conditions import World

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


def crowd(b: int = 2, o: int = 3, n: int = 12, seed: int = 0) -> World:
    """Objects that overlap a little above the floor, all materials and sizes different; everything moves."""
    rng = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=rng, dtype=torch.float64)

    place = torch.cat([0.2 * rand(b, o, 2), rand(b, o, 1) * 0.2 - 0.8], -1)
    points = place[:, :, None] + 0.3 * (rand(b, o, n, 3) - 0.5)
    return World.of(
        points, mass=0.5 + rand(b, o), E=10 ** (3 + 4 * rand(b, o)), nu=0.2 + 0.2 * rand(b, o), friction=rand(b, o),
        velocity=rand(b, o, 3) - 0.5, spin=2 * (rand(b, o, 3) - 0.5),
    )  # fmt: skip


def padded(world: World, objects: int, keypoints: int) -> World:
    """The same world with room for more; the padding of the fields is rubbish, which nobody may read."""
    b, o, n, _ = world.points.shape
    valid = torch.zeros(b, o + objects, n + keypoints, dtype=torch.bool)
    valid[:, :o, :n] = world.valid
    points = torch.full((b, o + objects, n + keypoints, 3), 7.0, dtype=world.points.dtype)
    points[:, :o, :n] = world.points

    def more(x: Tensor, value: float) -> Tensor:
        return torch.cat([x, x.new_full((b, objects, *x.shape[2:]), value)], 1)

    return World.of(
        points, valid, mass=more(world.mass, 3.0), E=more(world.E, 2e4), nu=more(world.nu, 0.1),
        friction=more(world.friction, 0.7), velocity=more(world.velocity, 1.0), spin=more(world.spin, 1.0),
        gravity=world.gravity, box=more(world.box, 5.0),
    )  # fmt: skip


def push(
    world: World, row: int, force=(0.0, 0.0, 0.0), torque=(0.0, 0.0, 0.0), start=-1.0, end=1e9, point=-1
) -> Pushes:
    """One push in every scene."""
    b = len(world)
    real = {"dtype": world.points.dtype}
    return Pushes(
        torch.full((b, 1), row), torch.tensor(force, **real).expand(b, 1, 3),
        torch.tensor(torque, **real).expand(b, 1, 3), torch.full((b, 1), start, **real),
        torch.full((b, 1), end, **real), torch.full((b, 1), point), Pushes.none(world).pinned,
    )  # fmt: skip
