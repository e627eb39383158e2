"""The published weights of OSEDiff: locate, check, and merge into Stable Diffusion 2.1 base.

A folder holds both parts:

    osediff.pkl                  low-rank updates (LoRA, Hu et al. 2022)
    stable-diffusion-2-1-base/   tokenizer/ text_encoder/ vae/ unet/ scheduler/

The first is written by `OSEDiff_gen.save_model` of the public code, a PyTorch checkpoint of lists and tensors. Layers
of the U-Net (attention, feed-forward, convolutions) and of the image encoder have updates, in adapters of the package
peft: NAME.lora_A.ADAPTER.weight and NAME.lora_B.ADAPTER.weight. The U-Net's first convolution was trained as well, and
is stored in full next to its update, as conv_in.base_layer. The file itself was not available for testing.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import nn

from stages.core.errors import InputError
from stages.core.models.hub import HubSource, folders
from stages.core.models.pi3.weights import differences
from stages.core.models.stable_diffusion import read_parts
from stages.core.models.torch_files import dense_tensors, read_checkpoint

if TYPE_CHECKING:
    from stages.core.models.osediff.network import OSEDiff

LORA, BASE = "osediff.pkl", "stable-diffusion-2-1-base"
PARTS = ("tokenizer", "text_encoder", "vae", "unet", "scheduler")  # parts of Stable Diffusion that are used
SOURCE = HubSource(f"stabilityai/{BASE}", "5.2 GB", "CreativeML Open RAIL++-M")
COPY = f"sd2-community/{BASE}"  # repository with a copy of the same files
ADAPTERS = {  # adapters of each network, with the entry of the file that lists their layers
    "unet": {"default_encoder": "unet_lora_encoder_modules", "default_decoder": "unet_lora_decoder_modules",
             "default_others": "unet_lora_others_modules"},
    "vae": {"default_encoder": "vae_lora_encoder_modules"},
}  # fmt: skip
ALPHA = 8  # peft's default, which the public code keeps; updates are scaled by ALPHA / rank
MAX_RANK = 1280  # width of the U-Net, an upper bound of the rank of updates
TIMESTEP = 999  # last (noisiest) time step of Stable Diffusion


@dataclass(frozen=True)
class OSEDiffFiles:
    """Paths of the parts."""

    lora: Path
    base: Path  # folder of Stable Diffusion


def find(given: Path | None = None) -> OSEDiffFiles:
    """Find the parts in osediff/ of the folder `given`, of $NGFF_WEIGHTS or of the user's cache.

    Raises InputError if parts are missing.
    """
    searched = [folder / "osediff" for folder in [*([Path(given)] if given is not None else []), *folders()]]
    missing = {folder: [name for name in (LORA, *(f"{BASE}/{part}" for part in PARTS)) if not (folder / name).exists()]
               for folder in searched}  # fmt: skip
    for folder, lack in missing.items():
        if not lack:
            return OSEDiffFiles(folder / LORA, folder / BASE)
    nearest = min(searched, key=lambda folder: len(missing[folder]))
    raise InputError(
        f"osediff: the weights are not in {' or '.join(map(str, searched))} ({nearest} lacks "
        f"{', '.join(missing[nearest])}); download preset/models/{LORA} of https://github.com/cswry/OSEDiff (licence "
        f"Apache-2.0) into {nearest}, and {', '.join(PARTS)} of https://huggingface.co/{SOURCE.repository} or of its "
        f"copy {COPY} ({SOURCE.size}, licence {SOURCE.licence}) into {nearest / BASE}"
    )


def load(files: OSEDiffFiles, device: str = "cpu") -> OSEDiff:
    """Load the model in 32 bit, for inference; sizes come from the configurations of Stable Diffusion.

    Raises InputError for missing packages and for files that are damaged or of another model.
    """
    from stages.core.models.osediff.network import OSEDiff

    parts = read_parts(files.base, PARTS, signal_level, "osediff", "Stable Diffusion 2.1 base", SOURCE)
    lora = read_lora(files.lora)
    for name in ("text_encoder", "vae", "unet"):
        parts[name].requires_grad_(False).eval()
        if name in ADAPTERS:
            merge_lora(parts[name], lora, name, files.lora)
        parts[name].to(device)
    return OSEDiff(parts["tokenizer"], parts["text_encoder"], parts["vae"], parts["unet"], parts["scheduler"])


def signal_level(config: dict) -> float:
    """Fraction of the variance that is signal at TIMESTEP; ValueError if the configuration does not predict noise."""
    from diffusers import DDPMScheduler

    scheduler = DDPMScheduler.from_config(config)
    if scheduler.config.prediction_type != "epsilon":
        raise ValueError(f"its U-Net predicts {scheduler.config.prediction_type} and not noise; 2.1 base is meant")
    return float(scheduler.alphas_cumprod[TIMESTEP])


def read_lora(path: Path) -> dict:
    """Read the entries of a file of updates. Raises InputError if it is damaged or lacks entries."""
    data = read_checkpoint(path)
    entries = data if isinstance(data, dict) else {}
    numbers = {f"rank_{network}": lambda x: isinstance(x, int) and 1 <= x <= MAX_RANK for network in ADAPTERS}
    tensors = {f"state_dict_{network}": lambda x: isinstance(x, dict) for network in ADAPTERS}
    names = {key: lambda x: isinstance(x, list) and all(isinstance(name, str) for name in x)
             for adapters in ADAPTERS.values() for key in adapters.values()}  # fmt: skip
    lack = [key for key, usable in {**numbers, **tensors, **names}.items() if not usable(entries.get(key))]
    if lack:
        raise InputError(
            f"{path}: is not {LORA} of OSEDiff (missing or unusable: {', '.join(lack)}); download it again"
        )
    return entries


def merge_lora(model: nn.Module, lora: dict, network: str, path: Path) -> None:
    """Add the updates of a network, "unet" or "vae", to its weights: W + ALPHA / rank B A.

    For a convolution, A has the kernel size of the layer and B a kernel of one pixel. Raises InputError for updates
    that do not fit.
    """
    rank, layers = lora[f"rank_{network}"], dict(model.named_modules())
    state = dense_tensors(path, lora[f"state_dict_{network}"])
    wanted, pairs = {}, []
    if network == "unet":
        wanted = {f"conv_in.base_layer.{k}": v for k, v in model.conv_in.state_dict().items()}
    for adapter, key in ADAPTERS[network].items():
        for name in dict.fromkeys(lora[key]):  # the public code lists layers of the encoder several times
            if not isinstance(layers.get(name), nn.Linear | nn.Conv2d):
                raise InputError(
                    f"{path}: does not fit osediff: {key} lists {name[:80]!r}, which is no layer of the {network}"
                )
            weight, a, b = (layers[name].weight, *(f"{name}.lora_{c}.{adapter}.weight" for c in "AB"))
            wanted[a] = torch.empty(rank, *weight.shape[1:], device="meta")
            wanted[b] = torch.empty(len(weight), rank, *[1] * (weight.dim() - 2), device="meta")
            pairs.append((weight, a, b))
    if complaint := differences(wanted, state):
        raise InputError(f"{path}: does not fit osediff: {complaint}")
    if network == "unet":
        model.conv_in.load_state_dict({k: state[f"conv_in.base_layer.{k}"] for k in model.conv_in.state_dict()})
    for weight, a, b in pairs:
        weight += ALPHA / rank * (state[b].float().flatten(1) @ state[a].float().flatten(1)).view_as(weight)
