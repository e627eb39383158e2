"""ALIKED and LightGlue: behaviour of their components, and published parameter counts."""

import torch
import torch.nn.functional as F

from stages.core.models.matching.aliked import ALIKED, DeformableConv, peaks, sample, suppress_nonmaxima
from stages.core.models.matching.lightglue import LightGlue, Position, _rotated, mutual, normalised


def test_deformable_convolution_with_zero_offsets_is_a_convolution():
    conv = DeformableConv(4, 6)
    torch.nn.init.zeros_(conv.offset_conv.weight)
    torch.nn.init.zeros_(conv.offset_conv.bias)
    x = torch.randn(1, 4, 9, 11)
    torch.testing.assert_close(conv(x), F.conv2d(x, conv.regular_conv.weight, padding=1), rtol=0, atol=1e-5)


def test_constant_offset_of_one_pixel_shifts_the_image():
    conv = DeformableConv(2, 3)
    torch.nn.init.zeros_(conv.offset_conv.weight)
    with torch.no_grad():
        conv.offset_conv.bias.copy_(torch.tensor([1.0, 0.0]).repeat(9))  # dy, dx
    x = torch.randn(1, 2, 10, 8)
    unshifted = F.conv2d(x, conv.regular_conv.weight, padding=1)
    torch.testing.assert_close(conv(x)[:, :, 1:-2], unshifted[:, :, 2:-1], rtol=0, atol=1e-5)


def test_sampling_is_bilinear_and_zero_outside():
    x = torch.arange(12.0).reshape(1, 1, 3, 4)
    positions = torch.tensor([[[[1.0, 2.0], [1.5, 2.0], [-5.0, 0.0]]]])
    torch.testing.assert_close(sample(x, positions)[0, 0, 0], torch.tensor([9.0, 9.5, 0.0]))


def test_peaks_have_subpixel_accuracy_and_respect_limits():
    ys, xs = torch.meshgrid(torch.arange(30.0), torch.arange(40.0), indexing="ij")
    centres = torch.tensor([[10.0, 8.0], [25.3, 20.0]])
    scores = sum(0.9 * (-((xs - x) ** 2 + (ys - y) ** 2) / 4).exp() for x, y in centres)[None, None]
    found = peaks(scores, 10, 0.2)
    assert len(found) == 2
    nearest = torch.cdist(centres, found).amin(1)
    assert float(nearest[0]) < 0.01 and float(nearest[1]) < 0.2
    assert len(peaks(scores, 1, 0.2)) == 1 and len(peaks(scores, 10, 0.95)) == 0


def test_nonmaximum_suppression_is_local():
    scores = torch.zeros(1, 1, 1, 12)
    scores[..., [2, 4, 9]] = torch.tensor([0.9, 0.8, 0.5])
    kept = torch.nonzero(suppress_nonmaxima(scores)[0, 0, 0])[:, 0]
    assert kept.tolist() == [2, 9]


def test_mutual_matches_are_mutual_maxima_above_the_threshold():
    scores = torch.tensor([[0.9, 0.1, 0.0], [0.8, 0.2, 0.0], [0.0, 0.0, 0.05]])
    assert mutual(scores).tolist() == [[0, 0]]


def test_rotary_attention_depends_on_relative_positions_only():
    """A shift of all keypoints leaves the products of queries and keys unchanged."""
    position, q, k = Position(), torch.randn(4, 1, 64), torch.randn(4, 1, 64)
    a, b = torch.tensor([[0.1, 0.2]]), torch.tensor([[-0.3, 0.5]])
    shift = torch.tensor([[0.7, -0.4]])
    before = (_rotated(q, position(a)) * _rotated(k, position(b))).sum(-1)
    after = (_rotated(q, position(a + shift)) * _rotated(k, position(b + shift))).sum(-1)
    torch.testing.assert_close(before, after, rtol=0, atol=1e-4)


def test_longer_side_is_normalised_to_minus_one_to_one():
    positions = normalised(torch.tensor([[0.0, 0.0], [200.0, 100.0]]), (200, 100))
    torch.testing.assert_close(positions, torch.tensor([[-1.0, -0.5], [1.0, 0.5]]))


def test_published_parameter_counts():
    assert sum(p.numel() for p in ALIKED().parameters()) == 677_356
    assert sum(p.numel() for p in LightGlue().parameters()) == 11_884_625
