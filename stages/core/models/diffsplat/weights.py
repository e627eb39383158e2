"""The published weights of DiffSplat (Stable Diffusion 1.5, one image): locate, check and load.

A folder holds three parts under their published names:

    gsdiff_gobj83k_sd15_image__render/checkpoints/NUMBER/unet_ema/   config.json, diffusion_pytorch_model.safetensors
    gsvae_gobj265k_sd/checkpoints/NUMBER/model.safetensors
    stable-diffusion-v1-5/                                           tokenizer/ text_encoder/ vae/ scheduler/

The U-Net's tensors have the names of those in Stable Diffusion; its 859,541,124 32-bit numbers are the 3.44 GB that the
hub lists. The names in the second file follow from the public code (an autoencoder with 12 channels in and out,
prefixed with `vae.`, and a `tiny_decoder.` used only in training); the file itself was not available for testing.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import nn

from stages.core.errors import InputError
from stages.core.models.diffsplat.maps import CHANNELS
from stages.core.models.hub import HubSource, folders
from stages.core.models.pi3.weights import differences, read_state
from stages.core.models.stable_diffusion import read_parts

if TYPE_CHECKING:
    from stages.core.models.diffsplat.network import DiffSplat

UNET, GSVAE, BASE = "gsdiff_gobj83k_sd15_image__render", "gsvae_gobj265k_sd", "stable-diffusion-v1-5"
PARTS = ("tokenizer", "text_encoder", "vae", "scheduler")  # parts of Stable Diffusion that are used
IN_CHANNELS = 4 + 6 + 1  # input channels of the U-Net: latent, ray, flag


@dataclass(frozen=True)
class DiffSplatSource(HubSource):
    """A publication of weights, and which of its files are needed."""

    wanted: tuple[str, ...]  # glob patterns of files
    into: str  # subfolder of the weights folder


SOURCES = (
    DiffSplatSource("chenguolin/DiffSplat", "3.8 GB", "MIT", (f"{UNET}/*/unet_ema/*", f"{GSVAE}/*/model.safetensors"),
    ""),
    DiffSplatSource(
        "stable-diffusion-v1-5/stable-diffusion-v1-5", "0.6 GB", "CreativeML OpenRAIL-M",
        ("tokenizer/*", "text_encoder/config.json", "text_encoder/model.fp16.safetensors", "vae/config.json",
         "vae/diffusion_pytorch_model.safetensors", "scheduler/*"), BASE,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Files:
    """Paths of the parts."""

    unet: Path  # folder with config and weights
    gsvae: Path  # file
    base: Path  # folder of Stable Diffusion


def find(given: Path | None = None) -> Files:
    """Find the parts in a folder, by default diffsplat/ of $NGFF_WEIGHTS or of the user's cache.

    Raises InputError if parts are missing.
    """
    searched = [Path(given)] if given is not None else [folder / "diffsplat" for folder in folders()]
    for folder in searched:
        files = _files(folder)
        if not _missing(files):
            return files
    code, base = SOURCES
    lack = ", ".join(str(path) for path in _missing(_files(searched[0])))
    raise InputError(
        f"diffsplat: the weights are not in {' or '.join(map(str, searched))} (no {lack}); download {UNET} and "
        f"{GSVAE} of "
        f"https://huggingface.co/{code.repository} ({code.size}, licence {code.licence}) into {searched[0]}, and "
        f"{', '.join(PARTS)} of https://huggingface.co/{base.repository} ({base.size}, licence {base.licence}) into "
        f"{searched[0] / BASE}, name such a folder with --weights, or add --download"
    )


def _files(folder: Path) -> Files:
    """Paths where the parts are expected."""
    return Files(_last(folder / UNET) / "unet_ema", _last(folder / GSVAE) / "model.safetensors", folder / BASE)


def _last(model: Path) -> Path:
    """Folder of the checkpoint with the most steps; folder names are numbers of steps."""
    numbers = [p for p in (model / "checkpoints").glob("*") if p.name.isdigit()]
    return max(numbers, key=lambda p: int(p.name)) if numbers else model / "checkpoints/NUMBER"


def _missing(files: Files) -> list[Path]:
    needed = [files.unet / "config.json", files.unet / "diffusion_pytorch_model.safetensors", files.gsvae]
    return [path for path in [*needed, *(files.base / part for part in PARTS)] if not path.exists()]


def load(files: Files, device: str = "cpu") -> DiffSplat:
    """Load the model in 32 bit, for inference; sizes come from the configurations next to the weights.

    Raises InputError for missing packages and for files that are damaged or of another model.
    """
    from stages.core.models.diffsplat.network import DiffSplat, share_attention

    parts = read_parts(files.base, PARTS, sampler, "diffsplat", "Stable Diffusion 1.5", SOURCES[1])
    text, vae = parts["text_encoder"], parts["vae"]
    gsvae = filled(gaussian_vae(dict(vae.config)), files.gsvae, "vae.", ("tiny_decoder.",))
    unet = filled(_unet(files.unet / "config.json"), files.unet / "diffusion_pytorch_model.safetensors")
    share_attention(unet)
    for part in (text, vae, unet, gsvae):
        part.requires_grad_(False).eval().to(device)
    return DiffSplat(parts["tokenizer"], text, vae, unet, gsvae, parts["scheduler"])


def sampler(config: dict):
    """Build SDE-DPM-Solver++ for v-prediction with Stable Diffusion's noise schedule.

    The public code also requests betas rescaled to zero terminal SNR, but changes the configuration only after it has
    been read, in training and in inference, so the rescaling never takes effect and is omitted here.
    """
    from diffusers import DPMSolverMultistepScheduler

    return DPMSolverMultistepScheduler.from_config(
        config, algorithm_type="sde-dpmsolver++", timestep_spacing="trailing", prediction_type="v_prediction"
    )


def gaussian_vae(config: dict) -> nn.Module:
    """Build Stable Diffusion's autoencoder with CHANNELS in and out, for maps of Gaussians, on the meta device."""
    from diffusers import AutoencoderKL

    with torch.device("meta"):
        return AutoencoderKL.from_config({**config, "in_channels": CHANNELS, "out_channels": CHANNELS})


def _unet(config: Path) -> nn.Module:
    """Build the U-Net of a published configuration, on the meta device. Raises InputError for other configurations.

    Its blocks, CrossAttnDownBlockMV2D and so on, are those of diffusers except for the attention.
    """
    from diffusers import UNet2DConditionModel

    try:
        stored = json.loads(config.read_text().replace("MV2D", "2D"))
        known = {k: stored[k] for k in signature(UNet2DConditionModel.__init__).parameters if k in stored}
        with torch.device("meta"):
            unet = UNet2DConditionModel(**known)
    except (ValueError, TypeError) as error:
        raise InputError(f"{config}: does not describe DiffSplat's U-Net ({error}); download it again") from error
    if unet.config.in_channels != IN_CHANNELS:
        raise InputError(f"{config}: describes a U-Net with {unet.config.in_channels} input channels; the one "
                         "that takes "
                         f"an image has {IN_CHANNELS}; use {UNET}")  # fmt: skip
    return unet


def filled(model: nn.Module, path: Path, prefix: str = "", but: tuple[str, ...] = ()) -> nn.Module:
    """Fill a model with the tensors of a file in 32 bit; removes `prefix`, skips names that start with `but`.

    Raises InputError if the tensors do not fit.
    """
    state = {k.removeprefix(prefix): v.float() for k, v in read_state(path).items() if not k.startswith(but)}
    if complaint := differences(model.state_dict(), state):
        raise InputError(f"{path}: the weights do not fit diffsplat: {complaint}")
    model.load_state_dict(state, assign=True)
    return model
