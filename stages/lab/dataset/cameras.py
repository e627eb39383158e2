"""The camera orbit from which the scenes of the data set are rendered."""

from __future__ import annotations

import torch

from stages.core.geometry.cameras import intrinsics, orbit
from stages.core.scene.cameras import Cameras
from stages.lab.dataset.selection import ORBIT_VIEWS

ORBIT_CENTRE, ORBIT_RADIUS, ORBIT_ELEVATION = (0.0, 0.0, -0.3), 4.0, 20.0  # [m], [m], [deg]
RELATIVE_FOCAL = 1.5  # focal length divided by the image width


def orbit_cameras(resolution: int) -> Cameras:
    """All cameras of the orbit for square images of `resolution` px; camera i has azimuth 120 + 3.6 i degrees.

    Source: public code of NGFF.
    """
    viewmats = orbit(ORBIT_VIEWS, torch.tensor(ORBIT_CENTRE), ORBIT_RADIUS, ORBIT_ELEVATION)
    K = intrinsics(resolution, resolution, RELATIVE_FOCAL * resolution)
    sizes = torch.full((ORBIT_VIEWS, 2), resolution)
    names = tuple(f"{i:05d}" for i in range(ORBIT_VIEWS))
    return Cameras(viewmats, K.expand(ORBIT_VIEWS, 3, 3).clone(), sizes, names)
