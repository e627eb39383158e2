"""Simple motions for tests of training."""

from dataclasses import replace

import torch

from stages.core.models.initial_conditions import BOX, GRAVITY
from stages.lab.dataset.keypoint_motions import KeypointMotions

DT = 0.02
FLOOR = BOX[0][2]


def falling(scenes: int = 6, frames: int = 12, objects: int = 2, n: int = 8, seed: int = 0) -> KeypointMotions:
    """Balls of points that fall from different heights and stop when their lowest point reaches the floor."""
    rng = torch.Generator().manual_seed(seed)
    shape = 0.1 * torch.nn.functional.normalize(torch.randn(scenes, objects, n, 3, generator=rng), dim=-1)
    centre = torch.rand(scenes, objects, 3, generator=rng) - 0.5
    centre[..., 2] = FLOOR + 0.1 + 0.1 * torch.rand(scenes, objects, generator=rng)
    start = centre[:, :, None] + shape
    fallen = -GRAVITY[2] * (DT * torch.arange(frames)).square() / 2
    room = start[..., 2].amin(-1) - FLOOR
    points = start[:, None].repeat(1, frames, 1, 1, 1)
    points[..., 2] -= torch.minimum(fallen[None, :, None], room[:, None])[..., None]
    one = torch.ones(scenes, objects)
    ids = torch.arange(objects).expand(scenes, objects).clone()
    return KeypointMotions(tuple(map(str, range(scenes))), ids, points, 0.1 * one, 1e5 * one, 0.3 * one, 0.5 * one, DT,
                   GRAVITY, BOX, one)  # fmt: skip


def without_last(motions: KeypointMotions) -> KeypointMotions:
    """The motions with the last object of scene 0 replaced by padding."""
    ids, points = motions.objects.clone(), motions.points.clone()
    ids[0, -1], points[0, :, -1] = -1, 0
    return replace(motions, objects=ids, points=points)
