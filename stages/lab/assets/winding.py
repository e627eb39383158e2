"""Consistent orientation of the faces of meshes that have inverted faces."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

MERGE_DISTANCE = 1e-6  # vertices closer than this are merged [longest sides]
MAX_OPEN_EDGES = 0.02  # largest fraction of open edges of a surface that counts as closed


def winding_signs(corners: np.ndarray) -> np.ndarray:
    """+1 for each triangle to keep and -1 for each to reverse, such that normals point outwards.

    `corners` (f, 3, 3) should be about 1 in size. Neighbouring faces of a connected surface get consistent
    orientations: outwards if the surface is closed (positive volume), otherwise that of the larger part of its area.
    Non-orientable surfaces are kept.
    """
    f = len(corners)
    _, vertex = np.unique(np.round(corners.reshape(-1, 3) / MERGE_DISTANCE), axis=0, return_inverse=True)
    vertex = vertex.reshape(f, 3)
    edges = np.stack([vertex, np.roll(vertex, -1, axis=1)], -1).reshape(-1, 2)
    _, edge, faces = np.unique(np.sort(edges, 1), axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    order = np.argsort(edge, kind="stable")
    first, second = order[faces[edge[order]] == 2].reshape(-1, 2).T
    a, b = first // 3, second // 3
    # node i: face i as given, node f + i: face i reversed; consistent neighbours traverse their edge oppositely
    consistent = edges[first, 0] != edges[second, 0]
    rows, columns = np.append(a, a + f), np.append(np.where(consistent, b, b + f), np.where(consistent, b + f, b))
    graph = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(2 * f, 2 * f))
    count, side = connected_components(graph, directed=False)
    total = lambda face, reverse: np.bincount(side, np.concatenate([face, reverse]), count)  # noqa: E731
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area, volume = np.linalg.norm(cross, axis=1), (corners.mean(1) * cross).sum(1)
    open_edges = (faces[edge] == 1).reshape(f, 3).sum(1)
    closed = total(open_edges, open_edges) <= MAX_OPEN_EDGES * total(np.full(f, 3), np.full(f, 3))
    score = np.where(closed, total(volume, -volume), total(area, 0 * area))
    return np.where(score[side[:f]] >= score[side[f:]], 1.0, -1.0)
