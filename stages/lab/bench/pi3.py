"""How fast π³ is and what memory it takes, beside the same network with attention written out.

Random weights of the published sizes: time and memory do not depend on their values.
"""

from __future__ import annotations

import gc
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.models.pi3 import memory
from stages.core.models.pi3.config import Pi3Config
from stages.core.models.pi3.dinov2 import PATCH
from stages.core.models.pi3.layers import Attention
from stages.core.models.pi3.network import Pi3, halve
from stages.core.models.pi3.splat import Pi3Splat
from stages.core.scene.files import replacing
from stages.lab.bench import common as bench


@dataclass(frozen=True)
class Pi3BenchOptions:
    device: str = "auto"
    views: tuple[int, ...] = (1, 8, 20, 50)
    size: int = 448  # side of the square photos [px]
    repeat: int = 3  # timed forward passes of each
    splats: bool = False  # with the head of Gaussians

    def __post_init__(self):
        if self.size < PATCH or self.size % PATCH or self.repeat < 1 or min(self.views, default=0) < 1:
            raise InputError(f"--size must be a multiple of {PATCH}, --views and --repeat at least 1")


def naive_attention(q: Float[Tensor, "b h t d"], k: Float[Tensor, "b h t d"], v: Float[Tensor, "b h t d"]) -> Tensor:
    """Attention with its table of all pairs of tokens, softmax in 32 bit as autocast has it."""
    scores = (q @ k.mT) * q.shape[-1] ** -0.5
    return scores.softmax(-1).to(v.dtype) @ v


def set_attention(model: nn.Module, attend: Callable) -> None:
    for module in model.modules():
        if isinstance(module, Attention):
            module.attend = attend


@torch.no_grad()
def measure(model: nn.Module, views: int, size: int, at_once: int, device: str, repeat: int) -> tuple[float, float]:
    """Median seconds of a forward pass, and the most memory allocated in it, weights included [bytes; nan on a CPU].

    Raises torch.OutOfMemoryError where memory is too small; what was allocated is free again then.
    """
    images = torch.rand(views, 3, size, size, device=device)
    half, gpu = device != "cpu", device != "cpu"
    try:
        if gpu:
            torch.cuda.reset_peak_memory_stats()
        with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=half):
            model(images, at_once)
            seconds = bench.median_seconds(lambda: model(images, at_once), device, repeat)
        return seconds, torch.cuda.max_memory_allocated() if gpu else float("nan")
    finally:
        gc.collect()
        if gpu:
            torch.cuda.empty_cache()


def run(
    options: Pi3BenchOptions, config: Pi3Config = Pi3Config(), out: Path | None = None  # noqa: B008 -- frozen
) -> Iterator[str]:
    """A line for each number of views: seconds, memory and its estimate, then the same with attention written out."""
    device = pick_device(options.device)
    half = device != "cpu"
    with torch.device(device):
        model = (Pi3Splat if options.splats else Pi3)(config).eval().requires_grad_(False)
    if half:
        halve(model)
    weights = memory.weights(model)
    yield bench.machine(device)
    yield f"{type(model).__name__}, {options.size}x{options.size}, {'bf16' if half else 'fp32'}, weights {_gb(weights)}"
    rows = []
    for views in options.views:
        size = options.size, options.size
        at_once = memory.plan(config, views, size, options.splats, half, memory.free(device))
        said = weights + memory.activations(config, views, *size, at_once, options.splats, half)
        rows.append({"views": views, "estimated_bytes": _finite(said)})
        set_attention(model, nn.functional.scaled_dot_product_attention)
        try:
            seconds, most = measure(model, views, options.size, at_once, device, options.repeat)
        except torch.OutOfMemoryError:
            yield f"views {views:>3}  out of memory (estimate {_gb(said)})"
            continue
        rows[-1] |= {"seconds": seconds, "bytes": _finite(most)}
        yield f"views {views:>3}  {seconds:8.3f} s  {_gb(most)} (estimate {_gb(said)})  {views / seconds:6.1f} photos/s"
        set_attention(model, naive_attention)
        try:
            if not half and _table(config, views, options.size) > 0.5 * (memory.free(device) or 0):
                raise torch.OutOfMemoryError  # a CPU would swap, not fail
            slow, more = measure(model, views, options.size, at_once, device, options.repeat)
        except torch.OutOfMemoryError:
            yield "           attention written out: out of memory"
            continue
        rows[-1] |= {"naive_seconds": slow, "naive_bytes": _finite(more)}
        yield f"           attention written out: {slow:8.3f} s  {_gb(more)}, {slow / seconds:.1f} times our time"
    if out is not None:
        facts = {"command": "ngff-lab bench pi3", "machine": bench.machine(device), "weight_bytes": weights}
        with replacing(out) as part:
            part.write_text(json.dumps({**facts, "rows": rows}, indent=1) + "\n")


def _table(config: Pi3Config, views: int, size: int) -> int:
    """Bytes of the scores of all pairs of tokens, twice, in 32 bit."""
    tokens = views * ((size // PATCH) ** 2 + 5)
    return 2 * 4 * (config.width // config.head) * tokens**2


def _finite(count: float) -> float | None:
    """For JSON, which has no nan."""
    return count if math.isfinite(count) else None


def _gb(count: float) -> str:
    return f"{count / 1e9:6.2f} GB" if math.isfinite(count) else "     - GB"
