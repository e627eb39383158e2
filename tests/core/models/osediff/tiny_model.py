"""A small OSEDiff with random weights, in the published layout of folders and names."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import torch
from safetensors.torch import save_file

from stages.core.models.osediff.weights import BASE, LORA
from tests.core.models.diffsplat import tiny_model

if TYPE_CHECKING:
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from torch import nn

RANK = 4  # rank of the updates, as in the published training command
UNET_PARTS = ("to_k", "to_q", "to_v", "to_out.0", "conv", "proj_out", "proj_in", "ff.net.2", "ff.net.0.proj")
VAE_PARTS = ("conv", "to_k", "to_q", "to_v", "to_out.0")


def unet() -> UNet2DConditionModel:
    """A U-Net whose projections are linear, as in Stable Diffusion 2."""
    return tiny_model.unet(in_channels=4, use_linear_projection=True)


def autoencoder() -> AutoencoderKL:
    """An autoencoder that reduces image sides to 1/8, as the published one."""
    return tiny_model.autoencoder(3, (8, 8, 8, 16))


def lora_file(rank: int = RANK) -> dict:
    """Random updates of all layers that the published code updates, with its entries and names."""
    networks, rng = {"unet": unet(), "vae": autoencoder()}, torch.Generator().manual_seed(5)
    names = [n.removesuffix(".weight") for n, _ in networks["unet"].named_parameters() if "bias" not in n]
    names = [n for n in names if "norm" not in n and any(part in n for part in UNET_PARTS)]
    encoder = [n for n in names if "down_blocks" in n or n == "conv_in"]
    decoder = [n for n in names if "up_blocks" in n or n == "conv_out"]
    others = [n for n in names if n not in encoder and n not in decoder]
    images = [n.removesuffix(".weight") for n, _ in networks["vae"].named_parameters() if "bias" not in n]
    images = [n for n in images if "norm" not in n and n.startswith("encoder.") and any(p in n for p in VAE_PARTS)]
    images = [*images, "quant_conv", *images]  # the published code lists most of them several times
    state = {network: {} for network in networks}
    adapters = (("unet", "encoder", encoder), ("unet", "decoder", decoder), ("unet", "others", others),
                ("vae", "encoder", images))  # fmt: skip
    for network, adapter, listed in adapters:
        for name in listed:
            weight = networks[network].get_submodule(name).weight
            shapes = (rank, *weight.shape[1:]), (len(weight), rank, *[1] * (weight.dim() - 2))
            for letter, shape in zip("AB", shapes, strict=True):
                key = f"{name}.lora_{letter}.default_{adapter}.weight"
                state[network][key] = 0.15 * torch.randn(shape, generator=rng)
    for name, value in networks["unet"].conv_in.state_dict().items():
        state["unet"][f"conv_in.base_layer.{name}"] = value + 0.1 * torch.randn(value.shape, generator=rng)
    return {
        "vae_lora_encoder_modules": images, "unet_lora_encoder_modules": encoder, "unet_lora_decoder_modules": decoder,
        "unet_lora_others_modules": others, "rank_unet": rank, "rank_vae": rank,
        "state_dict_unet": state["unet"], "state_dict_vae": state["vae"],
    }  # fmt: skip


def save_network(network: nn.Module, folder: Path) -> None:
    """Write a network in the layout of diffusers."""
    network.save_config(folder)
    save_file(network.state_dict(), folder / "diffusion_pytorch_model.safetensors")


def save_tiny_osediff(folder: Path) -> Path:
    """Write all parts of the model into osediff/ of a folder."""
    base = folder / "osediff" / BASE
    tiny_model.save_stable_diffusion(base, autoencoder())
    save_network(unet(), base / "unet")
    torch.save(lora_file(), folder / "osediff" / LORA)
    return folder
