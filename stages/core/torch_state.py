"""PyTorch's global state, which the stages neither depend on nor change."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext


@contextmanager
def standard_torch() -> Iterator[None]:
    """Context, or decorator, in which PyTorch has its initial state; afterwards it has that of the caller again.

    Tensors are float32 on the CPU by default and gradients are on, as the stages assume. New networks draw initial
    weights, which are replaced, from the global generator of random numbers: its state is kept.
    """
    import torch  # takes a second to import, so only when a stage runs

    dtype, moved = torch.get_default_dtype(), torch.get_default_device().type != "cpu"
    kept = torch.random.fork_rng(devices=[])
    device = torch.device("cpu") if moved else nullcontext()  # as a context it slows every operation down
    with kept, device, torch.inference_mode(False), torch.enable_grad():
        torch.set_default_dtype(torch.float32)
        try:
            yield
        finally:
            torch.set_default_dtype(dtype)
