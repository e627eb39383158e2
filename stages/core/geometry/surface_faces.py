"""The faces that meet at points of a surface, from the points around them.

At an edge the normals of points are between those of the faces, and so is the direction in which signed distances
increase. A contact acts along the normal of a face.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

NEIGHBOURS = 6  # points, with itself, whose normals decide whether one is on a face
OTHER_SIDE = -0.5  # cosine to its normal below which they are on the other side of a sheet
FACE_COSINE = 0.97  # least length of the mean of their normals, .71 at a cube's edges and .58 at its corners
AROUND = 24  # nearest points among which the faces at an edge or a corner are
SAME_FACE = 0.9  # least cosine between normals of one face
NEAR = 4  # edges of a grid from the surface up to which the nearest point is looked for
FACES = 3  # that meet in a corner, at most
BETWEEN = 0.5  # least cosine of a normal between those of faces to one of them, .58 at a cube's corners
OPPOSED = 0.9  # least cosine of the angle at which the faces of two surfaces are parallel, at the edges of both
CURVED = 5e-4  # difference of flatness that counts: a plane has 1, a ball of 2000 points .998


def surface_faces(
    points: np.ndarray, normals: np.ndarray, at_edge: np.ndarray | bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """How flat (n,) the surface is at points (n, 3) with outward normals (n, 3), and the normals (n, 3, 3) of the faces
    at each: that of its face, or of up to three around it; the others are 0.

    Those `at_edge` (n,) are known not to be on a face, even where all points around them are in one place. Flatness
    is 1 in a plane, and 0 where a point is not on a face.
    """
    near = cKDTree(points).query(points, min(AROUND, len(points)))[1].reshape(len(points), -1)
    around = normals[near[:, :NEIGHBOURS]]
    same_side = (around * normals[:, None]).sum(-1) > OTHER_SIDE
    mean = (around * same_side[..., None]).sum(1) / same_side.sum(1, keepdims=True).clip(1)
    flatness = np.linalg.norm(mean, axis=1)
    on_face = (flatness > FACE_COSINE) & ~np.asarray(at_edge)
    faces, count = np.zeros((len(points), FACES, 3)), np.zeros(len(points), np.int64)
    faces[on_face, 0], count[on_face] = normals[on_face], FACES
    for row in near.T:
        known = ((faces * normals[row, None]).sum(-1) > SAME_FACE).any(1)
        new = np.flatnonzero(on_face[row] & ~known & (count < FACES))
        faces[new, count[new]] = normals[row[new]]
        count[new] += 1
    # a face that is too small to have inner points; the normals of corners are those of no face
    small = ((faces * normals[:, None]).sum(-1).max(1) < BETWEEN) & ~np.asarray(at_edge)
    faces[small, 1:], faces[small, 0] = faces[small, :-1], normals[small]
    return np.where(on_face, flatness, 0.0), faces


def nearest_points(points: np.ndarray, depth: np.ndarray, low: np.ndarray, h: float) -> np.ndarray:
    """For the nodes near the surface of a grid of depths (x, y, z), which begins at `low` (3,) and has edges h, the row
    of the nearest of some points (n, 3); -1 for the other nodes.
    """
    out = np.full(depth.shape, -1)
    if len(points):
        near = np.argwhere(np.abs(depth) < NEAR * h)
        out[tuple(near.T)] = cKDTree(points).query(low + h * near)[1]
    return out
