"""Particles of bodies with smooth surfaces."""

import math
from functools import cache

import numpy as np
import pytest
import torch

from stages.core.physics.mpm.surface_particles import surface_particles
from stages.core.physics.particles import sample_bodies
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.shapes import box, to_gaussians
from stages.lab.bench.experiments.bodies import tilted
from stages.lab.bench.experiments.friction import ladders
from tests.conftest import ball

SIDES = torch.tensor([0.4, 0.3, 0.2])


@cache
def inclined_box(degrees: float) -> Scene:
    surface = tilted(box(tuple(SIDES.tolist()), 0.008), degrees)
    g = to_gaussians(surface, torch.full((len(surface.points), 3), 0.5), 1, widest=math.inf)
    return Scene(g, (SceneObject(1, "box"),), None, None)


@pytest.mark.parametrize("refinement", [1, 2])
@pytest.mark.parametrize("degrees", [0.0, 10.0, 25.0])
def test_volume_and_second_moments_of_an_inclined_box(degrees, refinement):
    scene = inclined_box(degrees)
    bodies = surface_particles(scene, sample_bodies(scene, 3000, skin=True), refinement)
    x, w = bodies.x.double(), bodies.volume.double()
    assert float(w.sum()) == pytest.approx(float(SIDES.prod()), rel=0.03)
    x = x - (w[:, None] * x).sum(0) / w.sum()
    moments = torch.linalg.eigvalsh((w[:, None] * x).mT @ x / w.sum())
    torch.testing.assert_close(moments, (SIDES.double() ** 2 / 12).sort().values, rtol=0.06, atol=0)


@pytest.mark.parametrize("refinement", [1, 2])
@pytest.mark.parametrize("count", [6000, 20000])
def test_a_leaning_board_has_no_particles_outside_its_faces(count, refinement):
    """A board of 1 x 0.2 x 0.06, six voxels of its surface thick, on a wall, towards which its voxels are closed."""
    scene, a = next(ladders()).runs[0].scene(), math.radians(60.0)
    bodies = surface_particles(scene, sample_bodies(scene, count, skin=True), refinement)
    x, w = bodies.x[bodies.body == 1], bodies.volume[bodies.body == 1]
    back = torch.tensor([[math.cos(a), 0.0, math.sin(a)], [0.0, 1.0, 0.0], [-math.sin(a), 0.0, math.cos(a)]])
    sides, seen = torch.tensor([1.0, 0.2, 0.06]), scene.gaussians.means[scene.gaussians.object_id == 2]
    outside = ((x - (seen.amin(0) + seen.amax(0)) / 2) @ back).abs() - sides / 2
    assert float(outside.max()) < 2 * bodies.spacing
    assert float(w.sum()) == pytest.approx(float(sides.prod()), rel=0.05)


@pytest.mark.parametrize("degrees", [10.0, 25.0])
def test_cells_at_inclined_faces_are_filled_in_part(degrees):
    scene = inclined_box(degrees)
    coarse = sample_bodies(scene, 3000, skin=True)
    offsets = torch.cartesian_prod(*[(torch.arange(8) + 0.5) / 8] * 3)
    a = math.radians(degrees)
    back = torch.tensor([[math.cos(a), 0.0, math.sin(a)], [0.0, 1.0, 0.0], [-math.sin(a), 0.0, math.cos(a)]])

    def error(bodies) -> float:
        """Root mean square error of the filled fraction of the particles' cells."""
        points = (torch.floor(bodies.x / bodies.spacing)[:, None] + offsets) * bodies.spacing
        true = ((points @ back).abs() < SIDES / 2).all(2).float().mean(1)
        return float((bodies.volume / bodies.spacing**3 - true).square().mean().sqrt())

    assert error(surface_particles(scene, coarse, 2)) < 0.06 and error(surface_particles(scene, coarse)) < 0.06
    assert error(coarse) > 0.12


def test_bodies_that_overlap_share_their_voxels():
    low, high = ball((0, 0, 0.15), 0.15, 600, (1, 0, 0), 1), ball((0.2, 0, 0.2), 0.12, 600, (0, 1, 0), 2, seed=1)
    scene = Scene(concatenate([low, high]), (SceneObject(1, "a"), SceneObject(2, "b")), None, 0.0)
    bodies = surface_particles(scene, sample_bodies(scene, 2000, skin=True), 2)
    voxels = torch.floor(bodies.x / bodies.spacing).long()
    own = torch.cat([voxels, bodies.body[:, None]], 1)
    assert len(own.unique(dim=0)) == len(own)  # each voxel has one particle
    keys, at = voxels.unique(dim=0, return_inverse=True)
    filled = torch.zeros(len(keys)).index_add(0, at, bodies.volume) / bodies.spacing**3
    assert float(filled.max()) <= 1 + 1e-5 and len(keys) < len(voxels)
    assert float(bodies.volume[bodies.body == 1].sum()) == pytest.approx(4 / 3 * math.pi * 0.12**3, rel=0.1)


def test_a_small_body_beside_a_large_one_has_no_particles_outside():
    """Outside is where particles' voxels are so large that they extend beyond the grid of its signed distances."""
    surfaces = [box((0.6,) * 3, 0.02).moved((0.0, 0.0, 0.3)), box((0.15,) * 3, 0.006).moved((0.6, 0.0, 0.075))]
    parts = [to_gaussians(s, torch.full((len(s.points), 3), 0.5), i + 1, widest=math.inf)
             for i, s in enumerate(surfaces)]  # fmt: skip
    scene = Scene(concatenate(parts), (SceneObject(1, "large"), SceneObject(2, "small")), None, 0.0)
    bodies = surface_particles(scene, sample_bodies(scene, 3000, skin=True))
    small, h = bodies.body == 1, bodies.spacing
    assert h > 0.15 / 5
    corner = torch.floor(bodies.x[small] / h) * h - torch.tensor([0.525, -0.075, 0.0])
    assert float((corner + h).min()) > 0 and float(corner.max()) < 0.15
    assert float(bodies.volume[small].sum()) == pytest.approx(0.15**3, rel=0.1)


def test_a_sheet_stays_thick_enough_to_hold_together():
    rng = np.random.default_rng(0)
    sheet = ball((0, 0, 0), 1.0, 4000, (1, 0, 0), 1)
    sheet.means[:] = torch.from_numpy(np.column_stack([rng.random((4000, 2)) / 2, 0.002 * rng.random(4000)])).float()
    sheet.scales[:] = 0.004
    scene = Scene(sheet, (SceneObject(1, "cloth"),), None, None)
    coarse = sample_bodies(scene, 2000, skin=True)
    assert len(surface_particles(scene, coarse).x) > 0.95 * len(coarse.x)
    fine = surface_particles(scene, coarse, 2)
    columns, layers = torch.floor(fine.x[:, :2] / fine.spacing).unique(dim=0, return_counts=True)
    inner = ((columns * fine.spacing - 0.25).abs() < 0.2).all(1)  # away from the border of the body
    assert float((layers[inner] >= 4).float().mean()) > 0.95 and float(fine.volume.sum()) == pytest.approx(
        float(coarse.volume.sum()), rel=0.06
    )
