"""The orbit from which the data set is seen."""

from __future__ import annotations

import torch

from stages.core.geometry.cameras import intrinsics, orbit
from stages.core.scene.cameras import Cameras
from stages.lab.dataset.layout import ORBIT_VIEWS

ORBIT_CENTRE, ORBIT_RADIUS, ORBIT_ELEVATION = (0.0, 0.0, -0.3), 4.0, 20.0  # [m], [deg]
RELATIVE_FOCAL = 1.5  # focal length over the side of the picture


def orbit_cameras(resolution: int) -> Cameras:
    """All of it; camera i has azimuth 120 + 3.6 i degrees."""
    viewmats = orbit(ORBIT_VIEWS, torch.tensor(ORBIT_CENTRE), ORBIT_RADIUS, ORBIT_ELEVATION)
    K = intrinsics(resolution, resolution, RELATIVE_FOCAL * resolution)
    sizes = torch.full((ORBIT_VIEWS, 2), resolution)
    return Cameras(viewmats, K.expand(ORBIT_VIEWS, 3, 3).clone(), sizes, tuple(f"{i:05d}" for i in range(ORBIT_VIEWS)))
