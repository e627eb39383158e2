"""Collision boxes for the background of a scene of photos: everything above the floor that is not an object.

Opaque Gaussians of the background are counted in an occupancy grid. Voxels next to an object, which may be its halo,
and small connected components are left out; the remaining voxels are merged into boxes.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from stages.core.physics.particles import usable
from stages.core.scene.scene import Scene

VOXELS_ALONG = 64  # voxels along the longest side of the grid
REACH = 0.5  # distance by which the grid extends beyond the objects, relative to their extent
OBSTACLE_OPACITY = 0.5  # opacity above which a Gaussian of the background is solid
MIN_COUNT = 2  # smallest number of Gaussians in an occupied voxel
MIN_HEIGHT = 2  # layers of voxels above the floor that are left out, since the floor itself is a plane [voxels]
MIN_GROUP = 20  # size of the smallest connected component that is kept [voxels]
Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def background_boxes(scene: Scene, floor: float) -> list[Box]:
    """Lower and upper corners of fixed boxes around the objects; `floor` is the height of the floor [scene units]."""
    g = scene.gaussians.to("cpu")
    good = usable(g) & (g.opacities > OBSTACLE_OPACITY)
    means, own = g.means[good].double().numpy(), (g.object_id[good] > 0).numpy()
    if not own.any():
        return []
    low, high = np.quantile(means[own], [0.01, 0.99], axis=0)
    reach = REACH * float((high - low).max())
    low, high = low - reach, high + reach
    h = float((high - low).max()) / VOXELS_ALONG
    low[2] = floor
    cells = np.floor((means - low) / h).astype(np.int64)
    shape = np.ceil((high - low) / h).astype(np.int64).clip(1)
    inside = ((cells >= 0) & (cells < shape)).all(1)
    count, objects = (np.zeros(shape, np.int32) for _ in range(2))
    np.add.at(count, tuple(cells[inside & ~own].T), 1)
    np.add.at(objects, tuple(cells[inside & own].T), 1)
    full = (count >= MIN_COUNT) & ~ndimage.binary_dilation(objects > 0, np.ones((3, 3, 3)))
    full[:, :, :MIN_HEIGHT] = False
    groups, number = ndimage.label(full, np.ones((3, 3, 3)))
    large = np.bincount(groups.ravel(), minlength=number + 1) >= MIN_GROUP
    large[0] = False
    return [(tuple(low + h * np.array(a)), tuple(low + h * np.array(b))) for a, b in merged(large[groups])]


def merged(full: np.ndarray) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Disjoint boxes that cover the occupied cells: first cell and one beyond the last.

    Greedy: each box grows from the first uncovered cell along z, then y, then x.
    """
    left, boxes = full.copy(), []
    for x, y, z in np.argwhere(full):
        if not left[x, y, z]:
            continue
        first, last = (x, y, z), [x + 1, y + 1, z + 1]
        for axis in (2, 1, 0):
            while last[axis] < full.shape[axis]:
                at = [slice(a, b) for a, b in zip(first, last, strict=True)]
                at[axis] = slice(last[axis], last[axis] + 1)
                if not left[tuple(at)].all():
                    break
                last[axis] += 1
        left[tuple(slice(a, b) for a, b in zip(first, last, strict=True))] = False
        boxes.append((first, tuple(last)))
    return boxes
