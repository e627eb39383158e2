"""Particles of the same bodies at twice the resolution.

Sampling the Gaussians again at a finer spacing would expose gaps in their shells and leave bodies hollow. Instead each
voxel is subdivided, which keeps shape and mass.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage

from stages.core.physics.particles import CROSS, Bodies


def subdivide(bodies: Bodies, seed: int = 0) -> Bodies:
    """Replace each particle by eight at half the spacing; rows are ordered by body.

    Thick bodies leave their outermost layer of voxels empty. That layer becomes half as thick, so they grow by as much.
    """
    h, rng, taken, x, volume, body = bodies.spacing, np.random.default_rng(seed), None, [], [], []
    for n in range(int(bodies.body.max()) + 1):
        mine = bodies.body == n
        total = float(bodies.volume[mine].sum())
        fine = _split_voxels(np.floor(bodies.x[mine].double().numpy() / h).astype(np.int64))
        if total > 1.001 * h**3 * int(mine.sum()):  # the particles also carry the mass of the empty layer
            fine = _dilated(fine)
        if taken is not None:
            free = ~np.isin(_keys(fine), _keys(taken))
            fine = fine[free] if free.any() else fine
        taken = fine if taken is None else np.concatenate([taken, fine])
        x.append((fine + 0.5 + 0.5 * (rng.random(fine.shape) - 0.5)) * h / 2)
        volume.append(torch.full((len(fine),), total / len(fine)))
        body.append(torch.full((len(fine),), n))
    return Bodies(torch.from_numpy(np.concatenate(x)).float(), torch.cat(body), torch.cat(volume), h / 2)


def _split_voxels(voxels: np.ndarray) -> np.ndarray:
    """The eight half-size voxels of each voxel, all of shape (m, 3)."""
    corners = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    return (2 * voxels[:, None] + corners).reshape(-1, 3)


def _dilated(voxels: np.ndarray) -> np.ndarray:
    """The voxels and their face neighbours."""
    low = voxels.min(0) - 1
    solid = np.zeros(voxels.max(0) - low + 2, bool)
    solid[tuple((voxels - low).T)] = True
    return np.argwhere(ndimage.binary_dilation(solid, CROSS)) + low


def _keys(voxels: np.ndarray) -> np.ndarray:
    """A unique integer for each voxel."""
    a, b, c = (voxels + 2**20).T
    return (a << 42) | (b << 21) | c
