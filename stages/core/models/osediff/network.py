"""OSEDiff's single denoising step on top of diffusers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.models.osediff.weights import TIMESTEP
from stages.core.models.stable_diffusion import encode_prompts

if TYPE_CHECKING:
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from transformers import CLIPTextModel, CLIPTokenizer


@dataclass(frozen=True)
class OSEDiff:
    """The loaded parts, all on one device, with the low-rank updates merged."""

    tokenizer: CLIPTokenizer
    text_encoder: CLIPTextModel
    vae: AutoencoderKL
    unet: UNet2DConditionModel
    signal: float  # fraction of the variance that is signal at TIMESTEP

    @torch.no_grad()
    def restore(self, image: Float[Tensor, "h w 3"], prompt: str = "", seed: int = 0) -> Float[Tensor, "h w 3"]:
        """Restore detail in an image (0..1); returns it on the CPU with its size unchanged, so upscale it beforehand.

        The image's latent is taken as the noisiest state of the diffusion, and denoised in one step. For the
        autoencoder the image is padded at its right and bottom by repeating its border. The latent is drawn on the
        CPU, so that a seed gives the same noise on every device.
        """
        height, width = image.shape[:2]
        source = image.permute(2, 0, 1)[None].to(self.unet.device)
        factor = 2 ** (len(self.vae.config.block_out_channels) - 1)  # 8
        padding = (0, -width % factor, 0, -height % factor)
        padded = torch.nn.functional.pad(2 * source - 1, padding, mode="replicate")
        generator = torch.Generator().manual_seed(seed)
        latent = self.vae.encode(padded).latent_dist.sample(generator) * self.vae.config.scaling_factor
        text = encode_prompts(self.tokenizer, self.text_encoder, [prompt])
        with torch.autocast(source.device.type, torch.bfloat16, enabled=source.device.type == "cuda"):
            noise = self.unet(latent, TIMESTEP, text, return_dict=False)[0]
        clean = (latent - (1 - self.signal) ** 0.5 * noise.float()) / self.signal**0.5
        decoded = self.vae.decode(clean / self.vae.config.scaling_factor).sample[..., :height, :width]
        return match_colours(decoded.clamp(-1, 1) / 2 + 0.5, source)[0].permute(1, 2, 0).cpu()


def match_colours(image: Float[Tensor, "b 3 h w"], source: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Give each channel of an image the mean and standard deviation of that of `source`, clamped to 0..1.

    Source: Huang and Belongie 2017, "Arbitrary style transfer in real-time with adaptive instance normalization",
    equation 8; this is the default of the public code, which also adds 1e-5 to the variances.
    """
    statistics = [(x.mean((2, 3), keepdim=True), (x.var((2, 3), keepdim=True) + 1e-5).sqrt()) for x in (image, source)]
    (mean, deviation), (wanted_mean, wanted_deviation) = statistics
    return ((image - mean) / deviation * wanted_deviation + wanted_mean).clamp(0, 1)
