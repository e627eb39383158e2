"""Inference with SAM 2.1: preprocessing of photos, and propagation of prompts in one photo to masks in all photos."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from transformers import Sam2VideoInferenceSession, Sam2VideoModel

from stages.core.models.promptable import FrameReader, MaskLogits, PointPrompts, Prompts

# mean and standard deviation of the colours of ImageNet, as published in preprocessor_config.json
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def input_side(model: Sam2VideoModel) -> int:
    """Width and height of the network's input image [px]: 1024 for the published networks."""
    return int(model.prompt_encoder.input_image_size)


def pixel_values(image: Float[Tensor, "h w 3"], side: int) -> Float[Tensor, "3 s s"]:
    """Network input for a photo: resized to a square with antialiasing, then normalised by MEAN and STD."""
    square = torch.nn.functional.interpolate(
        image.permute(2, 0, 1)[None], (side, side), mode="bilinear", align_corners=False, antialias=True
    )[0]
    return (square - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]


class StreamingSession(Sam2VideoInferenceSession):
    """Inference session that loads frames on demand and whose memory does not grow with their number."""

    def __init__(self, frame: FrameReader, count: int, device: torch.device):
        super().__init__(inference_device=device, inference_state_device=device, dtype=torch.float32)
        self._frame, self._count = frame, count

    @property
    def num_frames(self) -> int:
        """Number of frames of the sequence."""
        return self._count

    def get_frame(self, frame_idx: int) -> Float[Tensor, "3 s s"]:
        """Pixel values of a frame, on the inference device."""
        return self._frame(frame_idx).to(self.inference_device)

    def release(self, now: int, start: int, memories: int, pointers: int) -> None:
        """Delete the outputs that no later frame attends to.

        The network attends to the prompted frame `start`, to the memory features of the last `memories` frames and to
        the object pointers of the last `pointers` frames, counted from the current frame `now` or, in the backward
        pass, from `start`.
        """
        for outputs in self.output_dict_per_obj.values():
            for kept in (*outputs["cond_frame_outputs"].values(), *outputs["non_cond_frame_outputs"].values()):
                kept.pop("high_res_masks", None)  # 4 MB each, and read only while their frame is processed
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
    model: Sam2VideoModel, frame: FrameReader, count: int, prompts: Prompts, start: int = 0
) -> MaskLogits:
    """Yield mask logits of the objects, positive inside, for each photo, at a quarter of the network's input size.

    `prompts` mark the objects in photo `start`, by points or by masks; memory attention propagates them forwards to
    the last photo, then backwards to the first. `frame` returns the pixel values of a photo and is called once for
    each of the `count` photos.
    """
    session = StreamingSession(frame, count, model.device)
    for number, prompt in enumerate(prompts):
        row = session.obj_id_to_idx(number)
        if isinstance(prompt, PointPrompts):
            points = prompt.points * input_side(model)
            inputs = {"point_coords": points[None, None].float(), "point_labels": prompt.labels[None, None].int()}
            session.add_point_inputs(row, start, inputs)
        else:
            session.add_mask_inputs(row, start, _enlarged(prompt, input_side(model)))
    session.obj_with_new_inputs = list(session.obj_ids)
    memories, pointers = model.config.num_maskmem, model.config.max_object_pointers_in_encoder
    for now in [*range(start, count), *range(start - 1, -1, -1)]:
        masks = model(inference_session=session, frame_idx=now, reverse=now < start).pred_masks
        session.release(now, start, memories, pointers)
        yield now, masks[:, 0].float().cpu().clone()


def _enlarged(mask: Bool[Tensor, "h w"], side: int) -> Float[Tensor, "1 1 s s"]:
    """Resize a mask to the network's input size."""
    size = {"size": (side, side), "mode": "bilinear", "align_corners": False, "antialias": True}
    return (torch.nn.functional.interpolate(mask[None, None].float(), **size) >= 0.5).float()
