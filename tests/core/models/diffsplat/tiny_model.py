"""A small DiffSplat with random weights, in the published layout of folders and names."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from safetensors.torch import save_file

from stages.core.models.diffsplat.weights import BASE, GSVAE, UNET

if TYPE_CHECKING:
    from diffusers import AutoencoderKL, UNet2DConditionModel

SIDE = 32  # side of the images [px]; latents have half of it
WIDTHS = (8, 16)
SCHEDULER = {  # the scheduler of Stable Diffusion 1.5
    "_class_name": "PNDMScheduler", "beta_end": 0.012, "beta_schedule": "scaled_linear", "beta_start": 0.00085,
    "num_train_timesteps": 1000, "set_alpha_to_one": False, "skip_prk_steps": True, "steps_offset": 1,
    "trained_betas": None, "clip_sample": False,
}  # fmt: skip
UNET_CONFIG = {
    "_class_name": "UNetMV2DConditionModel", "_diffusers_version": "0.32.0", "sample_size": SIDE // 2,
    "in_channels": 11, "out_channels": 4, "block_out_channels": WIDTHS, "layers_per_block": 1, "norm_num_groups": 4,
    "down_block_types": ["CrossAttnDownBlockMV2D", "DownBlock2D"], "mid_block_type": "UNetMidBlockMV2DCrossAttn",
    "up_block_types": ["UpBlock2D", "CrossAttnUpBlockMV2D"], "cross_attention_dim": 16, "attention_head_dim": 2,
    "view_concat_condition": True, "input_concat_plucker": True, "input_concat_binary_mask": True,
}  # fmt: skip


def unet(in_channels: int = 11, **more) -> UNet2DConditionModel:
    """The U-Net that UNET_CONFIG describes, built directly."""
    from diffusers import UNet2DConditionModel

    torch.manual_seed(0)
    return UNet2DConditionModel(
        sample_size=SIDE // 2, in_channels=in_channels, out_channels=4, block_out_channels=WIDTHS, layers_per_block=1,
        norm_num_groups=4, down_block_types=("CrossAttnDownBlock2D", "DownBlock2D"),
        up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"), cross_attention_dim=16, attention_head_dim=2, **more,
    )  # fmt: skip


def autoencoder(channels: int, widths: tuple[int, ...] = WIDTHS) -> AutoencoderKL:
    """Small autoencoder of `channels` channels with random weights."""
    from diffusers import AutoencoderKL

    torch.manual_seed(channels)
    return AutoencoderKL(
        in_channels=channels, out_channels=channels, layers_per_block=1, block_out_channels=widths,
        down_block_types=("DownEncoderBlock2D",) * len(widths), up_block_types=("UpDecoderBlock2D",) * len(widths),
        norm_num_groups=4, latent_channels=4,
    )  # fmt: skip


def save_tiny_model(folder: Path) -> Path:
    """Write U-Net, Gaussian autoencoder and Stable Diffusion parts into a folder."""
    ema = folder / UNET / "checkpoints/013020/unet_ema"
    ema.mkdir(parents=True)
    (ema / "config.json").write_text(json.dumps(UNET_CONFIG))
    save_file(unet().state_dict(), ema / "diffusion_pytorch_model.safetensors")
    steps = folder / GSVAE / "checkpoints/039030"
    steps.mkdir(parents=True)
    state = {f"vae.{k}": v for k, v in autoencoder(12).state_dict().items()}
    save_file({**state, "tiny_decoder.layers.0.weight": torch.zeros(3)}, steps / "model.safetensors")
    save_stable_diffusion(folder / BASE, autoencoder(3))
    return folder


def save_stable_diffusion(base: Path, vae: AutoencoderKL) -> None:
    """Write tokenizer, text encoder, autoencoder and scheduler."""
    from transformers import CLIPTextConfig, CLIPTextModel

    vae.save_config(base / "vae")
    save_file(legacy_names(vae.state_dict()), base / "vae/diffusion_pytorch_model.safetensors")
    torch.manual_seed(3)
    text = CLIPTextConfig(
        vocab_size=40, hidden_size=16, intermediate_size=32, num_hidden_layers=2, num_attention_heads=2,
        max_position_embeddings=12, bos_token_id=0, eos_token_id=1,
    )  # fmt: skip
    text.save_pretrained(base / "text_encoder")
    state = {f"text_model.{k.removeprefix('text_model.')}": v for k, v in CLIPTextModel(text).state_dict().items()}
    save_file(state, base / "text_encoder/model.safetensors", metadata={"format": "pt"})
    (base / "scheduler").mkdir()
    (base / "scheduler/scheduler_config.json").write_text(json.dumps(SCHEDULER))
    _tokenizer(base / "tokenizer")


def legacy_names(state: dict) -> dict:
    """State dict with the attention names of the published autoencoder of Stable Diffusion 1.5."""
    names = {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}
    out = {}
    for name, value in state.items():
        for new, old in names.items():
            name = name.replace(f"attentions.0.{new}", f"attentions.0.{old}")
        out[name] = value
    return out


def _tokenizer(folder: Path) -> None:
    """Write a tokenizer of single letters, within and at the end of words, without merges."""
    letters = "abcdefghijklmnopq,"
    tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{letter}</w>" for letter in letters)]
    folder.mkdir()
    (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(tokens)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    (folder / "tokenizer_config.json").write_text(json.dumps({"model_max_length": 12, "do_lower_case": True}))
