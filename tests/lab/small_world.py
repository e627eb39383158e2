"""A small data set for fast tests: objects of 600 Gaussians, coarse backgrounds, two scenes per group."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.scene.gaussians import Gaussians
from stages.lab.assets import backgrounds
from stages.lab.assets.objects import OBJECTS
from stages.lab.assets.shapes import box, to_gaussians
from stages.lab.dataset.options import DatasetOptions, Discretisation
from stages.lab.dataset.selection import SCENE_COUNTS

OPTIONS = DatasetOptions(
    groups="3_9", parts="scenes,mpm,initial,dynamic", frames=3, keypoints=64, dx=0.08, spacing=0.04, substep=2e-3,
    exact=True, views="0,16", backgrounds="table0", resolution=32,
)  # fmt: skip
COARSE = Discretisation(dx=0.08, spacing=0.03, substep=5e-4)


def brick() -> Gaussians:
    """A box with longest side 1, colours along it, SH of degree 2, and some Gaussians below the opacity threshold."""
    surface = box((1.0, 0.6, 0.4), 0.075)
    g = to_gaussians(surface, (surface.points + 0.5).clamp(0, 1), 1)
    sh = torch.nn.functional.pad(g.sh, (0, 0, 0, 8))
    sh[:, 1:] = 0.1 * torch.randn(sh[:, 1:].shape, generator=torch.Generator().manual_seed(0))
    opacities = g.opacities.clone()
    opacities[::50] = 0.01
    means = g.means / (g.means.amax(0) - g.means.amin(0)).max()
    return replace(g, means=means, sh=sh, opacities=opacities)


def box_shell(half: tuple[float, float, float], n: int = 150, seed: int = 0) -> Float[Tensor, "n 3"]:
    """Random points on the surface of a box with these half sides [m]."""
    rng = torch.Generator().manual_seed(seed)
    p = torch.rand(n, 3, generator=rng) * 2 - 1
    axis = torch.randint(3, (n,), generator=rng)
    p[torch.arange(n), axis] = p[torch.arange(n), axis].sign()
    return p * torch.tensor(half)


def shrink(setattr, setitem) -> None:
    """Make the data set small with the functions `setattr` and `setitem` of pytest's monkeypatch or equivalents."""
    for name, kind in list(OBJECTS.items()):
        setitem(OBJECTS, name, replace(kind, make="tests.lab.small_world:brick", E=min(kind.E, 1e5), scale=0.4))
    setitem(SCENE_COUNTS, "3_9", 2)
    setitem(SCENE_COUNTS, "4", 2)
    setattr(backgrounds, "TABLE_SPACING", 0.12)
    setattr(backgrounds, "ROOM_SPACING", 1.0)


def shrink_process() -> None:
    """Make the data set small for a whole process; it cannot be undone."""
    shrink(setattr, lambda table, key, value: table.__setitem__(key, value))
