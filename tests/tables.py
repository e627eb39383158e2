"""Tables of Gaussians with known edges above the ground, and cameras that see them."""

import torch

from stages.core.geometry.cameras import intrinsics, orbit
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject

GROUND = -0.5
LOW, HIGH = (-0.35, -0.25), (0.35, 0.25)  # corners of the default table [m]


def level(height: float, low: tuple[float, float], high: tuple[float, float], spacing: float, grey: float) -> Gaussians:
    """Flat Gaussians in a horizontal rectangle."""
    xy = torch.cartesian_prod(*(torch.arange(a + spacing / 2, b, spacing) for a, b in zip(low, high, strict=True)))
    n = len(xy)
    return Gaussians(
        torch.cat([xy, torch.full((n, 1), height)], 1), torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.tensor([0.6 * spacing, 0.6 * spacing, 0.002]).repeat(n, 1), torch.full((n,), 0.99),
        torch.full((n, 1, 3), grey), torch.zeros(n, dtype=torch.int64),
    )  # fmt: skip


def around(count: int = 8, side: int = 120) -> Cameras:
    """Cameras on a circle, at a distance of 1.3 from the middle of the table, which see beyond all its edges."""
    viewmats = orbit(count, torch.zeros(3), 1.3, 40.0)
    K = intrinsics(side, side, float(side))
    names = tuple(f"{i:02d}.jpg" for i in range(count))
    return Cameras(viewmats, K.expand(count, 3, 3).clone(), torch.full((count, 2), side), names)


def table_scene(objects: Gaussians | None = None, low=LOW, high=HIGH, ground: float | None = GROUND) -> Scene:
    """A scene as reconstructed from photos: a table at height 0 above a larger ground."""
    parts = [level(0.0, low, high, 0.0125, 0.3)]
    parts += [] if ground is None else [level(ground, (-2, -2), (2, 2), 0.08, -0.3)]
    parts += [] if objects is None else [objects]
    numbers = [] if objects is None else objects.object_id.unique().tolist()
    things = tuple(SceneObject(i, f"body{i}") for i in numbers)
    scale = {"metres_per_unit": 1.0, "source": "test"}
    return Scene(concatenate(parts), things, around(), 0.0, scale, {"command": "reconstruct"})
