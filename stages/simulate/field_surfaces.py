"""Surfaces of a scene's objects for the contacts of the learned field, in model units and the frames of its bodies.

An object that fills its convex hull has that of its Gaussians as its surface, as for rigid bodies, so that faces are
flat and edges sharp. Those of others are known to a voxel.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import ConvexHull, cKDTree
from torch import Tensor

from stages.core.geometry.extremes import extreme_rows, fibonacci
from stages.core.geometry.surface_faces import FACE_COSINE, NEAR, nearest_points, surface_faces
from stages.core.kernels.threads import parallel_map
from stages.core.models.field.body_surfaces import BodyGrid, BodySurfaces
from stages.core.models.initial_conditions import InitialConditions, centre_of_mass
from stages.core.physics.keypoints import farthest_points
from stages.core.physics.rigid_shapes import balls, convex_hulls
from stages.core.physics.solid_surface import SolidSurface, solid_surface
from stages.core.scene.scene import Scene
from stages.simulate.model_units import ModelUnits

SAMPLES = 512  # points of a body that are looked up in others, about a twentieth of its size apart
BALL_DIRECTIONS = 2000  # in which a ball is looked up in others at the start: to .001 radii
BLOCK = 1024  # points of which the distances from all faces stay in the cache
ON_EDGE = 1e-3  # difference of distances from two faces below which a point is on the edge between them [voxels]


def body_surfaces(
    scene: Scene, initial: InitialConditions, units: ModelUnits, lift: Float[Tensor, "o 3"],
    floors: Float[Tensor, "o"], seed: int,
) -> BodySurfaces:  # fmt: skip
    """The surfaces of all objects, each cut off at its floor [scene units], and their overlaps at the start."""
    com = centre_of_mass(initial, initial.points)
    arms = torch.where(initial.valid[..., None], initial.points - com[:, :, None], 0.0)[0]
    floor = float(floors.min())
    found, hulls = balls(scene, seed, floor), convex_hulls(scene, seed, floor)

    def grid(row: int) -> BodyGrid:
        start = units.to_model(lift[row]) - com[0, row]  # of the origin of the scene, in the body's frame
        shape = _Shape(solid_surface(scene, scene.objects[row].id, seed).fitted, hulls[row], float(floors[row]))
        out = _grid(shape, arms[row, initial.valid[0, row]], start, units.length, seed)
        if (ball := found[row]) is None:
            return out
        centre = start + units.length * torch.from_numpy(ball.centre).float()
        return replace(out, ball=(centre, units.length * ball.radius))

    grids = parallel_map(grid, range(len(scene.objects)))
    surfaces = BodySurfaces.of(grids)
    return replace(surfaces, overlap=_overlaps(surfaces, com[0]))


class _Shape:
    """The surface of an object above a floor, in scene units."""

    def __init__(self, surface: SolidSurface, hull: ConvexHull | None, floor: float):
        """`hull` of an object that fills it."""
        self.surface, self.hull, self.floor = surface, hull, floor

    def depth_grid(self) -> tuple[np.ndarray, np.ndarray]:
        """As that of SolidSurface."""
        depth, first = self.surface.depth_grid()
        if self.hull is not None:
            depth = depth.copy()
            near = np.argwhere(np.abs(depth) < NEAR * self.surface.h)
            at = (first + self.surface.h * near).astype(np.float32)  # half the time of double precision
            blocks = np.split(at, range(BLOCK, len(at), BLOCK))
            depth[tuple(near.T)] = -np.concatenate([self._beyond_faces(x).max(1) for x in blocks])
        height = first[2] + self.surface.h * np.arange(depth.shape[2]) - self.floor
        return np.minimum(depth, height), first

    def points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points (p, 3) of the surface, outward normals (p, 3), and which (p,) are at edges and corners of a hull."""
        if self.hull is None:
            points, normals = self.surface.samples_above(self.floor)
            at_edge = np.zeros(len(points), bool)
        else:
            points = self.surface.points[self.surface.thinned()]
            beyond, faces = self._beyond_faces(points), self._faces[:, :3]
            highest = beyond.max(1, keepdims=True)
            face = (beyond >= highest - ON_EDGE * self.surface.h).argmax(1)
            on_faces = points - highest * faces[face]
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
        """Normals and offsets (f, 4) of the planes that bound it, 0 of them if it does not fill its hull."""
        if self.hull is None:
            return np.zeros((0, 4))
        return np.concatenate([self._faces, [[0.0, 0.0, -1.0, self.floor]]])

    @cached_property
    def _faces(self) -> np.ndarray:
        """Normals and offsets (f, 4) of the hull's faces, one for those in a plane."""
        size = np.ptp(self.hull.points, axis=0).max()
        _, first = np.unique((self.hull.equations / [1, 1, 1, size]).round(5), axis=0, return_index=True)
        return self.hull.equations[first]

    def _beyond_faces(self, x: np.ndarray) -> np.ndarray:
        """Distances (k, f) of points (k, 3) from the planes of the hull's faces, negative inside."""
        faces = self._faces.astype(x.dtype)
        return x @ faces[:, :3].T + faces[:, 3]


def _grid(shape: _Shape, arm: Float[Tensor, "n 3"], start: Float[Tensor, "3"], length: float, seed: int) -> BodyGrid:
    """The grid of a body with keypoints at `arm` [m]; `start` is the origin of the scene in the body's frame [m]."""
    depth, first = shape.depth_grid()
    low, h = start + length * torch.from_numpy(first).float(), length * shape.surface.h
    points, normals, at_edge = shape.points()
    flatness, faces = surface_faces(points, normals, at_edge)
    outer = extreme_rows(points)
    others = farthest_points(torch.from_numpy(points), SAMPLES - len(outer), seed).numpy()
    row = np.union1d(outer, others)  # the outermost, and others far from each other
    points = start.numpy() + length * points
    grid = length * depth, low.numpy(), h
    keypoint, nearest = nearest_points(arm.numpy(), *grid).clip(0), nearest_points(points, *grid)
    smooth = ndimage.gaussian_filter(depth, 1.0)
    on_grid = (torch.from_numpy(length * x).float() for x in (depth, smooth))
    near = cKDTree(arm.numpy()).query(points[row])[1]
    at, normals, flatness, faces = (torch.from_numpy(x).float() for x in (points[row], normals[row], flatness, faces))
    near, row, keypoint, nearest = map(torch.from_numpy, (near, row, keypoint, nearest))
    planes = torch.from_numpy(shape.planes())
    offsets = length * planes[:, 3] - planes[:, :3] @ start.double()
    hull = torch.cat([planes[:, :3], offsets[:, None]], 1).float()
    return BodyGrid(*on_grid, keypoint, low, h, at, normals, near, row, flatness, faces, nearest, hull=hull)


def _overlaps(surfaces: BodySurfaces, com: Float[Tensor, "o 3"]) -> Float[Tensor, "o o"]:
    """How deep each body is in each other one [m]: of balls their surfaces, as in contacts, of others their samples."""
    centre, radius = com + surfaces.centre, surfaces.radius
    directions = torch.from_numpy(fibonacci(BALL_DIRECTIONS)).float()
    out = torch.zeros(len(com), len(com))
    for a in range(len(com)):
        ball = radius[a] > 0
        x = centre[a] + radius[a] * directions if ball else com[a] + surfaces.samples[a, surfaces.near[a] >= 0]
        body = torch.arange(len(com)).repeat_interleave(len(x))
        depth, _ = surfaces.look_up(body, x.repeat(len(com), 1) - com[body])
        out[a] = depth.view(len(com), -1).amax(1).clamp_min(0)
    both = (radius > 0) & (radius[:, None] > 0)
    exact = (radius + radius[:, None] - torch.cdist(centre, centre)).clamp_min(0)
    return torch.where(both, exact, out).fill_diagonal_(0.0)
