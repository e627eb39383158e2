"""A tiny SAM 2.1 with random weights, in the published layout."""

from pathlib import Path

import torch

SIDE = 128  # side of the input images [px]
WIDTH = 128  # dimension of the tokens; the published 256 would also split object pointers into pieces of 64


def config(**changes):
    """Configuration of the tiny model with `changes` applied."""
    from transformers import Sam2VideoConfig
    from transformers.models.sam2_video.configuration_sam2_video import Sam2VideoMaskDecoderConfig

    backbone = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 8, "image_size": [SIDE, SIDE],
        "blocks_per_stage": [1, 1, 2, 1], "embed_dim_per_stage": [8, 16, 32, 64],
        "num_attention_heads_per_stage": [1, 1, 2, 2], "window_size_per_stage": [8, 4, 14, 7],
        "global_attention_blocks": [3], "window_positional_embedding_background_size": [4, 4],
    }  # fmt: skip
    vision = {
        "model_type": "sam2_vision_model", "backbone_config": backbone, "backbone_channel_list": [64, 32, 16, 8],
        "backbone_feature_sizes": [[SIDE // d] * 2 for d in (4, 8, 16)], "fpn_hidden_size": WIDTH,
    }  # fmt: skip
    decoder = Sam2VideoMaskDecoderConfig(hidden_size=WIDTH, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=32)
    return Sam2VideoConfig(**{
        "vision_config": vision, "prompt_encoder_config": {"hidden_size": WIDTH, "image_size": SIDE},
        "mask_decoder_config": decoder, "image_size": SIDE, "num_maskmem": 3, "max_object_pointers_in_encoder": 5,
        "memory_attention_hidden_size": WIDTH, "memory_attention_num_layers": 1,
        "memory_attention_feed_forward_hidden_size": 32, "memory_attention_rope_feat_sizes": [SIDE // 16] * 2,
        "memory_encoder_hidden_size": WIDTH, "mask_downsampler_embed_dim": WIDTH, "memory_fuser_embed_dim": WIDTH,
        "memory_fuser_intermediate_dim": 32, "memory_fuser_num_layers": 1, **changes,
    })  # fmt: skip


def random_model(seed: int = 0, **changes):
    """Model with weights large enough that prompts and memory affect the masks, and all objects count as visible."""
    from transformers import Sam2VideoModel

    model = Sam2VideoModel(config(**changes)).eval().requires_grad_(False)
    rng = torch.Generator().manual_seed(seed)
    for name, value in sorted(model.state_dict().items()):
        if value.dim() > 1 or "embedding" in name:
            value.copy_(torch.randn(value.shape, generator=rng) / max(1, value[0].numel()) ** 0.5)
        else:
            value.fill_(0.0 if name.endswith("bias") else 1.0)
    object_score = model.mask_decoder.pred_obj_score_head.proj_out
    object_score.weight.zero_()
    object_score.bias.fill_(5.0)
    for mlp in model.mask_decoder.output_hypernetworks_mlps:
        mlp.proj_out.bias.fill_(0.1)  # every mask has positive pixels
    return model


def save_tiny_model(folder: Path, seed: int = 0) -> Path:
    """Write a model into `folder` in the published layout."""
    random_model(seed).save_pretrained(folder)
    return folder
