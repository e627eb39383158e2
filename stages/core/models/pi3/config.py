"""Sizes of the network; the defaults are as published."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Pi3Config:
    """Sizes of the network."""

    width: int = 1024  # features per token
    head: int = 64  # features per attention head
    encoder_depth: int = 24  # blocks of the per-view encoder
    decoder_depth: int = 36  # blocks that attend alternately within a view and over all views
    head_depth: int = 5  # blocks of each output decoder
    camera_width: int = 512
    table: int = 37  # side of the learned table of position embeddings [patches]
    splat_widths: tuple[int, int, int] = (512, 512, 256)  # layer widths of the splat head on the patch grid
    splat_features: int = 128  # features of each of the splat head's two branches on the pixel grid

    @classmethod
    def of(cls, shapes: Mapping[str, Tensor]) -> Pi3Config:
        """Infer the sizes from a state dict with the names of π³.

        Raises KeyError, IndexError or TypeError for the state dict of another model.
        """

        def depth(prefix: str) -> int:
            return sum(name.startswith(prefix) and name.endswith(".norm1.weight") for name in shapes)

        splat = {}
        if "feature_head.down_proj.weight" in shapes:
            convs = [f"feature_head.upsample_proj.model.{i}.weight" for i in (0, 5, 10)]
            splat = {"splat_widths": tuple(len(shapes[name]) for name in convs),
                     "splat_features": len(shapes["feature_head.conv_net.layers.0.0.weight"])}  # fmt: skip
        return cls(
            width=shapes["register_token"].shape[-1],
            head=len(shapes["decoder.0.attn.q_norm.weight"]),
            encoder_depth=depth("encoder.blocks."),
            decoder_depth=depth("decoder."),
            head_depth=depth("point_decoder.blocks."),
            camera_width=len(shapes["camera_head.fc_t.weight"][0]),
            table=round((shapes["encoder.pos_embed"].shape[1] - 1) ** 0.5),
            **splat,
        )
