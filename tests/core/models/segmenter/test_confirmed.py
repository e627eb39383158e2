"""Objects found in the reduced scene are kept if the scene at its own scale contains them too."""

import numpy as np
import pytest
import torch

from stages.core.models.segmenter.candidates import Candidates
from stages.core.models.segmenter.merge_tree import MergeTree
from stages.core.models.segmenter.network import CANDIDATE_FEATURES
from stages.core.models.segmenter.segment import OBJECT_COST, ScoredCandidates, Segmentation, confirmed

OWNER = torch.tensor([0, 0, 1, 1, 2, 2, 3, 3, -1])  # voxel of each surfel, -1 for none


def scored(ious: list[float]) -> ScoredCandidates:
    """Candidates of four voxels that merge in pairs: nodes 4 (voxels 0, 1), 5 (voxels 2, 3) and 6 (all)."""
    tree = MergeTree(4, np.array([[0, 1], [2, 3], [4, 5]]), np.zeros(3), np.ones(3))
    candidates = Candidates(torch.arange(4), torch.arange(4), tree, torch.zeros(7, CANDIDATE_FEATURES))
    return ScoredCandidates(candidates, torch.tensor(ious), torch.ones(7), 1.0, OWNER, torch.zeros(len(OWNER), 3))


def reduced(labels: list[int], iou: float) -> Segmentation:
    labels = torch.tensor(labels)
    sizes = torch.bincount(labels[labels >= 0])
    return Segmentation(labels, sizes * (iou - OBJECT_COST), sizes)


def test_the_candidate_that_covers_an_object_says_what_to_expect():
    found = scored([0.1] * 4 + [0.9, 0.8, 0.5])
    objects = reduced([0, 0, 0, 0, 1, 1, -1, -1, 1], 0.9)
    # the second object shares two of its three surfels with node 2, and the same two with the four surfels of node 5
    np.testing.assert_allclose(found.expected_ious(objects), [0.9, max(0.1 * 2 / 3, 0.8 * 2 / 5)], rtol=1e-6)


@pytest.mark.parametrize(("whole", "kept"), [(0.75, True), (0.6, False)])
def test_things_that_only_look_like_one_when_reduced_are_not(whole, kept):
    found = confirmed(reduced([0] * 8 + [-1], 0.9), scored([0.1] * 4 + [0.4, 0.4, whole]))
    assert found.labels.tolist() == ([0] * 8 if kept else [-1] * 8) + [-1]
    assert found.sizes.tolist() == [8] * kept
    np.testing.assert_allclose(found.gains, [8 * (0.9 - OBJECT_COST)] * kept, rtol=1e-6)


def test_nothing_is_confirmed_without_candidates():
    empty = MergeTree(0, np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0))
    none = torch.zeros(0, dtype=torch.int64)
    found = ScoredCandidates(Candidates(none, none, empty, torch.zeros(0, CANDIDATE_FEATURES)), torch.zeros(0),
                             torch.zeros(0), 1.0, OWNER, torch.zeros(len(OWNER), 3))  # fmt: skip
    assert confirmed(reduced([0] * 8 + [-1], 0.9), found).labels.tolist() == [-1] * 9
