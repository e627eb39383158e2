"""Morphological operations on voxel masks by shifted copies: several times as fast as scipy.ndimage for small radii.

Voxels outside the grid count as empty, except that distances are measured within the grid.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, UInt

Mask = Bool[np.ndarray, "x y z"]


def _along(array: np.ndarray, axis: int) -> np.ndarray:
    """A view with this axis first."""
    return np.moveaxis(array, axis, 0)


def dilated(mask: Mask, iterations: int = 1) -> Mask:
    """The mask dilated by the 6-neighbourhood (voxels that share a face), repeatedly."""
    for _ in range(iterations):
        before, mask = mask, mask.copy()
        for axis in range(3):
            out, given = _along(mask, axis), _along(before, axis)
            out[1:] |= given[:-1]
            out[:-1] |= given[1:]
    return mask


def eroded(mask: Mask, iterations: int = 1) -> Mask:
    """The mask eroded by the 6-neighbourhood (voxels that share a face), repeatedly."""
    for _ in range(iterations):
        before, mask = mask, mask.copy()
        for axis in range(3):
            out, given = _along(mask, axis), _along(before, axis)
            out[1:] &= given[:-1]
            out[:-1] &= given[1:]
            out[0] = out[-1] = False
    return mask


def surrounded(mask: Mask, iterations: int = 1) -> Mask:
    """The mask dilated by the 26-neighbourhood (voxels that share a face, an edge or a corner), repeatedly."""
    for _ in range(iterations):
        for axis in range(3):
            given = _along(mask, axis)
            mask = mask.copy()
            out = _along(mask, axis)
            out[1:] |= given[:-1]
            out[:-1] |= given[1:]
    return mask


def opened(mask: Mask) -> Mask:
    """Opening of the mask by a cube: the union of all cubes of 2 x 2 x 2 voxels inside it."""
    for axis in range(3):
        given = _along(mask, axis)
        mask = np.moveaxis(given[1:] & given[:-1], 0, axis)
    for axis in range(3):
        given = _along(mask, axis)
        wider = np.zeros((len(given) + 1, *given.shape[1:]), bool)
        wider[1:] = given
        wider[:-1] |= given
        mask = np.moveaxis(wider, 0, axis)
    return np.ascontiguousarray(mask)


def squared_distances(mask: Mask, most: int) -> UInt[np.ndarray, "x y z"]:
    """Squared distances to the nearest voxel of the mask [voxels^2]: exact up to most^2, and most^2 + 1 beyond."""
    beyond = most**2 + 1
    squared = np.where(mask, 0, beyond).astype(np.min_scalar_type(2 * beyond))
    for axis in range(3):
        given = _along(squared, axis)
        squared = squared.copy()
        out = _along(squared, axis)
        for k in range(1, min(most, len(given) - 1) + 1):
            np.minimum(out[k:], given[:-k] + squared.dtype.type(k * k), out=out[k:])
            np.minimum(out[:-k], given[k:] + squared.dtype.type(k * k), out=out[:-k])
    return np.minimum(squared, beyond)


def within(mask: Mask, radius: int) -> Mask:
    """The mask dilated by a ball of this radius [voxels], between voxel centres."""
    return squared_distances(mask, radius) <= radius**2
