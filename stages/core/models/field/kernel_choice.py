"""Conditions under which fused kernels replace PyTorch operations in the force field.

The kernels have no backward pass, so they run only in single precision and while autograd is off (`torch.no_grad` or
`torch.inference_mode`); otherwise the same formulas run as PyTorch operations. Results differ only by rounding
(tests/core/kernels, tests/core/models/test_fused_step.py). The mode is read from autograd rather than passed as an
argument, because training and rollouts call the same `Dynamics` methods. All such choices in the package
stages.core.models.field go through this module.
"""

from __future__ import annotations

import torch
from torch import Tensor

from stages.core.kernels.compilers import TRITON


def kernels_allowed(x: Tensor) -> bool:
    """Whether kernels without a backward pass may work on `x`, on a CPU or a GPU."""
    return x.dtype == torch.float32 and not torch.is_grad_enabled()


def triton_allowed(x: Tensor) -> bool:
    """Whether Triton kernels without a backward pass may work on `x`, which must also be on CUDA."""
    return TRITON and x.is_cuda and kernels_allowed(x)
