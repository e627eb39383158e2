"""Contacts between surfaces: analytic distances, directions and gradients, and a small body on a rough one."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from stages.core.physics.solid_surface import SolidSurface, _voxels_along, solid_surface
from stages.lab.assets.shapes import Surface, box
from stages.simulate.initial_overlaps import WINDOW
from stages.simulate.standing_surface import StandingSurface
from stages.simulate.surface_contacts import BodyFrame, SurfaceContacts, SurfaceShape, ball_shape, surface_shape
from tests.simulate.motion import roll_out
from tests.simulate.test_rigid import cube, options_of, scene_of

mujoco = pytest.importorskip("mujoco")


def ball(radius: float, convex: bool = False) -> SurfaceShape:
    """A ball with its centre at the origin."""
    return replace(ball_shape(np.zeros(3), radius), convex=convex)


class Pair:
    """Two balls of radii 0.1 and 0.2 at a distance along x above a plane; for MuJoCo they are tiny central spheres.

    The first ball is at `x`; `others` are at the given positions along x.
    """

    def __init__(self, distance: float, convex: bool = False, x: float = 0.0, others: tuple = ()):
        self.x = x
        spec = mujoco.MjSpec()
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        for k, at in enumerate((x, x + distance, *others)):
            body = spec.worldbody.add_body(pos=[at, 0, 0])
            body.add_freejoint()
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.001, 0, 0], friction=[0.1 + 0.2 * k, 0, 0])
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, -0.19],
                                friction=[0.2, 0, 0])  # fmt: skip
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_fwdPosition(self.model, self.data)
        shapes = [ball(0.1, convex), ball(0.2, convex), *(ball(0.1, convex) for _ in others)]
        self.contacts = SurfaceContacts(mujoco, self.model, self.data, shapes)

    def found(self, distance: float, substeps: int = 1, fixed: bool = False, height: float = 0.0):
        """Contacts after substeps, in which the second ball is moved to a distance at once, and both to a height."""
        for _ in range(substeps):
            self.data.qvel[6] = abs(self.x + distance - self.data.qpos[7]) / self.model.opt.timestep
            self.data.qpos[7] = self.x + distance
            self.data.qpos[[2, 9]] = height
            mujoco.mj_fwdPosition(self.model, self.data)
            self.contacts.add(self.data, np.array([True] + [fixed] * (self.model.nbody - 1)))
            mujoco.mj_makeConstraint(self.model, self.data)
        return self.data.contact


def test_depth_and_direction_of_contacts_between_balls():
    contact = Pair(0.5).found(0.28)
    assert contact.dist.min() == pytest.approx(-0.02, abs=2e-4)
    deepest = contact.dist.argmin()
    # the normal points from the first geometry's body to the second one's
    x = np.array([np.nan, 0.0, 0.28])[contact.geom[deepest]]  # geometry 0 is the plane
    assert contact.frame[deepest, :3] @ [x[1] - x[0], 0, 0] == pytest.approx(0.28, rel=0.01)
    frames = contact.frame.reshape(-1, 3, 3)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape), atol=1e-12)
    assert contact.pos[deepest] == pytest.approx([0.09, 0, 0], abs=0.01)
    np.testing.assert_allclose(contact.friction[:, 0], 0.3)
    assert (contact.efc_address >= 0).all()


def test_distances_are_those_of_each_pair():
    """The balls are not at the origin, and a third ball is far away on either side."""
    alone = Pair(0.5).found(0.28)
    for others in ((-5.0,), (9.0,)):
        pair = Pair(0.5, x=3.0, others=others)
        contact = pair.found(0.28)
        assert pair.contacts._path == pytest.approx([0.0, 0.22, 0.0])  # only the second ball has moved
        assert contact.dist.min() == pytest.approx(alone.dist.min(), abs=1e-9) and len(contact.dist) == len(alone.dist)


def test_contacts_are_those_that_span_the_touching_patch_and_the_deepest():
    """There are at most nine per pair of surfaces and direction; MuJoCo's contacts of the same bodies are excluded."""
    pair = Pair(0.5)
    contact = pair.found(0.28)
    assert 1 <= len(contact.dist) <= 2 * 6 * 9
    pair.data.qpos[7] = pair.x + 0.0005  # now the spheres at the centres, which MuJoCo knows, touch
    mujoco.mj_fwdPosition(pair.model, pair.data)
    assert pair.data.ncon == 1
    pair.contacts.exclude(pair.data)
    assert (pair.data.contact.exclude == 1).all()
    convex = Pair(0.5, convex=True)
    convex.data.qpos[7] = convex.x + 0.0005
    mujoco.mj_fwdPosition(convex.model, convex.data)
    convex.contacts.exclude(convex.data)
    assert convex.data.ncon == 1 and not convex.data.contact.exclude.any()


def test_separate_fixed_and_convex_bodies_have_none():
    assert len(Pair(0.5).found(0.301).dist) == 0
    assert len(Pair(0.5).found(0.28, fixed=True).dist) == 0
    assert len(Pair(0.5, convex=True).found(0.28).dist) == 0


def test_the_overlap_at_the_start_is_no_contact_nor_the_least_one_since():
    pair = Pair(0.26)
    assert len(pair.found(0.26).dist) == 0
    assert pair.found(0.25).dist.min() == pytest.approx(-0.01, abs=1e-3)
    assert len(pair.found(0.31, substeps=2 * WINDOW).dist) == 0
    assert len(pair.found(0.9).dist) == 0
    assert pair.found(0.26).dist.min() == pytest.approx(-0.04, abs=1e-3)


def test_contacts_with_a_plane_begin_at_the_overlap_of_the_start():
    """The large ball is initially 0.01 below the plane."""
    contact = Pair(0.5).found(0.5, height=-0.03)
    assert len(contact.dist) and contact.dist.min() == pytest.approx(-0.03, abs=1e-3)
    assert (contact.geom == [0, 2]).all() and (contact.frame[:, :3] == [0, 0, 1]).all()
    assert contact.pos[contact.dist.argmin()] == pytest.approx([0.5, 0, -0.23], abs=0.015)
    np.testing.assert_allclose(contact.friction[:, 0], 0.3)
    both = Pair(0.5).found(0.5, height=-0.11).geom
    assert (both[:, 0] == 0).all() and set(both[:, 1]) == {1, 2}
    assert len(Pair(0.5).found(0.5).dist) == 0
    assert len(Pair(0.5).found(0.5, height=-0.03, fixed=True).dist) == 0
    assert len(Pair(0.5, convex=True).found(0.5, height=-0.03).dist) == 0


def test_shape_of_a_box_that_ends_at_the_floor():
    """A box of 1 x 1 x 0.5 with its lowest quarter below the floor, in units of 1/2, relative to a point in it."""
    points = box((1.0, 1.0, 0.5), 0.02).points.double().numpy()
    line = np.arange(-0.49, 0.5, 0.02)
    body = SolidSurface(np.stack(np.meshgrid(line, line, line[np.abs(line) < 0.25], indexing="ij"), -1).reshape(-1, 3),
                        0.02, points)  # fmt: skip
    com = np.array([0.1, 0.0, 0.05])
    shape = surface_shape(StandingSurface(body.fitted, None, -0.125), BodyFrame(tuple(com), 2.0))
    at = np.round((2 * (np.array([0.0, 0.0, -0.09]) - com) - shape.low) / shape.h).astype(int)
    assert shape.depth[tuple(at)] == pytest.approx(2 * 0.035, abs=0.03) and shape.h == pytest.approx(0.04)
    x = shape.points / 2 + com
    assert x[:, 2].min() == pytest.approx(-0.125)
    under = x[(shape.normals[:, 2] == -1) & (np.abs(x[:, :2]) < 0.45).all(1)]
    assert len(under) > 1000 and np.abs(under[:, 2] + 0.125).max() < 1e-9
    top = x[(shape.normals[:, 2] > 0.9) & (np.abs(x[:, :2]) < 0.45).all(1)]  # without the rounded edges
    assert len(top) > 1000 and np.abs(top[:, 2] - 0.25).max() < 0.003


@pytest.mark.parametrize("gap", [-0.03, -0.004, 0.0, 0.001, 0.004, 0.01])
def test_a_body_that_ends_about_at_the_floor_has_one_underside(gap):
    """A slab with voxels of 0.01 is cut off at the floor, from which its underside has this distance."""
    line = np.arange(-0.495, 0.5, 0.01)
    high = np.arange(0.005, 0.1, 0.01)
    points = box((1.0, 1.0, 0.1), 0.01).points.double().numpy() + [0, 0, 0.05]
    body = SolidSurface(np.stack(np.meshgrid(line, line, high, indexing="ij"), -1).reshape(-1, 3), 0.01, points)
    x, normals = body.fitted.samples_above(-gap)
    under = (normals[:, 2] < -0.9) & (np.abs(x[:, :2]) < 0.45).all(1)
    assert np.abs(x[under, 2] - max(0.0, -gap)).max() < 0.0025 + 1e-9 and (x[:, 2] >= -gap).all()
    assert 7000 < under.sum() < 10000  # one sample in each voxel


def test_a_convex_body_has_the_faces_of_its_hull():
    """For a cube, samples beyond an edge belong to no face."""
    line = np.arange(-0.475, 0.5, 0.05)
    points = box((1.0, 1.0, 1.0), 0.04).points.double().numpy()
    body = SolidSurface(np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3), 0.05, points)
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), -1).reshape(-1, 3)
    shape = surface_shape(StandingSurface(body.fitted, ConvexHull(corners), -1.0), BodyFrame((0.0, 0.0, 0.0), 1.0))
    assert shape.convex and np.abs(np.abs(shape.points).max(1) - 0.5).max() < 0.0026 and len(shape.points) > 1000
    node = shape.low + shape.h * np.indices(shape.depth.shape).transpose(1, 2, 3, 0)
    near = np.abs(shape.depth) < shape.h
    np.testing.assert_allclose(shape.depth[near], 0.5 - np.abs(node[near]).max(1), atol=1e-6)


def test_depths_on_the_grid_are_those_at_its_nodes():
    line = 0.1 * np.arange(-4, 4.5)
    slab = np.stack(np.meshgrid(line, line, line[2:-2], indexing="ij"), -1).reshape(-1, 3)
    body = SolidSurface(slab + 0.05, 0.1, box((0.9, 0.9, 0.5), 0.03).points.double().numpy() + 0.06)
    for surface in (body, body.fitted):
        depth, low = surface.depth_grid()
        nodes = low + 0.1 * np.indices(depth.shape).reshape(3, -1).T
        assert np.abs(depth.ravel() - surface.depth(nodes)).max() < 1e-9


def test_voxels_around_a_symmetric_body_are_symmetric():
    """A slab of 9 x 9 x 5 voxels with edge 0.1 and points on its faces has one layer of voxels around it."""
    line = 0.1 * np.arange(-4, 4.5)
    slab = np.stack(np.meshgrid(line, line, line[2:-2], indexing="ij"), -1).reshape(-1, 3)
    body = SolidSurface(slab + 0.05, 0.1, box((0.9, 0.9, 0.5), 0.03).points.double().numpy() + 0.05)
    x, inside, _ = body.body_voxels()
    cells = np.round((x - 0.05) / 0.1).astype(int)
    assert len(x) == 11 * 11 * 7 and np.abs(cells).max(0).tolist() == [5, 5, 3]
    kept = {tuple(c) for c in cells[inside]}
    assert kept == {tuple(np.round((p) / 0.1).astype(int)) for p in slab}
    depth = body.depth(x)
    assert (depth[inside] > 0).all() and depth.max() == pytest.approx(0.25, abs=0.02)


def test_a_tangent_plane_continues_as_far_as_its_samples_are_apart():
    """Samples on the left half are 0.4 voxels above the top of the voxels; on the right half, the voxels count."""
    line = 0.1 * np.arange(-9, 10)
    slab = np.stack(np.meshgrid(line, line, line[7:-7], indexing="ij"), -1).reshape(-1, 3)
    x, y = np.meshgrid(np.arange(-0.94, 0.0, 0.03), np.arange(-0.94, 0.95, 0.03))
    top = slab[:, 2].max() + 0.1
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, top + 0.04)], 1)
    body = SolidSurface(slab + 0.05, 0.1, points)
    at = np.array([[-0.5, 0.0, top], [-0.5, 0.2, top + 0.1], [0.13, 0.0, top], [0.15, 0.2, top + 0.05]])
    np.testing.assert_allclose(body.depth(at), [0.04, -0.06, 0.0, -0.05], atol=0.004)


def test_objects_are_measured_beside_one_without_finite_gaussians():
    scene = scene_of((cube(0.1, 0.0, 0.0), cube(0.1, 0.5, 0.0)))
    means = scene.gaussians.means.clone()
    means[scene.gaussians.object_id == 2] = torch.nan
    broken = replace(scene, gaussians=replace(scene.gaussians, means=means))
    assert _voxels_along(broken, 1) >= _voxels_along(scene, 1) == 48


def bumpy(side: float, height: float, bump: float) -> Surface:
    """A slab with bumps on its faces, six along each side."""
    s = box((side, side, height), side / 96)
    wave = torch.sin(s.points[:, :2] * (12 * math.pi / side) + torch.tensor([0.3, 1.1])).prod(1, keepdim=True)
    return Surface(s.points + bump * s.normals * wave, s.normals).moved((0, 0, height / 2 + bump))


def test_a_small_body_does_not_enter_the_bumps_of_a_large_one(tmp_path):
    """Bumps of half a voxel are 1/4 of the cube's height; by parts, the cube would penetrate by 0.14 of its height."""
    scene = scene_of((bumpy(1.0, 0.1, 0.01), cube(0.04, 0.12, 0.15).moved((0.0, -0.05, 0.0))))
    t = roll_out(scene, options_of(scene, tmp_path, steps=22, pin=("1",), keypoints=300))
    slab = solid_surface(scene, 1)
    mine = t.keypoints.object_id == 2
    depth = [float(slab.depth(t.positions[k, mine].double().numpy()).max()) for k in range(0, 22, 3)]
    assert max(depth) < 0.03 * 0.04 and depth[-1] > -0.05 * 0.04
