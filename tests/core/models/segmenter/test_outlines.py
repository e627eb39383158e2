"""Outlines of labels that are finer than voxels."""

import torch

from stages.core.models.segmenter.outlines import cut_outlines
from stages.core.models.segmenter.voxels import VOXEL, ScenePoints, voxelise


def plate(edge: float) -> ScenePoints:
    """A horizontal plate, red where x is below `edge` and blue elsewhere."""
    line = torch.arange(-0.1, 0.1, VOXEL / 4) + 1e-4
    points = torch.nn.functional.pad(torch.cartesian_prod(line, line), (0, 1), value=0.003)
    n = len(points)
    lab = torch.where((points[:, :1] < edge), torch.tensor([50.0, 60, 40]), torch.tensor([40.0, 10, -60]))
    up = torch.tensor([0.0, 0, 1]).expand(n, 3).contiguous()
    return ScenePoints(points, lab, up, torch.full((n,), 0.8), up)


def test_an_outline_follows_the_edge_of_colour_within_a_voxel():
    """Voxel labels change at x = 0, the colour at x = 0.004."""
    edge = 0.4 * VOXEL
    surfels = plate(edge)
    grid = voxelise(surfels)
    labels = (grid.points[:, 0] < 0).long()
    chance = torch.nn.functional.one_hot(labels, 3).float() * 0.6 + 0.2
    ids = cut_outlines(surfels, grid, labels, chance)
    wrong = (ids > 0) != (surfels.points[:, 0] < edge)
    by_voxel = (labels[grid.owner] > 0) != (surfels.points[:, 0] < edge)
    assert int(by_voxel.sum()) > 100
    assert int(wrong.sum()) < 0.1 * int(by_voxel.sum())


def test_labels_without_a_boundary_stay():
    surfels = plate(0.0)
    grid = voxelise(surfels)
    labels = torch.ones(len(grid), dtype=torch.int64)
    assert bool((cut_outlines(surfels, grid, labels, torch.full((len(grid), 3), 1 / 3)) == 1).all())
