"""The data set's world with objects of 600 Gaussians, coarse tables and two scenes a group, for tests in seconds."""

from __future__ import annotations

from dataclasses import replace

import torch

from stages.core.scene.gaussians import Gaussians
from stages.lab.assets import backgrounds
from stages.lab.assets.objects import OBJECTS
from stages.lab.assets.shapes import box, to_gaussians
from stages.lab.dataset.options import DatasetOptions
from stages.lab.dataset.scene_configs import SCENE_COUNTS

OPTIONS = DatasetOptions("3_9", "scenes,mpm,initial,dynamic", 3, 64, 0.08, 0.04, 2e-3, views="0,16",
                         backgrounds="table0", resolution=32, device="cpu")  # fmt: skip


def brick() -> Gaussians:
    """Longest side 1, a colour that changes along it, SH of degree 2, some Gaussians too faint to be matter."""
    surface = box((1.0, 0.6, 0.4), 0.075)
    g = to_gaussians(surface, (surface.points + 0.5).clamp(0, 1), 1)
    sh = torch.nn.functional.pad(g.sh, (0, 0, 0, 8))
    sh[:, 1:] = 0.1 * torch.randn(sh[:, 1:].shape, generator=torch.Generator().manual_seed(0))
    opacities = g.opacities.clone()
    opacities[::50] = 0.01
    means = g.means / (g.means.amax(0) - g.means.amin(0)).max()
    return replace(g, means=means, sh=sh, opacities=opacities)


def shrink(setattr, setitem) -> None:
    """Make the world small, by functions as of pytest's monkeypatch."""
    for name, kind in list(OBJECTS.items()):
        setitem(OBJECTS, name, replace(kind, make="tests.lab.small_world:brick", E=min(kind.E, 1e5), scale=0.4))
    setitem(SCENE_COUNTS, "3_9", 2)
    setitem(SCENE_COUNTS, "4", 2)
    setattr(backgrounds, "TABLE_SPACING", 0.12)
    setattr(backgrounds, "ROOM_SPACING", 1.0)


def shrink_for_good() -> None:
    """The same for a process of its own."""
    shrink(setattr, lambda table, key, value: table.__setitem__(key, value))
