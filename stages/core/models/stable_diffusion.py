"""Load the parts of a published Stable Diffusion in the layout of diffusers.

The parts are tokenizer, text encoder, networks and scheduler.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.errors import InputError, MissingPackage
from stages.core.models.hub import HubSource

if TYPE_CHECKING:
    from transformers import CLIPTextModel, CLIPTokenizer


def read_parts(
    folder: Path, names: tuple[str, ...], scheduler: Callable[[dict], Any], user: str, version: str, source: HubSource
) -> dict[str, Any]:
    """Read parts by the names of their subfolders: networks in 32 bit, and `scheduler` of its configuration.

    For error messages, `user` is the network that needs the parts, and `version` the version of Stable Diffusion.
    Raises MissingPackage without diffusers or transformers, and InputError for files that are damaged or lack tensors,
    and if `scheduler` raises ValueError.
    """
    try:
        import diffusers
        import transformers
    except ImportError as error:
        raise MissingPackage(
            f"{user}: needs the packages diffusers and transformers (`pip install 'ngff[diffsplat]'`)"
        ) from error
    transformers.utils.logging.disable_progress_bar()
    half = (folder / "text_encoder/model.fp16.safetensors").exists()
    read = {
        "text_encoder": lambda path: _network(transformers.CLIPTextModel, path, variant="fp16" if half else None,
                                              dtype=torch.float32),
        "vae": lambda path: _network(diffusers.AutoencoderKL, path, low_cpu_mem_usage=False),
        "unet": lambda path: _network(diffusers.UNet2DConditionModel, path),
        "tokenizer": lambda path: transformers.CLIPTokenizer.from_pretrained(path, local_files_only=True),
        "scheduler": lambda path: scheduler(json.loads((path / "scheduler_config.json").read_text())),
    }  # fmt: skip
    try:
        return {name: read[name](folder / name) for name in names}
    except (OSError, ValueError, RuntimeError, KeyError) as error:
        raise InputError(
            f"{folder}: cannot be read as {version} ({' '.join(str(error).split())[:160]}); download its "
            f"{', '.join(names)} from https://huggingface.co/{source.repository} again"
        ) from error


def _network(kind: type, folder: Path, **how) -> nn.Module:
    """Load a library's model from its folder; ValueError for missing tensors, which the library would randomise."""
    model, found = kind.from_pretrained(
        folder, local_files_only=True, use_safetensors=True, output_loading_info=True, **how
    )
    if lack := sorted(found["missing_keys"]):
        raise ValueError(f"{folder.name} lacks {len(lack)} tensors such as {lack[0]}")
    return model


def encode_prompts(tokenizer: CLIPTokenizer, encoder: CLIPTextModel, prompts: list[str]) -> Float[Tensor, "b n d"]:
    """Return the last hidden states of the text encoder for prompts truncated or padded to its length."""
    length = encoder.config.max_position_embeddings
    tokens = tokenizer(prompts, padding="max_length", max_length=length, truncation=True, return_tensors="pt")
    return encoder(tokens.input_ids.to(encoder.device))[0]
