"""Predictions averaged over rotated and mirrored copies of a scene."""

import itertools

import pytest
import torch
from torch.testing import assert_close

from stages.core.models.segmenter import segment
from stages.core.models.segmenter.network import PAIR_FEATURES, Prediction, Segmenter
from stages.core.models.segmenter.segment import COPIES, TURNS, averaged_prediction
from stages.core.models.segmenter.voxels import LAB, ScenePoints, voxelise


class _Vectors(Segmenter):
    """Network stub that returns normals as offsets, colours as classes, and the number of its call as embedding."""

    def __init__(self):
        super().__init__((4,))
        self.calls = itertools.count()  # next() on it is safe from several threads

    def forward(self, features, levels) -> Prediction:
        """Predictions for the voxels."""
        call = torch.full((len(features), PAIR_FEATURES), float(next(self.calls)))
        return Prediction(features[:, LAB], features[:, 3:6], call)


QUARTER = ((0, -1, 0), (1, 0, 0), (0, 0, 1))  # unlike the rotations in TURNS, it is not its own inverse


@pytest.mark.parametrize("turn", [None, QUARTER])
def test_offsets_are_turned_back_and_all_copies_count_alike(turn, monkeypatch):
    if turn is not None:
        monkeypatch.setattr(segment, "TURNS", (TURNS[0], turn, *TURNS[2:]))
    surfels = ball()
    grid, model = voxelise(surfels), _Vectors()
    levels, found = averaged_prediction(surfels, grid, model)
    assert next(model.calls) == COPIES == 4 and len(levels) == 1
    assert_close(found.embedding, torch.full_like(found.embedding, 1.5))  # the mean of the call numbers 0 to 3
    outward = torch.nn.functional.normalize(grid.points, dim=1)
    turned = torch.nn.functional.normalize(found.offsets, dim=1)
    assert float((turned * outward).sum(1).min()) > 0.98
    assert float((found.logits - grid.lab).abs().mean()) < 0.05


def ball() -> ScenePoints:
    """Points of a ball with outward normals, red in the upper half and blue in the lower half."""
    up = torch.randn(4000, 3, generator=torch.Generator().manual_seed(0))
    up = torch.nn.functional.normalize(up, dim=1)
    lab = torch.where(up[:, 2:] > 0, torch.tensor([50.0, 60, 40]), torch.tensor([40.0, 10, -50]))
    return ScenePoints(0.15 * up, lab, up, torch.full((4000,), 0.9), up)
