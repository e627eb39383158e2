"""Automatic masks equal those of the image model for the same points, filtered and without duplicates."""

import pytest
import torch

from tests.core.models.sam2.tiny_model import SIDE, random_model


@pytest.fixture(scope="module")
def generation():
    """The tested module; importing it takes a second, because it imports transformers' models."""
    from stages.core.models.sam2 import mask_generation

    return mask_generation


def test_masks_equal_those_of_the_image_model(generation):
    from transformers import Sam2Config, Sam2Model

    video = random_model()
    parts = {k: getattr(video.config, f"{k}_config") for k in ("vision", "prompt_encoder", "mask_decoder")}
    config = Sam2Config(**{f"{k}_config": {**v.to_dict()} for k, v in parts.items()})
    image = Sam2Model(config).eval()
    image.load_state_dict({k: v for k, v in video.state_dict().items() if k in image.state_dict()})
    pixels = torch.randn(3, SIDE, SIDE, generator=torch.Generator().manual_seed(2))
    steps = (torch.arange(4) + 0.5) / 4 * SIDE
    points = torch.cartesian_prod(steps, steps).flip(1)  # row by row
    with torch.no_grad():
        expected = image(pixel_values=pixels[None], input_points=points[None, :, None],
                       input_labels=torch.ones(1, 16, 1, dtype=torch.int32), multimask_output=True)  # fmt: skip
    unfiltered = generation.MaskGenerationOptions(grid=4, batch=5, min_iou=-9.0, min_stability=0.0, max_iou=1.0)
    proposals = generation.propose_masks(video, pixels, unfiltered)
    masks, scores = expected.pred_masks.flatten(0, 2) > 0, expected.iou_scores.flatten()
    order = generation.suppress_duplicates(masks, scores, 1.0)
    assert len(order) > 10 and torch.equal(proposals.masks, masks[order])
    torch.testing.assert_close(proposals.scores, scores[order], rtol=1e-5, atol=1e-5)
    median = float(scores.median())
    filtered = generation.MaskGenerationOptions(grid=4, batch=16, min_iou=median, min_stability=0.0, max_iou=1.0)
    selected = generation.propose_masks(video, pixels, filtered)
    assert 0 < len(selected.masks) < len(proposals.masks) and float(selected.scores.min()) >= median


def test_stability_of_known_logits(generation):
    row = torch.tensor([[-3.0, -0.5, 0.5, 0.9, 2.0, 3.0]])  # two are above 1, five above -1
    soft, hard = row[None], torch.tensor([[[-9.0, -9, 9, 9, 9, 9]]])
    torch.testing.assert_close(
        generation.mask_stability(torch.cat([soft, hard, hard - 100])), torch.tensor([0.4, 1.0, 0.0])
    )


def test_duplicate_with_the_lower_score_is_removed(generation):
    masks = torch.zeros(5, 1, 20, dtype=torch.bool)
    masks[0, 0, :10] = True
    masks[1, 0, 1:11] = True  # 9 of the 11 pixels in its union with the first mask are shared: IoU 0.82
    masks[2, 0, :5] = True  # a part of the first mask, with an IoU of 0.5
    masks[3, 0, 12:] = True
    scores = torch.tensor([0.8, 0.9, 0.95, 0.7, 1.0])  # the fifth mask is empty
    assert generation.suppress_duplicates(masks, scores, 0.7).tolist() == [2, 1, 3]
    assert generation.suppress_duplicates(masks, scores, 0.9).tolist() == [2, 1, 0, 3]
    assert generation.suppress_duplicates(masks[:0], scores[:0], 0.7).tolist() == []
