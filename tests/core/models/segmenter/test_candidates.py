"""Links between voxels of one object."""

import torch

from stages.core.models.segmenter.candidates import LINK_REACH, adjacent_pairs, nearby_pairs
from stages.core.models.segmenter.voxels import VOXEL, neighbour_table


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
