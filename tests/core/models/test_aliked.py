"""ALIKED and LightGlue: their parts against what they mean, their sizes against the published ones."""

import torch
import torch.nn.functional as F

from stages.core.models.matching.aliked import ALIKED, DeformableConv, peaks, sample, suppress_nonmaxima
from stages.core.models.matching.lightglue import LightGlue, Position, _rotated, mutual, normalised


def test_without_movement_a_deformable_convolution_is_a_convolution():
    conv = DeformableConv(4, 6)
    torch.nn.init.zeros_(conv.offset_conv.weight)
    torch.nn.init.zeros_(conv.offset_conv.bias)
    x = torch.randn(1, 4, 9, 11)
    torch.testing.assert_close(conv(x), F.conv2d(x, conv.regular_conv.weight, padding=1), rtol=0, atol=1e-5)


def test_taps_moved_by_a_pixel_see_the_image_shifted_by_one():
    conv = DeformableConv(2, 3)
    torch.nn.init.zeros_(conv.offset_conv.weight)
    with torch.no_grad():
        conv.offset_conv.bias.copy_(torch.tensor([1.0, 0.0]).repeat(9))  # dy, dx
    x = torch.randn(1, 2, 10, 8)
    still = F.conv2d(x, conv.regular_conv.weight, padding=1)
    torch.testing.assert_close(conv(x)[:, :, 1:-2], still[:, :, 2:-1], rtol=0, atol=1e-5)


def test_samples_at_pixels_are_the_pixels_and_between_them_their_mean():
    x = torch.arange(12.0).reshape(1, 1, 3, 4)
    at = torch.tensor([[[[1.0, 2.0], [1.5, 2.0], [-5.0, 0.0]]]])
    torch.testing.assert_close(sample(x, at)[0, 0, 0], torch.tensor([9.0, 9.5, 0.0]))


def test_peaks_are_found_below_a_pixel_and_apart():
    ys, xs = torch.meshgrid(torch.arange(30.0), torch.arange(40.0), indexing="ij")
    centres = torch.tensor([[10.0, 8.0], [25.3, 20.0]])
    scores = sum(0.9 * (-((xs - x) ** 2 + (ys - y) ** 2) / 4).exp() for x, y in centres)[None, None]
    found = peaks(scores, 10, 0.2)
    assert len(found) == 2
    nearest = torch.cdist(centres, found).amin(1)
    assert float(nearest[0]) < 0.01 and float(nearest[1]) < 0.2
    assert len(peaks(scores, 1, 0.2)) == 1 and len(peaks(scores, 10, 0.95)) == 0


def test_a_maximum_silences_its_neighbours_only():
    scores = torch.zeros(1, 1, 1, 12)
    scores[..., [2, 4, 9]] = torch.tensor([0.9, 0.8, 0.5])
    kept = torch.nonzero(suppress_nonmaxima(scores)[0, 0, 0])[:, 0]
    assert kept.tolist() == [2, 9]


def test_mutual_matches_are_each_others_best_and_probable():
    table = torch.tensor([[0.9, 0.1, 0.0], [0.8, 0.2, 0.0], [0.0, 0.0, 0.05]])
    assert mutual(table).tolist() == [[0, 0]]


def test_attention_sees_only_where_keypoints_are_to_each_other():
    """Rotary positions: a shift of all keypoints changes no product of query and key."""
    position, q, k = Position(), torch.randn(4, 1, 64), torch.randn(4, 1, 64)
    here, there = torch.tensor([[0.1, 0.2]]), torch.tensor([[-0.3, 0.5]])
    shift = torch.tensor([[0.7, -0.4]])
    before = (_rotated(q, position(here)) * _rotated(k, position(there))).sum(-1)
    after = (_rotated(q, position(here + shift)) * _rotated(k, position(there + shift))).sum(-1)
    torch.testing.assert_close(before, after, rtol=0, atol=1e-4)


def test_the_longer_side_goes_from_minus_one_to_one():
    places = normalised(torch.tensor([[0.0, 0.0], [200.0, 100.0]]), (200, 100))
    torch.testing.assert_close(places, torch.tensor([[-1.0, -0.5], [1.0, 0.5]]))


def test_the_published_sizes():
    assert sum(p.numel() for p in ALIKED().parameters()) == 677_356
    assert sum(p.numel() for p in LightGlue().parameters()) == 11_884_625
