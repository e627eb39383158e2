"""Propagation with bounded memory equals the reference implementation of transformers."""

import numpy as np
import pytest
import torch

from stages.core.models.promptable import PointPrompts
from tests.core.models.sam2.tiny_model import SIDE, random_model

COUNT, START = 13, 4
BOX, POINT = torch.tensor([0.1, 0.1, 0.5, 0.6]), torch.tensor([0.7, 0.4])


@pytest.fixture(scope="module")
def network():
    """The tested module; importing it takes a second, because it subclasses a class of transformers."""
    from stages.core.models.sam2 import network

    return network


@pytest.fixture(scope="module")
def model():
    return random_model()


@pytest.fixture(scope="module")
def video():
    return torch.randn(COUNT, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(1))


def reference_masks(model, video, add_prompts) -> dict[int, torch.Tensor]:
    """Reference masks by the iterators of transformers, with all frames and outputs in memory."""
    from transformers import Sam2VideoInferenceSession

    session = Sam2VideoInferenceSession(video=video, dtype=torch.float32)
    session.obj_with_new_inputs = add_prompts(session)
    out = {}
    for reverse in (False, True):
        for frame in model.propagate_in_video_iterator(session, start_frame_idx=START, reverse=reverse):
            out[frame.frame_idx] = frame.pred_masks[:, 0]
    return out


def add_clicks(session) -> list[int]:
    for i, (points, labels) in enumerate([(BOX.reshape(2, 2), [2, 3]), (POINT[None], [1])]):
        row = session.obj_id_to_idx(i)
        session.add_point_inputs(row, START, {"point_coords": points[None, None] * SIDE,
                                              "point_labels": torch.tensor(labels)[None, None].int()})  # fmt: skip
    return [0, 1]


def example_mask() -> torch.Tensor:
    mask = torch.zeros(SIDE // 4, SIDE // 4, dtype=torch.bool)
    mask[5:20, 8:16] = True
    return mask


def add_mask(session) -> list[int]:
    upsampled = torch.nn.functional.interpolate(example_mask()[None, None].float(), (SIDE, SIDE), mode="bilinear",
                                            antialias=True)  # fmt: skip
    session.add_mask_inputs(session.obj_id_to_idx(0), START, (upsampled >= 0.5).float())
    return [0]


@pytest.mark.parametrize(
    ("prompts", "add_prompts"),
    [([PointPrompts.box(BOX), PointPrompts.inside(POINT)], add_clicks), (example_mask()[None], add_mask)],
    ids=["clicks", "mask"],
)
def test_propagation_equals_transformers_with_full_memory(network, model, video, prompts, add_prompts):
    actual = dict(network.propagate_masks(model, lambda i: video[i], COUNT, prompts, START))
    assert list(actual) == [*range(START, COUNT), *range(START - 1, -1, -1)]
    for t, masks in reference_masks(model, video, add_prompts).items():
        torch.testing.assert_close(actual[t], masks, rtol=0, atol=0)
    spread = torch.stack([actual[t] for t in range(COUNT)]).std(0)
    assert float(spread.mean()) > 1e-3  # the frames differ, so the comparison is not trivial


def test_masks_depend_on_earlier_frames(network, model, video):
    """A change of the second frame changes the masks of the third through the memory."""
    changed = video.clone()
    changed[1] = changed[1].flip(-1)
    original, altered = (
        [m for _, m in network.propagate_masks(model, lambda i, v=v: v[i], 3, [PointPrompts.box(BOX)])]
        for v in (video, changed)
    )
    assert torch.equal(original[0], altered[0]) and float((original[2] - altered[2]).abs().max()) > 1e-3


def test_memory_is_bounded_and_each_frame_is_read_once(network, model, monkeypatch):
    sessions, read = [], []

    class RecordingSession(network.StreamingSession):
        def __init__(self, *args):
            super().__init__(*args)
            sessions.append(self)

    def frame(i):
        read.append(i)
        return torch.full((3, SIDE, SIDE), i / 40)

    def memory_bytes() -> int:
        outputs = sessions[-1].output_dict_per_obj[0]
        kept = (*outputs["cond_frame_outputs"].values(), *outputs["non_cond_frame_outputs"].values())
        return sum(
            x.numel() * x.element_size() for output in kept for x in output.values() if isinstance(x, torch.Tensor)
        )

    monkeypatch.setattr(network, "StreamingSession", RecordingSession)
    sizes = [memory_bytes() for _ in network.propagate_masks(model, frame, 40, [PointPrompts.box(BOX)])]
    assert sorted(read) == list(range(40))
    assert sizes[39] <= sizes[14] and sizes[14] > 0
    assert sessions[-1].processed_frames is None


def test_pixel_values_equal_pillow_resize_and_published_normalisation(network):
    Image = pytest.importorskip("PIL.Image")
    pixels = (torch.rand(90, 210, 3, generator=torch.Generator().manual_seed(0)) * 255).round()
    pillow = Image.fromarray(pixels.numpy().astype(np.uint8)).resize((64, 64), Image.BILINEAR)
    expected = (torch.from_numpy(np.array(pillow)).float() / 255 - torch.tensor([0.485, 0.456, 0.406])) / torch.tensor(
        [0.229, 0.224, 0.225]
    )
    actual = network.pixel_values(pixels / 255, 64).permute(1, 2, 0)
    torch.testing.assert_close(actual, expected, rtol=0, atol=1.01 / 255 / 0.224)  # Pillow rounds twice to 8 bits
