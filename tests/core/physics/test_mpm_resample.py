"""Subdivision of particles."""

import pytest
import torch

from stages.core.physics.mpm.resample import subdivide
from stages.core.physics.particles import Bodies, sample_bodies
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from tests.conftest import ball


def sampled(count: int = 2000) -> Bodies:
    low, high = ball((0, 0, 0.15), 0.15, 600, (1, 0, 0), 1), ball((0.25, 0, 0.2), 0.12, 600, (0, 1, 0), 2, seed=1)
    return sample_bodies(
        Scene(concatenate([low, high]), (SceneObject(1, "a"), SceneObject(2, "b")), None, 0.0), count, skin=True
    )


def test_mass_position_and_extent_are_kept():
    coarse = sampled()
    fine = subdivide(coarse)
    assert fine.spacing == coarse.spacing / 2 and len(fine.x) == 8 * len(coarse.x)
    for n in (0, 1):
        a, b = coarse.x[coarse.body == n], fine.x[fine.body == n]
        assert float(fine.volume[fine.body == n].sum()) == pytest.approx(float(coarse.volume[coarse.body == n].sum()))
        torch.testing.assert_close(a.mean(0), b.mean(0), rtol=0, atol=coarse.spacing / 4)
        # a particle is in the middle half of its voxel
        seen = [x.amax(0) + 0.5 * h for x, h in ((a, coarse.spacing), (b, fine.spacing))]
        torch.testing.assert_close(*seen, rtol=0, atol=0.4 * coarse.spacing)


def test_at_most_one_particle_per_voxel():
    fine = subdivide(sampled())
    voxels = torch.floor(fine.x / fine.spacing).int()
    assert len(voxels.unique(dim=0)) == len(voxels)


def test_a_sheet_keeps_its_thickness():
    grid = torch.cartesian_prod(torch.arange(10), torch.arange(10), torch.arange(3)).float()
    sheet = Bodies((grid + 0.5) * 0.01, torch.zeros(300, dtype=torch.int64), torch.full((300,), 0.01**3), 0.01)
    fine = subdivide(sheet)
    assert len(fine.x) == 2400 and float(fine.x[:, 2].max()) < 0.03
    assert float(fine.volume[0]) == pytest.approx(0.005**3)
