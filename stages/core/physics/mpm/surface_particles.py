"""Resample the particles of bodies so that they follow the smooth surface, at the same or a finer spacing.

At the surface of a thick body, a particle carries only the volume of the filled part of its voxel, which follows from
the signed distance to the planes fitted to the surface samples (`solid_surface.py`). With whole voxels, an inclined
surface would be a staircase, and two such surfaces would interlock. Sheets, and the parts by which a body is extended
down to the floor, keep whole voxels.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy import ndimage

from stages.core.physics.morphology import surrounded
from stages.core.physics.particles import Bodies
from stages.core.physics.solid_surface import SolidSurface, solid_surface
from stages.core.scene.scene import Scene

MIN_FRACTION = 0.1  # filled fraction of a voxel below which it has no particle
THICK = 0.75  # depth below the surface reached only in parts thicker than sheets [voxels of `bodies`]
SHEET = 2.25  # depth below the surface not reached in sheets or parts of up to four voxels [voxels of the surface]


def surface_particles(scene: Scene, bodies: Bodies, refinement: int = 1, seed: int = 0) -> Bodies:
    """Resample bodies at `spacing / refinement`; rows are ordered by body.

    `bodies` must have a particle in each voxel, up to the surface (`skin` of `sample_bodies`). Where bodies overlap,
    smaller ones take precedence, so that the bodies together never fill more than a voxel's volume.
    """
    h = bodies.spacing / refinement
    voxels = np.floor(bodies.x.double().numpy() / bodies.spacing).astype(np.int64)
    filled = _without_overlap(
        [
            _filled(
                voxels[(bodies.body == row).numpy()],
                refinement,
                h,
                solid_surface(scene, o.id, seed).fitted,
                row in bodies.extended,
            )
            for row, o in enumerate(scene.objects)
        ]
    )
    rng = np.random.default_rng(seed)
    x = [(cells + 0.5 + 0.5 * (rng.random(cells.shape) - 0.5)) * h for cells, _ in filled]
    body = torch.arange(len(x)).repeat_interleave(torch.tensor([len(p) for p in x]))
    volume = torch.from_numpy(np.concatenate([fraction for _, fraction in filled])).float() * h**3
    return Bodies(torch.from_numpy(np.concatenate(x)).float(), body, volume, h)


def _filled(
    voxels: np.ndarray, refinement: int, h: float, surface: SolidSurface, extended: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Cells (m, 3) of edge h in and at a body of voxels, and their filled fractions (m,).

    Thick parts are the cells inside the surface within sqrt(3) core depths of a core of that depth, which reaches the
    corners of boxes, and the cells outside the surface next to them. In an `extended` body whole voxels stay below it.
    """
    low = voxels.min(0) - 2
    body = np.zeros(voxels.max(0) - low + 3, bool)
    body[tuple((voxels - low).T)] = True
    for axis in range(3):
        body = body.repeat(refinement, axis)
    low = low * refinement
    near = surrounded(body, refinement)
    depth = np.full(body.shape, -np.inf)
    depth[near] = surface.depth((np.argwhere(near) + low + 0.5) * h) / h
    core = max(THICK * refinement, SHEET * surface.h / h)
    inside = depth > 0
    thick = surrounded(depth > core, math.ceil(math.sqrt(3) * core)) & inside
    if inside.any():
        thick = thick[tuple(ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True))]
    if extended:
        thick &= inside | ~np.logical_or.accumulate(inside[:, :, ::-1], 2)[:, :, ::-1]
    fraction = np.where(thick, (depth + 0.5).clip(0, 1), body)
    fraction[fraction < MIN_FRACTION] = 0
    cells = np.argwhere(fraction)
    return cells + low, fraction[tuple(cells.T)]


def _without_overlap(filled: list[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Reduce the filled fractions so that they sum to at most one per cell; smaller bodies take precedence."""
    every = np.concatenate([cells for cells, _ in filled])
    span = np.ptp(every, axis=0) + 1
    every = (every - every.min(0)) @ np.array([span[1] * span[2], span[2], 1])
    place = np.unique(every, return_inverse=True)[1]
    taken, out = np.zeros(place.max() + 1), list(filled)
    rows = np.split(place, np.cumsum([len(cells) for cells, _ in filled])[:-1])
    for i in sorted(range(len(filled)), key=lambda i: filled[i][1].sum()):
        cells, fraction = filled[i]
        left = np.minimum(fraction, 1 - taken[rows[i]])
        kept = left >= min(MIN_FRACTION, fraction.min())
        if kept.any():
            out[i] = cells[kept], left[kept]
            taken[rows[i][kept]] += left[kept]
    return out
