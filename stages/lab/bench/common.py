"""Helpers shared by the benchmarks: machine description, import of gsplat, timing of GPU work, result files."""

from __future__ import annotations

import json
import os
import platform
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType

import torch
import warp as wp

from stages.core.errors import InputError, MissingPackage
from stages.core.scene.files import replacing
from stages.core.scene.schema import reason


def machine(device: str) -> str:
    """Name of the device (or CPU and its core count) and versions of torch, warp and Python."""
    name = torch.cuda.get_device_name(device) if device != "cpu" else f"{_cpu()}, {len(os.sched_getaffinity(0))} cores"
    return f"{name}; torch {torch.__version__}, warp {wp.__version__}, python {platform.python_version()}"


def import_gsplat() -> ModuleType:
    """The package gsplat, which only benchmarks use. Raises MissingPackage if it is not installed."""
    try:
        import gsplat
    except ImportError as error:
        raise MissingPackage("the comparison needs gsplat: `pip install 'ngff[bench]'`") from error
    return gsplat


def _cpu() -> str:
    try:
        with open("/proc/cpuinfo") as lines:
            return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def median_seconds(function: Callable[[], object], device: str, repeat: int = 5) -> float:
    """Median wall time of a call including its GPU work [s]. The caller warms up."""
    times = []
    for _ in range(repeat):
        _wait(device)
        start = time.perf_counter()
        function()
        _wait(device)
        times.append(time.perf_counter() - start)
    return sorted(times)[len(times) // 2]


def _wait(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize(device)


def copy_bandwidth(device: str) -> float:
    """Memory bandwidth of a large copy in PyTorch: bytes read plus bytes written per second."""
    count = 2**29 if device != "cpu" else 2**25
    a, b = torch.ones(count, device=device), torch.zeros(count, device=device)
    b.copy_(a)
    return 2 * 4 * count / median_seconds(lambda: b.copy_(a), device)


def float32_rate(device: str) -> float:
    """Operations per second of a float32 matrix product, without TF32."""
    size = 8192 if device != "cpu" else 2048
    a, b = (torch.randn(size, size, device=device) for _ in range(2))
    allowed = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    try:
        a @ b
        return 2 * size**3 / median_seconds(lambda: a @ b, device)
    finally:
        torch.backends.cuda.matmul.allow_tf32 = allowed


def earlier_results(out: Path, key: str) -> dict:
    """The results by name that an earlier run stored in `out` under `key`; empty if the file does not exist.

    Raises InputError if the file has other content.
    """
    if not out.exists():
        return {}
    try:
        found = json.loads(out.read_text())[key]
        return dict(found.items())
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{out}: contains no results of this benchmark ({reason(error)}); name another file"
        ) from error


def write_json(out: Path, facts: Mapping) -> None:
    """Write results as JSON, with every list of plain values on one line."""
    text = re.sub(r"\[[^][{}]*\]", lambda found: json.dumps(json.loads(found[0])), json.dumps(facts, indent=1))
    with replacing(Path(out)) as part:
        part.write_text(text + "\n")


def write_results(out: Path | None, name: str, device: str, facts: Mapping) -> None:
    """Write the results of `ngff-lab bench NAME` with the machine on which they were measured, if `out` is given."""
    if out is not None:
        write_json(out, {"command": f"ngff-lab bench {name}", "machine": machine(device), **facts})
