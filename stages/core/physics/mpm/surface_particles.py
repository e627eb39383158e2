"""Particles of bodies with smooth surfaces, at the same or a finer spacing.

Where the voxels of a thick body end at its surface, particles carry the volume of the filled part of their voxel, which
follows from the signed distance to the surface, by planes fitted to its samples (`solid_surface.py`). With whole voxels
an inclined surface would be a staircase, and two of them would interlock. Sheets and what is reconstructed only as
voxels keep whole voxels.
"""

from __future__ import annotations

import numpy as np
import torch

from stages.core.physics.morphology import surrounded
from stages.core.physics.particles import Bodies
from stages.core.physics.solid_surface import SolidSurface, solid_surface
from stages.core.scene.scene import Scene

MIN_FRACTION = 0.1  # filled fraction of a voxel below which it has no particle
THICK = 0.75  # depth of the middle of what is thicker than sheets, which are thickened to three voxels [voxels]
SHEET = 2.5  # depth of the middle of thickened sheets, at most [voxels of the surface]


def surface_particles(scene: Scene, bodies: Bodies, refinement: int = 1, seed: int = 0) -> Bodies:
    """Particles of the same bodies at `spacing / refinement`; rows are ordered by body.

    `bodies` have a particle in each voxel, up to the surface (`skin` of `sample_bodies`). Where bodies overlap, smaller
    ones keep their volume, and a voxel is filled by at most its volume in all.
    """
    h = bodies.spacing / refinement
    voxels = np.floor(bodies.x.double().numpy() / bodies.spacing).astype(np.int64)
    filled = _without_overlap(
        [
            _filled(voxels[(bodies.body == row).numpy()], refinement, h, solid_surface(scene, o.id, seed).fitted)
            for row, o in enumerate(scene.objects)
        ]
    )
    rng = np.random.default_rng(seed)
    x = [(cells + 0.5 + 0.5 * (rng.random(cells.shape) - 0.5)) * h for cells, _ in filled]
    body = torch.arange(len(x)).repeat_interleave(torch.tensor([len(p) for p in x]))
    volume = torch.from_numpy(np.concatenate([fraction for _, fraction in filled])).float() * h**3
    return Bodies(torch.from_numpy(np.concatenate(x)).float(), body, volume, h)


def _filled(voxels: np.ndarray, refinement: int, h: float, surface: SolidSurface) -> tuple[np.ndarray, np.ndarray]:
    """Cells (m, 3) of edge h in and at a body of voxels, and the fractions (m,) of them that are filled."""
    low = voxels.min(0) - 2
    body = np.zeros(voxels.max(0) - low + 3, bool)
    body[tuple((voxels - low).T)] = True
    for axis in range(3):
        body = body.repeat(refinement, axis)
    low = low * refinement
    near = surrounded(body, refinement)
    depth = np.full(body.shape, -np.inf)
    depth[near] = surface.depth((np.argwhere(near) + low + 0.5) * h) / h
    thick = surrounded(depth > max(THICK * refinement, SHEET * surface.h / h), 2 + refinement)
    fraction = np.where(thick, (depth + 0.5).clip(0, 1), body)
    fraction[fraction < MIN_FRACTION] = 0
    cells = np.argwhere(fraction)
    return cells + low, fraction[tuple(cells.T)]


def _without_overlap(filled: list[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The fractions of cells of bodies, of which smaller ones come first, reduced to a sum of at most one."""
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
