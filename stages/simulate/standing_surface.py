"""Surfaces of objects above the floor, for the contacts of rigid bodies.

The surface of an object that fills its convex hull is the hull, so that faces are flat and edges sharp. Other surfaces
are accurate to one voxel.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull

from stages.core.geometry.surface_faces import FACE_COSINE, NEAR
from stages.core.physics.solid_surface import SolidSurface

BLOCK = 1024  # number of points processed at once, so that their distances from all faces stay in the CPU cache
OUTSIDE = 0.05  # distance outside a hull up to which points count as on it [voxels]
ON_EDGE = 1e-3  # difference of the distances from two faces below which a point is on the edge between them [voxels]


class StandingSurface:
    """The surface of an object above a floor, in scene units."""

    def __init__(self, surface: SolidSurface, hull: ConvexHull | None, floor: float):
        """`hull`: convex hull of an object that fills it, else None; `floor`: height of the floor."""
        self.surface, self.hull, self.floor = surface, hull, floor

    def depth_grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Depths at grid nodes (x, y, z) and the first node (3,), as by SolidSurface, cut off at the floor."""
        depth, first = self.surface.depth_grid()
        if self.hull is not None:
            depth = depth.copy()
            near = np.argwhere(np.abs(depth) < NEAR * self.surface.h)
            at = (first + self.surface.h * near).astype(np.float32)  # takes half the time of double precision
            blocks = np.split(at, range(BLOCK, len(at), BLOCK))
            depth[tuple(near.T)] = -np.concatenate([self._beyond_faces(x).max(1) for x in blocks])
        height = first[2] + self.surface.h * np.arange(depth.shape[2]) - self.floor
        return np.minimum(depth, height), first

    def points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Surface samples (p, 3), outward normals (p, 3), and a mask (p,) of samples at edges and corners of a hull."""
        if self.hull is None:
            points, normals = self.surface.samples_above(self.floor)
            at_edge = np.zeros(len(points), bool)
        else:
            points = self.surface.points[self.surface.thinned()]
            beyond, faces = self._beyond_faces(points), self._faces[:, :3]
            highest = beyond.max(1, keepdims=True)
            face = (beyond >= highest - ON_EDGE * self.surface.h).argmax(1)
            on_faces = points - highest * faces[face]
            kept = self._beyond_faces(on_faces).max(1) < OUTSIDE * self.surface.h  # the others are beyond an edge
            on_faces, face = on_faces[kept], face[kept]
            corners = self.hull.points[self.hull.vertices]
            nearest = self._beyond_faces(corners) > -self.surface.h
            mean = nearest.astype(float) @ faces / nearest.sum(1, keepdims=True)
            length = np.linalg.norm(mean, axis=1, keepdims=True)
            normals = np.concatenate([mean / length.clip(1e-9), faces[face]])
            points = np.concatenate([corners, on_faces])
            at_edge = np.append(length[:, 0] < FACE_COSINE, np.zeros(len(on_faces), bool))
        if (above := points[:, 2] > self.floor - self.surface.h).any():
            points = np.maximum(points[above], [-np.inf, -np.inf, self.floor])
            normals, at_edge = normals[above], at_edge[above]
        return points, normals, at_edge

    def planes(self) -> np.ndarray:
        """Normals and offsets (f, 4) of the bounding planes, the floor last; f = 0 if the object is not convex."""
        if self.hull is None:
            return np.zeros((0, 4))
        return np.concatenate([self._faces, [[0.0, 0.0, -1.0, self.floor]]])

    @cached_property
    def _faces(self) -> np.ndarray:
        """Normals and offsets (f, 4) of the hull's faces; coplanar facets are merged."""
        size = np.ptp(self.hull.points, axis=0).max()
        _, first = np.unique((self.hull.equations / [1, 1, 1, size]).round(5), axis=0, return_index=True)
        return self.hull.equations[first]

    def _beyond_faces(self, x: np.ndarray) -> np.ndarray:
        """Signed distances (k, f) of points (k, 3) from the planes of the hull's faces, negative inside."""
        faces = self._faces.astype(x.dtype)
        return x @ faces[:, :3].T + faces[:, 3]
