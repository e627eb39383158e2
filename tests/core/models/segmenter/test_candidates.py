"""Candidate objects: links between voxels, and the tree of merges."""

import numpy as np
import torch

from stages.core.models.segmenter.candidates import LINK_REACH, adjacent_pairs, find_candidates, nearby_pairs
from stages.core.models.segmenter.network import Prediction, Segmenter, pyramid
from stages.core.models.segmenter.voxels import FEATURES, VOXEL, VoxelGrid, neighbour_table


def row_of_voxels(step: int, count: int = 6) -> tuple[torch.Tensor, torch.Tensor]:
    """Cells and centres of voxels `step` apart."""
    cells = torch.arange(count)[:, None] * torch.tensor([[step, 0, 0]])
    return cells, VOXEL * (cells + 0.5)


def test_links_cross_gaps_up_to_their_reach():
    for step in (2, int(LINK_REACH) + 1):
        cells, points = row_of_voxels(step)
        voxels = torch.arange(len(cells))
        assert not len(adjacent_pairs(neighbour_table(cells), voxels))
        linked = {tuple(sorted(pair)) for pair in nearby_pairs(points, voxels).tolist()}
        assert linked == ({(i, i + 1) for i in range(len(cells) - 1)} if step < LINK_REACH else set())


def test_only_the_given_voxels_are_linked():
    _, points = row_of_voxels(2)
    assert {tuple(sorted(pair)) for pair in nearby_pairs(points, torch.tensor([1, 2, 4])).tolist()} == {(1, 2)}
    assert nearby_pairs(points, torch.zeros(0, dtype=torch.int64)).shape == (0, 2)


def test_leaves_are_connected_voxels_of_one_coarse_cell(device):
    """With certain affinities, leaves are the cells of twice the voxel side, and sums count every voxel once."""
    torch.manual_seed(0)
    cells = torch.cartesian_prod(*[torch.arange(4)] * 3).to(device)
    points = VOXEL * (cells + 0.5)
    model = Segmenter((8, 8)).to(device)
    torch.nn.init.zeros_(model.affinity_head[-1].weight)
    torch.nn.init.constant_(model.affinity_head[-1].bias, 5.0)
    logits = torch.tensor([-5.0, 5, -5], device=device).expand(len(cells), 3)
    found = Prediction(logits, torch.zeros_like(points), torch.zeros(len(cells), 24, device=device))
    grid = VoxelGrid(cells, points, torch.zeros(len(cells), FEATURES, device=device), torch.arange(len(cells)))
    candidates = find_candidates(grid, pyramid(cells, 2), found, model)
    assert candidates.tree.count == 8
    assert len({(tuple(c), int(k)) for c, k in zip((cells // 2).tolist(), candidates.leaf, strict=True)}) == 8
    np.testing.assert_allclose(candidates.sizes[: candidates.tree.count], 8, rtol=1e-5)
    total = candidates.sums(points.cpu())[-1]  # the last row is the root
    np.testing.assert_allclose(total, points.double().sum(0).cpu(), rtol=1e-6)
    np.testing.assert_allclose(candidates.extents[-1], 4 * VOXEL, rtol=1e-5)
