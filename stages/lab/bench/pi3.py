"""Benchmark of π³: time and memory, compared with the same network with unfused attention.

Weights are random, with the published sizes: time and memory do not depend on their values.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.backends import pick_device
from stages.core.models.pi3 import memory
from stages.core.models.pi3.config import Pi3Config
from stages.core.models.pi3.dinov2 import PATCH
from stages.core.models.pi3.layers import Attention
from stages.core.models.pi3.network import Pi3, halve
from stages.core.models.pi3.splat import Pi3Splat
from stages.lab.bench import common as bench
from stages.lab.bench.speed_options import Pi3BenchOptions


def naive_attention(q: Float[Tensor, "b h t d"], k: Float[Tensor, "b h t d"], v: Float[Tensor, "b h t d"]) -> Tensor:
    """Attention that stores the scores of all token pairs, with the softmax in 32 bits as under autocast."""
    scores = (q @ k.mT) * q.shape[-1] ** -0.5
    return scores.softmax(-1).to(v.dtype) @ v


def set_attention(model: nn.Module, attend: Callable) -> None:
    """Use one attention function in all layers of a model."""
    for module in model.modules():
        if isinstance(module, Attention):
            module.attend = attend


@torch.no_grad()
def measure(model: nn.Module, views: int, size: int, at_once: int, device: str, repeat: int) -> tuple[float, float]:
    """Median time of a forward pass [s] and its peak memory including weights [bytes; nan on a CPU].

    Raises torch.OutOfMemoryError after freeing what was allocated.
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
    out: Path | None,
    options: Pi3BenchOptions,
    config: Pi3Config = Pi3Config(),  # noqa: B008 -- frozen
) -> Iterator[str]:
    """Yield two lines per number of views: time, memory and its estimate, and the same with unfused attention."""
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
        estimate = weights + memory.activations(config, views, size, at_once, options.splats, half)
        rows.append({"views": views, "estimated_bytes": _finite(estimate)})
        set_attention(model, nn.functional.scaled_dot_product_attention)
        try:
            seconds, most = measure(model, views, options.size, at_once, device, options.repeat)
        except torch.OutOfMemoryError:
            yield f"views {views:>3}  out of memory (estimate {_gb(estimate)})"
            continue
        rows[-1] |= {"seconds": seconds, "bytes": _finite(most)}
        used = f"{_gb(most)} (estimate {_gb(estimate)})"
        yield f"views {views:>3}  {seconds:8.3f} s  {used}  {views / seconds:6.1f} photos/s"
        set_attention(model, naive_attention)
        try:
            if not half and _table(config, views, options.size) > 0.5 * (memory.free(device) or 0):
                raise torch.OutOfMemoryError  # a CPU would swap instead of failing
            slow, more = measure(model, views, options.size, at_once, device, options.repeat)
        except torch.OutOfMemoryError:
            yield "           unfused attention: out of memory"
            continue
        rows[-1] |= {"naive_seconds": slow, "naive_bytes": _finite(more)}
        yield f"           unfused attention: {slow:8.3f} s  {_gb(more)}, {slow / seconds:.1f} times our time"
    bench.write_results(out, "pi3", device, {"weight_bytes": weights, "rows": rows})


def _table(config: Pi3Config, views: int, size: int) -> int:
    """Bytes of the scores of all token pairs in 32 bits, twice."""
    tokens = views * ((size // PATCH) ** 2 + 5)
    return 2 * 4 * (config.width // config.head) * tokens**2


def _finite(count: float) -> float | None:
    """The number, or None for nan, which JSON cannot represent."""
    return count if math.isfinite(count) else None


def _gb(count: float) -> str:
    return f"{count / 1e9:6.2f} GB" if math.isfinite(count) else "     - GB"
