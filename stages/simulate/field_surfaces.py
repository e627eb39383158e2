"""Surfaces of the objects for the solved contacts of the learned engine, in model units and body frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from stages.core.geometry.extremes import extreme_rows, fibonacci
from stages.core.geometry.surface_faces import nearest_points, surface_faces
from stages.core.kernels.threads import parallel_map
from stages.core.models.field.body_surfaces import BodyGrid, BodySurfaces
from stages.core.models.initial_conditions import InitialConditions, centre_of_mass
from stages.core.physics.keypoints import farthest_points
from stages.core.physics.rigid_shapes import convex_hulls, rigid_shapes
from stages.core.physics.solid_surface import solid_surface
from stages.core.scene.scene import Scene
from stages.simulate.model_units import ModelUnits
from stages.simulate.standing_surface import StandingSurface

SAMPLES = 512  # surface samples of a body that are looked up in other bodies, about a twentieth of its size apart
BALL_DIRECTIONS = 2000  # surface samples of a ball for its initial overlaps, which are then accurate to .001 radii


def body_surfaces(
    scene: Scene, initial: InitialConditions, units: ModelUnits, lift: Float[Tensor, "o 3"],
    floors: Float[Tensor, "o"], seed: int,
) -> BodySurfaces:  # fmt: skip
    """Build the surfaces of all objects, each cut off below its floor [scene units], with their initial overlaps.

    `lift` in scene units; `initial` has the keypoints in model units.
    """
    com = centre_of_mass(initial, initial.points)
    arms = torch.where(initial.valid[..., None], initial.points - com[:, :, None], 0.0)[0]
    floor = float(floors.min())
    found, hulls = rigid_shapes(scene, seed, floor), convex_hulls(scene, seed, floor)

    def grid(row: int) -> BodyGrid:
        start = units.to_model(lift[row]) - com[0, row]  # origin of the scene, in the body's frame
        shape = StandingSurface(
            solid_surface(scene, scene.objects[row].id, seed).fitted, hulls[row], float(floors[row])
        )
        out = _grid(shape, arms[row, initial.valid[0, row]], start, units.length, seed)
        ball, cylinder = found[row].ball, found[row].cylinder
        if (solid := ball or cylinder) is None:
            return out
        centre, radius = start + units.length * torch.from_numpy(solid.centre).float(), units.length * solid.radius
        if cylinder is None:
            return replace(out, ball=(centre, radius))
        axis = torch.from_numpy(cylinder.axis).float()
        return replace(out, cylinder=(centre, axis, radius, units.length * cylinder.height / 2))

    grids = parallel_map(grid, range(len(scene.objects)))
    surfaces = BodySurfaces.of(grids)
    return replace(surfaces, overlap=_overlaps(surfaces, com[0]))


def _grid(
    shape: StandingSurface, arm: Float[Tensor, "n 3"], start: Float[Tensor, "3"], length: float, seed: int
) -> BodyGrid:
    """The signed distance grid and surface samples of a body.

    `arm`: its keypoints relative to the centre of mass [m]; `start`: origin of the scene in the body's frame [m];
    `length`: model metres per scene unit.
    """
    depth, first = shape.depth_grid()
    low, h = start + length * torch.from_numpy(first).float(), length * shape.surface.h
    points, normals, at_edge = shape.points()
    flatness, faces = surface_faces(points, normals, at_edge)
    outer = extreme_rows(points)
    others = farthest_points(torch.from_numpy(points), SAMPLES - len(outer), seed).numpy()
    row = np.union1d(outer, others)  # extreme points, and others by farthest point sampling
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
    """Overlap [a, b]: depth of body a in body b [m], of the samples of a or, for a ball, of points on its surface.

    The overlap of two balls is exact.
    """
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
