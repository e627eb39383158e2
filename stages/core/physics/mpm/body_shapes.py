"""Signed distances to the surfaces of undeformed bodies, from which the MPM solver computes gaps between bodies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from stages.core.kernels.interop import view
from stages.core.kernels.mpm.contact import ContactBodies
from stages.core.physics.morphology import surrounded
from stages.core.physics.solid_surface import NEAREST, SAME_FACE, SolidSurface

SHEET = 0.5  # depth reached only in parts thicker than a texel, whose surface the lattice resolves [texels]
MARGIN = 5  # width of the lattice around a body [texels]; particles reach nodes within 1.5 cells of two texels each
PATCH = 0.75  # radius around a sample in which its tangent plane applies [sample spacing], about sqrt(1/2)


class BodyShape(NamedTuple):
    """Signed distance to the surface of a body on a lattice in its material coordinates."""

    distance: np.ndarray  # (x, y, z), negative inside [m]
    origin: np.ndarray  # (3,) position of the first texel [m]
    spacing: float  # of the texels [m]

    def scaled(self, unit: float) -> BodyShape:
        """The shape with all lengths multiplied by `unit`."""
        return BodyShape(self.distance * unit, self.origin * unit, self.spacing * unit)


def shape_of_voxels(x: np.ndarray, h: float, surface: SolidSurface | None = None) -> BodyShape:
    """The shape of a body with a particle in each voxel of edge h, at positions x (p, 3).

    Around thick parts the distance is to the planes fitted to the samples of `surface`, elsewhere to the voxel faces.
    """
    cells = np.floor(x / h).astype(np.int64)
    low = cells.min(0) - MARGIN
    full = np.zeros(cells.max(0) - low + 1 + MARGIN, bool)
    full[tuple((cells - low).T)] = True
    outside, nearest = ndimage.distance_transform_edt(~full, return_indices=True)
    distance = h * np.where(full, 0.5 - ndimage.distance_transform_edt(full), outside - 0.5)
    if surface is not None:
        centres = (np.indices(full.shape).reshape(3, -1).T + low + 0.5) * h
        deep = np.floor(surface.deeper_than(SHEET * h) / h).astype(np.int64) - low
        thick = np.zeros(full.shape, bool)
        thick[tuple(deep[((deep >= 0) & (deep < full.shape)).all(1)].T)] = True
        thick = surrounded(thick, 3)[tuple(nearest)]
        x = centres[thick.ravel()]
        distance[thick] = _distance(surface, x, surface.depth(x) > 0)
    return BodyShape(distance, (low + 0.5) * h, h)


def _distance(surface: SolidSurface, x: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Signed distances (k,) of points x (k, 3) to the planes of the nearest samples, or beside a patch to its rim."""
    points, normals = surface.fitted.points, surface.fitted.normals
    away, row = cKDTree(points).query(x, NEAREST)
    row = np.minimum(row, len(points) - 1)
    above = ((x[:, None] - points[row]) * normals[row]).sum(-1)
    agree = (normals[row] * normals[row[:, :1]]).sum(-1) > SAME_FACE
    beside = np.sqrt((away[:, 0] ** 2 - above[:, 0] ** 2).clip(0)) - PATCH * surface.spacing
    corner = np.where(inside, -1, 1) * np.hypot(above[:, 0], beside)
    return np.where(beside < 0, (above * agree).sum(1) / agree.sum(1), corner)


class BodyContact:
    """The shapes and friction coefficients of bodies in contact; `bodies` is the struct that the kernels read."""

    def __init__(self, shapes: Sequence[BodyShape], friction: Float[Tensor, "s"], device: str):
        self.count = len(shapes)
        texels = [_texels(s) for s in shapes]
        first = np.cumsum([0, *map(len, texels)])[:-1]
        columns = {
            "texels": (np.concatenate(texels), wp.vec4),
            "first": (first.astype(np.int32), None),
            "size": (np.array([s.distance.shape for s in shapes], np.int32), wp.vec3i),
            "origin": (np.array([s.origin for s in shapes], np.float32), wp.vec3),
            "spacing": (np.array([s.spacing for s in shapes], np.float32), None),
            "friction": (friction.float().cpu().numpy(), None),
            "all": (np.arange(len(shapes), dtype=np.int32), None),
        }
        self.bodies, self._tensors = ContactBodies(), {}
        for name, (values, kind) in columns.items():
            self._tensors[name] = torch.from_numpy(values).to(device).contiguous()
            setattr(self.bodies, name, view(self._tensors[name], kind))


def _texels(shape: BodyShape) -> np.ndarray:
    """Gradient and signed distance (x y z, 4) at each texel, flattened."""
    slope = np.stack(np.gradient(shape.distance, shape.spacing), -1)
    return np.concatenate([slope, shape.distance[..., None]], -1).reshape(-1, 4).astype(np.float32)
