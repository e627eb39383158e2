"""Crops around candidate objects, and their scores."""

import numpy as np
import torch

from stages.core.models.segmenter.candidates import Candidates
from stages.core.models.segmenter.crops import CONTEXT, MOST, Boxes, boxes, corrected, crops, plausible, surroundings
from stages.core.models.segmenter.mask_scorer import CELLS, CHANNELS
from stages.core.models.segmenter.merge_tree import MergeTree, merge_tree
from stages.core.models.segmenter.network import CANDIDATE_FEATURES, Prediction, Segmenter
from stages.core.models.segmenter.voxels import FEATURES, VOXEL, VoxelGrid


def two_blocks() -> tuple[VoxelGrid, Prediction, Candidates]:
    """Two blocks of 4 x 4 x 2 voxels, 6 apart, that are leaves and then merge."""
    one = torch.cartesian_prod(torch.arange(4), torch.arange(4), torch.arange(2))
    cells = torch.cat([one, one + torch.tensor([10, 0, 0])])
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(len(cells), FEATURES, generator=generator)
    grid = VoxelGrid(cells, VOXEL * (cells + 0.5), features, torch.arange(len(cells)))
    normal = torch.randn(len(cells), 30, generator=generator)
    found = Prediction(normal[:, :3], 0.01 * normal[:, 3:6], normal[:, 6:])
    leaf = torch.arange(2).repeat_interleave(len(one))
    tree = merge_tree(2, np.array([[0, 1]]), np.array([0.5]))
    of_node = torch.randn(3, CANDIDATE_FEATURES, generator=generator)
    of_node[:, 0] = torch.tensor([32.0, 32, 64]).log()
    return grid, found, Candidates(torch.arange(len(cells)), leaf, tree, of_node)


def test_leaves_of_every_node_are_a_span():
    rng = np.random.default_rng(0)
    pairs = np.array([(i, j) for i in range(12) for j in range(i) if rng.uniform() < 0.3])
    tree = merge_tree(12, pairs, rng.normal(size=len(pairs)))
    spans = tree.spans()
    place = spans[:12, 0]
    assert sorted(place.tolist()) == list(range(12))
    for node in range(len(tree)):
        members = tree.labels(np.array([node])) == 0
        inside = (place >= spans[node, 0]) & (place < spans[node, 1])
        np.testing.assert_array_equal(members, inside)


def test_a_crop_shows_the_candidate_its_sibling_and_nothing_else():
    grid, found, candidates = two_blocks()
    seen = surroundings(grid, found, candidates)
    of = boxes(candidates, seen, torch.tensor([0, 1, 2]), Segmenter((8, 8)), 1.0)
    x = crops(seen, of)
    assert x.shape == (3, CHANNELS, CELLS, CELLS, CELLS)
    for k, (own, sibling) in enumerate([(32, 32), (32, 32), (64, 0)]):  # all within 24 voxels
        assert x[k, :3].sum((1, 2, 3)).tolist() == [64, own, sibling]
    half = CELLS // 2
    assert x[0, 1, half - 2 : half + 2, half - 2 : half + 2, half - 1 : half + 1].all()  # in the middle of its crop
    np.testing.assert_allclose(of.side, [4 * VOXEL, 4 * VOXEL, 14 * VOXEL], rtol=1e-5)
    mean = (x[0, 14:17] * x[0, 1]).sum((1, 2, 3))  # of differences of colour from the candidate's mean
    np.testing.assert_allclose(mean, 0, atol=1e-4)


def test_large_candidates_are_seen_with_their_context():
    grid, found, candidates = two_blocks()
    wide = VoxelGrid(grid.cells, 4 * grid.points, grid.features, grid.owner)
    seen = surroundings(wide, found, candidates)
    of = boxes(candidates, seen, torch.tensor([2]), Segmenter((8, 8)), 1.0)
    where = torch.nonzero(crops(seen, of)[0, 1])
    extent = (where.amax(0) - where.amin(0) + 1).max()
    assert abs(int(extent) - CELLS / CONTEXT) <= 1


def test_mirrored_scenes_have_mirrored_crops():
    grid, found, candidates = two_blocks()
    seen = surroundings(grid, found, candidates)
    of = boxes(candidates, seen, torch.tensor([0, 2]), Segmenter((8, 8)), 1.0)
    shifted = Boxes(of.middle + 0.003, *(getattr(of, name) for name in list(Boxes.__dataclass_fields__)[1:]))
    straight = crops(seen, shifted)
    turned = crops(seen.mirrored(-1, 1, True), shifted.mirrored(-1, 1, True))
    expected = straight.flip(2).transpose(2, 3).clone()
    for first in (3, 6):  # normals, and where the predicted centres are
        x, y = -expected[:, first].clone(), expected[:, first + 1].clone()
        expected[:, first], expected[:, first + 1] = y, x
    np.testing.assert_allclose(turned, expected, atol=1e-5)


def test_an_untrained_mask_scorer_leaves_scores_as_they_are(device):
    grid, found, candidates = two_blocks()
    seen = surroundings(grid, found, candidates).to(device)
    model = Segmenter((8, 8), masks=True).to(device)
    of = boxes(candidates, seen, torch.tensor([0, 1, 2]), model, 1.5)
    np.testing.assert_allclose(
        corrected(seen, of, model), model.score(candidates.features.to(device)).detach().cpu(), rtol=1e-5
    )
    torch.nn.init.ones_(model.mask_scorer.head[-1].weight)
    assert not torch.allclose(corrected(seen, of, model), of.odds.cpu())


def test_of_alike_candidates_the_best_is_looked_at():
    count = 40  # leaves that join one at a time: 2, 3, ... of them
    children = np.array([(0, 1), *((count + k, k + 2) for k in range(count - 2))])
    tree = MergeTree(count, children, np.zeros(count - 1), np.ones(count - 1))
    features = torch.zeros(len(tree), CANDIDATE_FEATURES)
    features[:, 0] = torch.from_numpy(10 * tree.sums(np.ones((count, 1)))[:, 0]).log()
    candidates = Candidates(torch.arange(count), torch.arange(count), tree, features)
    ious = torch.linspace(0, 0.5, len(tree))
    ious[-3] = 0.9  # of 38 leaves; the root has 40
    usable = torch.ones(len(tree), dtype=torch.bool)
    chosen = plausible(candidates, ious, usable).tolist()
    assert chosen[0] == len(tree) - 3
    sizes = candidates.sizes[chosen]
    assert (sizes > 365).sum() == 1
    assert len(chosen) == len(set(chosen)) <= MOST and len(chosen) < len(tree)
    usable[-3] = False
    assert len(tree) - 3 not in plausible(candidates, ious, usable).tolist()
