"""Surfaces of a scene's objects for the contacts of the learned field, in model units and the frames of its bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from stages.core.models.field.body_surfaces import BodyGrid, BodySurfaces
from stages.core.models.initial_conditions import InitialConditions, centre_of_mass
from stages.core.physics.convex_cuts import EXTREMES
from stages.core.physics.convex_parts import balls
from stages.core.physics.keypoints import farthest_points
from stages.core.physics.solid_surface import SolidSurface, solid_surface
from stages.core.scene.scene import Scene
from stages.simulate.model_units import ModelUnits

SAMPLES = 512  # points of a body that are looked up in others, about a twentieth of its size apart
NEAR = 4  # voxels from the surface up to which the nearest keypoint is found


def body_surfaces(
    scene: Scene, initial: InitialConditions, units: ModelUnits, lift: Float[Tensor, "o 3"],
    floors: Float[Tensor, "o"], seed: int,
) -> BodySurfaces:  # fmt: skip
    """The surfaces of all objects, each cut off at its floor [scene units], and their overlaps at the start."""
    com = centre_of_mass(initial, initial.points)
    grids = []
    arms = torch.where(initial.valid[..., None], initial.points - com[:, :, None], 0.0)[0]
    found = balls(scene, seed, float(floors.min()))
    for row, o in enumerate(scene.objects):
        own = arms[row, initial.valid[0, row]]
        surface = solid_surface(scene, o.id, seed).fitted
        _, first = surface.depth_grid()
        start = units.to_model(lift[row]) - com[0, row]  # of the origin of the scene, in the body's frame
        grid = _grid(surface, float(floors[row]), own, start, units.length, seed)
        if (ball := found[row]) is not None:
            centre = start + units.length * torch.from_numpy(ball.centre).float()
            grid = replace(grid, ball=(centre, units.length * ball.radius))
        grids.append(grid)
    surfaces = BodySurfaces.of(grids)
    return replace(surfaces, overlap=_overlaps(surfaces, com[0]))


def _grid(
    surface: SolidSurface, floor: float, arm: Float[Tensor, "n 3"], start: Float[Tensor, "3"], length: float, seed: int
) -> BodyGrid:
    """The grid of a body with keypoints at `arm` [m]; `start` is the origin of the scene in the body's frame [m]."""
    depth, first = surface.depth_grid()
    height = first[2] + surface.h * np.arange(depth.shape[2]) - floor
    depth = np.minimum(depth, height)
    low, h = start + length * torch.from_numpy(first).float(), length * surface.h
    keypoints = cKDTree(arm.numpy())
    nodes = np.argwhere(np.abs(depth) < NEAR * surface.h)
    keypoint = np.zeros(depth.shape, np.int64)
    keypoint[tuple(nodes.T)] = keypoints.query(low.numpy() + h * nodes, workers=-1)[1]
    smooth = ndimage.gaussian_filter(depth, 1.0)
    on_grid = (torch.from_numpy(length * x).float() for x in (depth, smooth))
    samples, normals = _samples(surface, floor, seed)
    at = start + length * samples
    near = torch.from_numpy(keypoints.query(at.numpy(), workers=-1)[1])
    return BodyGrid(*on_grid, torch.from_numpy(keypoint), low, h, at, normals, near)


def _samples(surface: SolidSurface, floor: float, seed: int) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k 3"]]:
    """Points on a surface above a floor, and normals: the outermost ones, and others far from each other."""
    points, normals = surface.samples()
    if (above := points[:, 2] > floor - surface.h).any():
        points, normals = np.maximum(points[above], [-np.inf, -np.inf, floor]), normals[above]
    outer = np.unique((EXTREMES @ points.T).argmax(1))
    others = farthest_points(torch.from_numpy(points), SAMPLES - len(outer), seed).numpy()
    chosen = np.union1d(outer, others)
    return torch.from_numpy(points[chosen]).float(), torch.from_numpy(normals[chosen]).float()


def _overlaps(surfaces: BodySurfaces, com: Float[Tensor, "o 3"]) -> Float[Tensor, "o o"]:
    """How deep the samples of each body are in each other one [m]."""
    o, k, _ = surfaces.samples.shape
    out = torch.zeros(o, o)
    at = com[:, None] + surfaces.samples
    for b in range(o):
        depth, _ = surfaces.look_up(torch.full((o * k,), b), (at - com[b]).flatten(0, 1))
        depth = torch.where(surfaces.near >= 0, depth.view(o, k), 0.0)
        out[:, b] = depth.amax(1).clamp_min(0)
    out.fill_diagonal_(0.0)
    return out
