"""Estimate of the memory that a set of photos needs, before it is allocated."""

from __future__ import annotations

import os

import torch
from torch import nn

from stages.core.errors import InputError
from stages.core.models.pi3.config import Pi3Config
from stages.core.models.pi3.dinov2 import PATCH
from stages.core.models.pi3.network import CAMERA_REGISTERS
from stages.core.models.pi3.splat import CHANNELS

MEMORY_FRACTION = 0.9  # fraction of the free memory that may be used
AT_ONCE = (8, 4, 2, 1)  # candidate numbers of views processed together in the per-view parts


def weights(model: nn.Module) -> int:
    """Return the bytes of the parameters and buffers."""
    return sum(x.numel() * x.element_size() for x in model.state_dict().values())


def activations(
    config: Pi3Config, views: int, size: tuple[int, int], at_once: int, splats: bool, half: bool = False
) -> int:
    """Estimate the peak bytes of activations for images of `size` (height, width); linear in the number of tokens.

    Per token a block holds the residual stream, its norm, queries, keys, values and the temporaries of the rotary
    embedding (32 bit, even if `half` computes the rest in 16). Afterwards the results of all views are stored, twice
    while they are concatenated.
    """
    number, pixels = (2 if half else 4), size[0] * size[1]
    tokens = pixels // PATCH**2 + CAMERA_REGISTERS
    inside = views * tokens * (config.width * (44 + 4 * number) + 16 * config.head)
    results = views * (8 * tokens * config.width + 8 * pixels * (4 + CHANNELS * splats))
    one_part = 48 * tokens * config.width + 8 * number * pixels * config.splat_features * splats
    return max(inside, results + at_once * one_part)


def free(device: str) -> int | None:
    """Return the free bytes on a device; None if the system does not report them."""
    if device != "cpu":
        unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + unused
    try:
        with open("/proc/meminfo") as lines:
            return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def plan(config: Pi3Config, views: int, size: tuple[int, int], splats: bool, half: bool, room: int | None) -> int:
    """Return the largest number of views to process at once within `room` bytes (None: unlimited).

    Raises InputError, with the number of photos that would fit, if even one view at a time needs too much.
    """

    def fits(views: int, at_once: int) -> bool:
        return room is None or activations(config, views, size, at_once, splats, half) <= MEMORY_FRACTION * room

    for at_once in AT_ONCE:
        if fits(views, at_once):
            return at_once
    maximum = max((n for n in range(1, views) if fits(n, 1)), default=0)
    need = activations(config, views, size, 1, splats, half) / 1e9
    remedy = f"{maximum} photos would fit" if maximum else "no photo fits"
    raise InputError(
        f"{views} photos of {size[1]}x{size[0]} pixels need {need:.1f} GB besides the weights, but "
        f"{room / 1e9:.1f} GB are "
        f"free: {remedy}; give fewer photos, a smaller --resolution, or --device cpu"
    )
