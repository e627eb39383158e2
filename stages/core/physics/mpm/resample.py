"""Particles of the same bodies at twice the resolution.

Sampling the Gaussians again at a finer spacing would expose gaps in their shells and leave bodies hollow. Instead each
voxel is subdivided, which keeps shape and mass.
"""

from __future__ import annotations

import numpy as np
import torch

from stages.core.physics.particles import Bodies


def subdivide(bodies: Bodies, seed: int = 0) -> Bodies:
    """Replace each particle by eight at half the spacing; rows are ordered by body.

    For bodies whose particles fill them up to the surface (`skin` of `sample_bodies`).
    """
    h, rng, x, volume, body = bodies.spacing, np.random.default_rng(seed), [], [], []
    for n in range(int(bodies.body.max()) + 1):
        mine = bodies.body == n
        total = float(bodies.volume[mine].sum())
        fine = _split_voxels(np.floor(bodies.x[mine].double().numpy() / h).astype(np.int64))
        x.append((fine + 0.5 + 0.5 * (rng.random(fine.shape) - 0.5)) * h / 2)
        volume.append(torch.full((len(fine),), total / len(fine)))
        body.append(torch.full((len(fine),), n))
    return Bodies(torch.from_numpy(np.concatenate(x)).float(), torch.cat(body), torch.cat(volume), h / 2)


def _split_voxels(voxels: np.ndarray) -> np.ndarray:
    """The eight half-size voxels of each voxel, all of shape (m, 3)."""
    corners = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    return (2 * voxels[:, None] + corners).reshape(-1, 3)
