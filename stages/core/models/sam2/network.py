"""Feeding SAM 2.1: photos to pixel values, prompts to masks, masks of one photo to masks of all of a sequence."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from transformers import Sam2VideoInferenceSession, Sam2VideoModel

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, as published in preprocessor_config.json
OUTSIDE, INSIDE, CORNER, OPPOSITE = 0, 1, 2, 3  # what a click may say; a box is its two corners


@dataclass(frozen=True)
class PointPrompts:
    """What points at one object in one photo."""

    points: Float[Tensor, "k 2"]  # x, y [share of the photo's width and height]
    labels: Int[Tensor, "k"]  # OUTSIDE or INSIDE; CORNER and OPPOSITE

    @classmethod
    def box(cls, corners: Float[Tensor, "4"]) -> PointPrompts:
        """A box x0 y0 x1 y1 around the object."""
        return cls(corners.reshape(2, 2), torch.tensor([CORNER, OPPOSITE]))

    @classmethod
    def inside(cls, point: Float[Tensor, "2"]) -> PointPrompts:
        return cls(point[None], torch.tensor([INSIDE]))


def input_side(model: Sam2VideoModel) -> int:
    """Width and height of the images that the network takes [px]: 1024 for those published."""
    return int(model.prompt_encoder.input_image_size)


def pixel_values(image: Float[Tensor, "h w 3"], side: int) -> Float[Tensor, "3 s s"]:
    """A photo as the network was trained on: squeezed to a square with antialiasing, and normalised."""
    square = torch.nn.functional.interpolate(
        image.permute(2, 0, 1)[None], (side, side), mode="bilinear", align_corners=False, antialias=True
    )[0]
    return (square - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]


class StreamingSession(Sam2VideoInferenceSession):
    """A sequence of photos that are read when their turn comes, and a memory that does not grow with their number."""

    def __init__(self, frame: Callable[[int], Float[Tensor, "3 s s"]], count: int, device: torch.device):
        super().__init__(inference_device=device, inference_state_device=device, dtype=torch.float32)
        self._frame, self._count = frame, count

    @property
    def num_frames(self) -> int:
        return self._count

    def get_frame(self, frame_idx: int) -> Float[Tensor, "3 s s"]:
        return self._frame(frame_idx).to(self.inference_device)

    def forget(self, now: int, start: int, memories: int, pointers: int) -> None:
        """Drop what no later frame looks at.

        The network attends to the prompted frame `start`, to the memories of the last `memories` frames and to the
        object pointers of the last `pointers`, counted from the frame it is at, and on its way back from `start`.
        """
        for outputs in self.output_dict_per_obj.values():
            for kept in (*outputs["cond_frame_outputs"].values(), *outputs["non_cond_frame_outputs"].values()):
                kept.pop("high_res_masks", None)  # 4 MB each, and read only while their frame is at work
            tracked = outputs["non_cond_frame_outputs"]
            for t in list(tracked):
                age = min(abs(t - now), abs(t - start))
                tracked[t].pop("pred_masks", None)
                if age >= pointers:
                    del tracked[t]
                elif age >= memories:
                    tracked[t].pop("maskmem_features", None)
                    tracked[t].pop("maskmem_pos_enc", None)


def propagate_masks(
    model: Sam2VideoModel,
    frame: Callable[[int], Float[Tensor, "3 s s"]],
    count: int,
    prompts: Sequence[PointPrompts] | Bool[Tensor, "o h w"],
    start: int = 0,
) -> Iterator[tuple[int, Float[Tensor, "o l l"]]]:
    """Logits of the objects' masks, positive inside, in every photo of a sequence, at a quarter of the network's size.

    `prompts` show the objects in photo `start`, by clicks or by masks; from there memory attention carries them
    forwards to the end, then backwards to the first. `frame` gives the pixel values of a photo and is asked for each
    of the `count` once.
    """
    session = StreamingSession(frame, count, model.device)
    for number, prompt in enumerate(prompts):
        row = session.obj_id_to_idx(number)
        if isinstance(prompt, PointPrompts):
            points = prompt.points * input_side(model)
            clicks = {"point_coords": points[None, None].float(), "point_labels": prompt.labels[None, None].int()}
            session.add_point_inputs(row, start, clicks)
        else:
            session.add_mask_inputs(row, start, _enlarged(prompt, input_side(model)))
    session.obj_with_new_inputs = list(session.obj_ids)
    memories, pointers = model.config.num_maskmem, model.config.max_object_pointers_in_encoder
    for now in [*range(start, count), *range(start - 1, -1, -1)]:
        masks = model(inference_session=session, frame_idx=now, reverse=now < start).pred_masks
        session.forget(now, start, memories, pointers)
        yield now, masks[:, 0].float().cpu().clone()


def _enlarged(mask: Bool[Tensor, "h w"], side: int) -> Float[Tensor, "1 1 s s"]:
    size = {"size": (side, side), "mode": "bilinear", "align_corners": False, "antialias": True}
    return (torch.nn.functional.interpolate(mask[None, None].float(), **size) >= 0.5).float()
