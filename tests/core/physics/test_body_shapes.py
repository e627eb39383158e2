"""Signed distances to the surfaces of undeformed bodies."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage

from stages.core.physics.mpm.body_shapes import shape_of_voxels
from stages.core.physics.mpm.surface_particles import surface_particles
from stages.core.physics.particles import sample_bodies
from stages.core.physics.solid_surface import solid_surface
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.shapes import box, ellipsoid, to_gaussians
from stages.lab.bench.experiments.bodies import tilted

SIDES = np.array([0.4, 0.3, 0.2])


def sampled(surface) -> tuple:
    """Shape of a body of about 3,000 particles, and the spacing of these [m]."""
    g = to_gaussians(surface, torch.full((len(surface.points), 3), 0.5), 1, widest=math.inf)
    scene = Scene(g, (SceneObject(1, "body"),), None, None)
    bodies = surface_particles(scene, sample_bodies(scene, 3000, skin=True))
    return shape_of_voxels(bodies.x.double().numpy(), bodies.spacing, solid_surface(scene, 1)), bodies.spacing


def at(values: np.ndarray, shape, x: np.ndarray) -> np.ndarray:
    return ndimage.map_coordinates(values, ((x - shape.origin) / shape.spacing).T, order=1)


@pytest.mark.parametrize("degrees", [0.0, 25.0])
def test_distance_and_normal_at_a_face_of_a_box(degrees):
    shape, h = sampled(tilted(box(tuple(SIDES.tolist()), 0.01), degrees))
    a = math.radians(degrees)
    R = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    rng = np.random.default_rng(0)
    for above in (-0.5 * h, 0.0, 2 * h):
        face = np.column_stack([rng.uniform(-0.1, 0.1, (200, 2)), np.full(200, SIDES[2] / 2 + above)])
        assert np.abs(at(shape.distance, shape, face @ R.T) - above).max() < 0.05 * h
        slope = np.stack([at(g, shape, face @ R.T) for g in np.gradient(shape.distance, h)], 1) @ R
        assert np.degrees(np.arccos(slope[:, 2] / np.linalg.norm(slope, axis=1))).mean() < 1.0


def test_distance_from_a_ball():
    shape, h = sampled(ellipsoid((0.15,) * 3, 1500))
    x = np.random.default_rng(0).uniform(-0.2, 0.2, (20000, 3))
    true = np.linalg.norm(x, axis=1) - 0.15
    near = (true > -2 * h) & (true < 2 * h)
    assert np.abs((at(shape.distance, shape, x) - true)[near]).mean() < 0.1 * h


def test_without_a_surface_the_faces_of_voxels_bound_the_body():
    h = 0.1
    x = (np.indices((4, 3, 2)).reshape(3, -1).T + 0.5) * h
    shape = shape_of_voxels(x, h)
    middle = np.array([[0.15, 0.15, z] for z in (0.05, 0.15, 0.25, 0.35)])
    assert at(shape.distance, shape, middle) == pytest.approx([-0.05, -0.05, 0.05, 0.15])
    assert shape.scaled(2.0).distance.max() == pytest.approx(2 * shape.distance.max())


def test_the_surface_does_not_depend_on_where_an_object_is():
    """Voxels begin at the object's bounds, so depths at its points stay equal if it moves by a fraction of a voxel."""
    depths = []
    x = np.random.default_rng(0).uniform(-0.25, 0.25, (3000, 3))
    for offset in ((0.0, 0.0, 0.0), (0.0031, 0.0, -0.0017), (0.7, -1.3, 0.0043)):
        surface = box(tuple(SIDES.tolist()), 0.01)
        g = to_gaussians(surface, torch.full((len(surface.points), 3), 0.5), 1, widest=math.inf)
        g = replace(g, means=g.means + torch.tensor(offset))
        solid = solid_surface(Scene(g, (SceneObject(1, "body"),), None, None), 1).fitted
        depths.append(solid.depth(x + offset))
    assert np.abs(depths[0]).max() > 0.05
    for other in depths[1:]:
        assert np.abs(other - depths[0]).max() < 0.02 * solid.h


@pytest.mark.parametrize("spacing", [0.006, 0.012])
def test_planes_at_edges_are_those_of_one_face(spacing):
    """A rod with a square section of four to eight point spacings, whose edges lie between the points."""
    surface = box((0.3, 0.05, 0.05), spacing).moved((0.0031, -0.0017, 0.4))
    g = to_gaussians(surface, torch.full((len(surface.points), 3), 0.5), 1, widest=math.inf)
    solid = solid_surface(Scene(g, (SceneObject(1, "rod"),), None, None), 1)
    volume = solid.fitted.body_voxels()[2].sum() * solid.h**3
    # it is filled although voxels are smaller than the point spacing
    assert volume == pytest.approx(0.3 * 0.05**2, rel=0.1)
    straight = [(np.abs(part.normals).max(1) > 0.999).mean() for part in (solid, solid.fitted)]
    assert straight[0] < 0.5 and straight[1] > 0.9
