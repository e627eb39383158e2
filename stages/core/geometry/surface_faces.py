"""Normals of the faces that meet at each point of a sampled surface.

Near an edge, both the normals of the samples and the gradient of the signed distance lie between the normals of the
adjacent faces. A contact force, however, acts along the normal of a face, so faces are found from neighbouring samples.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

NEIGHBOURS = 6  # nearest points, including itself, whose normals decide whether a point is on a face
OTHER_SIDE = -0.5  # cosine between two normals below which their points are on different sides of a sheet
FACE_COSINE = 0.97  # minimum length of the mean normal around a point on a face; .71 at a cube's edge, .58 at a corner
AROUND = 24  # nearest points among which the faces at an edge or a corner are searched
SAME_FACE = 0.9  # minimum cosine between two normals of one face
NEAR = 4  # distance from the surface up to which a grid node gets its nearest point [grid spacing]
FACES = 3  # maximum number of faces that meet at a point
BETWEEN = 0.5  # minimum cosine between a point's normal and the nearest of its faces' normals; .58 at a cube's corners
OPPOSED = 0.9  # minimum cosine between one face normal and the reverse of another at which two faces are parallel
CURVED = 5e-4  # minimum significant difference of flatness, which is 1 for a plane and .998 for a ball of 2000 points


def surface_faces(
    points: np.ndarray, normals: np.ndarray, at_edge: np.ndarray | bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Flatness (n,) of the surface at points (n, 3) with outward normals (n, 3), and normals (n, 3, 3) of the faces.

    A point on a face has the normal of that face, other points those of up to three adjacent ones; unused rows are 0.
    Flatness is 1 in a plane, and 0 if a point is not on a face. Points `at_edge` (n,) are known not to be on a face,
    even if the neighbouring points coincide.
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
    # the point's own face is too small to have inner points; at corners, a point's normal is that of no face
    small = ((faces * normals[:, None]).sum(-1).max(1) < BETWEEN) & ~np.asarray(at_edge)
    faces[small, 1:], faces[small, 0] = faces[small, :-1], normals[small]
    return np.where(on_face, flatness, 0.0), faces


def nearest_points(points: np.ndarray, depth: np.ndarray, low: np.ndarray, h: float) -> np.ndarray:
    """Row of the nearest of the points (n, 3) for each node (x, y, z) of a grid near the surface; -1 for other nodes.

    `depth` (x, y, z) is the depth below the surface at the nodes, `low` (3,) the first node, and `h` the grid spacing.
    """
    out = np.full(depth.shape, -1)
    if len(points):
        near = np.argwhere(np.abs(depth) < NEAR * h)
        out[tuple(near.T)] = cKDTree(points).query(low + h * near)[1]
    return out
