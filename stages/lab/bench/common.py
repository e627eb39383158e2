"""What every benchmark needs: the machine's name, its copy bandwidth, and time that waits for the GPU."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable

import torch
import warp as wp


def machine(device: str) -> str:
    """Name of what runs, with the versions that matter."""
    name = torch.cuda.get_device_name(device) if device != "cpu" else f"{_cpu()}, {len(os.sched_getaffinity(0))} cores"
    return f"{name}; torch {torch.__version__}, warp {wp.__version__}, python {platform.python_version()}"


def _cpu() -> str:
    try:
        with open("/proc/cpuinfo") as lines:
            return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def median_seconds(function: Callable[[], object], device: str, repeat: int = 5) -> float:
    """Median wall time of a call [s], the GPU's work included; call it once before."""
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
    """Bytes read plus bytes written a second by a large copy through PyTorch."""
    count = 2**29 if device != "cpu" else 2**25
    a, b = torch.ones(count, device=device), torch.zeros(count, device=device)
    b.copy_(a)
    return 2 * 4 * count / median_seconds(lambda: b.copy_(a), device)
