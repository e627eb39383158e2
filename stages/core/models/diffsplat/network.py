"""DiffSplat's sampler on top of diffusers, which jointly denoises four latent maps of one object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.models.diffsplat.maps import AZIMUTHS, cameras, plucker, to_gaussians
from stages.core.models.stable_diffusion import encode_prompts
from stages.core.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from diffusers import AutoencoderKL, DPMSolverMultistepScheduler, UNet2DConditionModel
    from transformers import CLIPTextModel, CLIPTokenizer

VIEWS = len(AZIMUTHS)
STEPS = 20  # number of steps of the sampler
GUIDANCE = (1.0, 2.0)  # classifier-free guidance of the view of the image, and of the opposite view
NEGATIVE = "worst quality, normal quality, low quality, low res, blurry, ugly, disgusting"


class MultiViewAttention:
    """Self-attention over the tokens of all `views` of an object: (b v) n d is treated as b (v n) d."""

    def __init__(self, views: int):
        from diffusers.models.attention_processor import AttnProcessor2_0

        self.views, self.plain = views, AttnProcessor2_0()

    def __call__(self, attn, hidden_states: Tensor, encoder_hidden_states: Tensor | None = None, **more) -> Tensor:
        joined = hidden_states.unflatten(0, (-1, self.views)).flatten(1, 2)
        return self.plain(attn, joined, **more).unflatten(1, (self.views, -1)).flatten(0, 1)


def share_attention(unet: UNet2DConditionModel, views: int = VIEWS + 1) -> None:
    """Make every self-attention of a U-Net multi-view; cross-attention to the text remains per view."""
    from diffusers.models.attention_processor import AttnProcessor2_0

    unet.set_attn_processor({
        name: MultiViewAttention(views) if name.endswith("attn1.processor") else AttnProcessor2_0()
        for name in unet.attn_processors
    })  # fmt: skip


def triangle(low: float, high: float, views: int = VIEWS) -> Float[Tensor, "v"]:
    """Guidance of each view: `low` for the first, linear to `high` for the opposite view, and back.

    Source: Voleti et al. 2024, "SV3D", section 3, "triangular CFG scaling".
    """
    steps = torch.arange(views)
    return low + (high - low) * torch.minimum(steps, views - steps) / (views // 2)


@dataclass(frozen=True)
class DiffSplat:
    """The loaded parts, all on one device."""

    tokenizer: CLIPTokenizer
    text_encoder: CLIPTextModel
    vae: AutoencoderKL  # autoencoder of images
    unet: UNet2DConditionModel  # 4 latent + 6 ray + 1 flag channels in, 4 out
    gsvae: AutoencoderKL  # autoencoder of maps of Gaussians
    scheduler: DPMSolverMultistepScheduler

    @property
    def side(self) -> int:
        """Width and height of images and maps [px]."""
        return self.unet.config.sample_size * 2 ** (len(self.vae.config.block_out_channels) - 1)

    def generate(self, image: Float[Tensor, "s s 3"], elevation: float, prompt: str = "", seed: int = 0) -> Gaussians:
        """Generate Gaussians of the whole object in an image, on the CPU, in DiffSplat's frame.

        `image` shows only the object on white, centred, its longer side 4/5 of the image. Its camera is camera 0, at
        `elevation` above the horizon [degrees]; the training range is -5 to 30.
        """
        viewmats = cameras(elevation)
        return to_gaussians(self.sample(image, viewmats, prompt, seed).cpu(), viewmats)

    @torch.no_grad()
    def sample(
        self, image: Float[Tensor, "s s 3"], viewmats: Float[Tensor, "v 4 4"], prompt: str = "", seed: int = 0
    ) -> Float[Tensor, "v 12 s s"]:
        """Sample the maps of Gaussians of the four views, in -1..1.

        Uses classifier-free guidance: the conditional branch gets the image latent and `prompt`, the unconditional one
        zeros and NEGATIVE. Noise is drawn on the CPU, so that a seed gives the same noise on every device.
        """
        device = self.unet.device
        text = encode_prompts(self.tokenizer, self.text_encoder, [NEGATIVE, prompt]).repeat_interleave(VIEWS + 1, 0)
        latent = self._image_latent(image.to(device))
        guidance = triangle(*GUIDANCE).to(device)[:, None, None, None]
        generator = torch.Generator().manual_seed(seed)
        x = torch.randn(VIEWS, *latent.shape[1:], generator=generator).to(device)
        condition = torch.stack([torch.zeros_like(latent), latent])
        rays = self._ray_channels(viewmats.to(device), latent.shape[-1])
        self.scheduler.set_timesteps(STEPS, device=device)
        for t in tqdm(self.scheduler.timesteps, desc="diffsplat", unit="step", leave=False):
            views = torch.cat([torch.cat([condition, x.expand(2, *x.shape)], 1), rays.expand(2, *rays.shape)], 2)
            with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
                output = self.unet(views.flatten(0, 1), t, text, return_dict=False)[0]
            negative, positive = output.float().unflatten(0, (2, VIEWS + 1))[:, 1:]
            noise = torch.randn(x.shape, generator=generator).to(device)
            x = self.scheduler.step(negative + guidance * (positive - negative), t, x, variance_noise=noise).prev_sample
        latents = x / self.gsvae.config.scaling_factor
        return torch.cat([self.gsvae.decode(z).sample for z in latents.split(1)]).clamp(-1, 1)

    def _ray_channels(self, viewmats: Float[Tensor, "v 4 4"], side: int) -> Float[Tensor, "w 7 z z"]:
        """Rays of the image and the views at latent resolution, and a flag: 0 for the image, 1 for generated views."""
        rays = plucker(viewmats.cpu(), self.side).to(viewmats)
        rays = torch.nn.functional.interpolate(rays, (side, side), mode="bilinear")
        flags = torch.ones(VIEWS + 1, 1, side, side).to(rays)
        flags[0] = 0
        return torch.cat([torch.cat([rays[:1], rays]), flags], 1)

    def _image_latent(self, image: Float[Tensor, "s s 3"]) -> Float[Tensor, "1 4 z z"]:
        """Latent of the image: the mean of the encoder, scaled."""
        latent = self.vae.encode(2 * image.permute(2, 0, 1)[None] - 1).latent_dist.mode()
        return latent * self.vae.config.scaling_factor
