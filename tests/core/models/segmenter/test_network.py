"""The sparse network: its convolutions equal dense ones, and its affinities are symmetric."""

import pytest
import torch

from stages.core.models.segmenter import network
from stages.core.models.segmenter.network import Convolution, Segmenter, pyramid
from stages.core.models.segmenter.voxels import FEATURES, neighbour_table


def some_cells(seed: int = 0) -> torch.Tensor:
    """Half of the cells of a 6 x 5 x 4 block, in random order, with some negative coordinates."""
    generator = torch.Generator().manual_seed(seed)
    cells = torch.cartesian_prod(torch.arange(6), torch.arange(5), torch.arange(4)) - 2
    return cells[torch.randperm(len(cells), generator=generator)[: len(cells) // 2]]


@pytest.mark.parametrize("block", [17, 4096])
def test_a_convolution_is_that_of_a_dense_grid_with_zeros_elsewhere(device, block, monkeypatch):
    monkeypatch.setattr(network, "BLOCK_VOXELS", block)
    cells = some_cells().to(device)
    x = torch.randn(len(cells), 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    x = x.to(device).requires_grad_()
    # cuDNN would compute products of float32 with the precision of TF32
    layer = Convolution(3, 4).to(device, torch.float64)
    level = pyramid(cells, 1)[0]
    found = layer(x, level)

    index = (cells + 2).unbind(1)
    dense = x.new_zeros(6, 5, 4, 3).index_put(index, x).permute(3, 0, 1, 2)
    kernel = layer.weight.reshape(3, 3, 3, 3, 4).permute(4, 3, 0, 1, 2)
    wanted = torch.nn.functional.conv3d(dense[None], kernel, padding=1)[0][(slice(None), *index)].mT
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)

    probe = torch.randn_like(found)
    ours = torch.autograd.grad((found * probe).sum(), [x, layer.weight])
    theirs = torch.autograd.grad((wanted * probe).sum(), [x, layer.weight])
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


def test_neighbours_are_mutual():
    cells = some_cells()
    table = neighbour_table(cells)
    assert torch.equal(table[:, 13], torch.arange(len(cells)))
    voxel, k = torch.nonzero(table < len(cells), as_tuple=True)
    assert torch.equal(table[table[voxel, k], 26 - k], voxel)
    offset = torch.stack([k // 9, k // 3 % 3, k % 3], 1) - 1
    assert torch.equal(cells[table[voxel, k]], cells[voxel] + offset)


@torch.no_grad()
def test_outputs_move_with_the_voxels_and_affinities_are_symmetric():
    """A shift by one coarsest voxel changes nothing, and the order within a pair does not matter."""
    torch.manual_seed(0)
    model, cells = Segmenter((8, 12, 16)), some_cells()
    features = torch.randn(len(cells), FEATURES)
    found = model(features, pyramid(cells, 3))
    shifted = model(features, pyramid(cells + torch.tensor([4, -8, 12]), 3))
    torch.testing.assert_close(found.offsets, shifted.offsets, rtol=1e-4, atol=1e-6)
    pairs = torch.tensor([[0, 1], [2, 9], [5, 5]])
    points = cells * 0.01
    torch.testing.assert_close(model.affinity(found, points, pairs), model.affinity(found, points, pairs.flip(1)))


def test_products_in_16_bits_are_close():
    torch.manual_seed(0)
    layer, cells = Convolution(16, 16), some_cells()
    x, level = torch.randn(len(cells), 16), pyramid(cells, 1)[0]
    with torch.autocast("cpu", torch.bfloat16):
        low = layer(x, level)
    assert low.dtype == x.dtype
    error = float((low - layer(x, level)).detach().abs().max())
    assert 0 < error < 0.1  # the error would be 0 if the context were ignored


@pytest.mark.parametrize("levels", [1, 4])
def test_a_pyramid_halves_the_cells(levels, device):
    cells = some_cells().to(device)
    found = pyramid(cells, levels)
    assert len(found) == levels
    for level in found:
        count = len(level.neighbours)
        held = level.children[level.children < count]
        assert torch.equal(held.sort().values, torch.arange(count, device=cells.device))
        rows = torch.nonzero(level.children < count)[:, 0]
        assert torch.equal(level.parent[held], rows)
