"""Super-resolution of the input image of a generator, as in the paper's refinement."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import torch

from stages.core.backends import pick_device
from stages.core.geometry.cameras import resize
from stages.core.models.osediff.network import OSEDiff
from stages.core.models.osediff.weights import find, load
from stages.refine.object_crop import ObjectCrop
from stages.refine.options import RefineOptions

RESTORED_SIDE = 768  # side of the image that is restored, as in the paper [px]


def no_upscaler(options: RefineOptions) -> None:
    """The upscaler "none": there is no network."""


def osediff(options: RefineOptions) -> OSEDiff:
    """The upscaler "osediff". Raises InputError if its weights are missing or damaged."""
    return _model(options.weights, pick_device(options.device))


@lru_cache(maxsize=1)
def _model(weights: Path | None, device: str) -> OSEDiff:
    """The network, loaded once for all objects."""
    return load(find(weights), device)


def weights_file() -> Path:
    """Path of OSEDiff's low-rank updates (LoRA). Raises InputError if any of its files is missing."""
    return find().lora


def upscaled(crop: ObjectCrop, model: OSEDiff, side: int, prompt: str, seed: int) -> ObjectCrop:
    """Restore detail of the crop and reduce it to `side`; pixels outside the object stay white.

    The paper instead removes the background after the restoration, by another network.
    """
    image = model.restore(crop.image, prompt, seed)
    image = torch.where(crop.coverage[..., None] > 0, image, 1.0)
    scale = side / len(image)
    image, coverage = (
        torch.nn.functional.interpolate(x[None], (side, side), mode="area")[0]
        for x in (image.permute(2, 0, 1), crop.coverage[None])
    )
    return replace(crop, image=image.permute(1, 2, 0), K=resize(crop.K, scale, scale), coverage=coverage[0])
