"""One step of the Adam optimiser on a single tensor, as one fused pass on any device.

The CPU uses PyTorch's fused step. On CUDA that step launches only a few blocks for a single large tensor and takes ten
times as long as the kernel here.

Source: Kingma and Ba 2015, "Adam: a method for stochastic optimization", algorithm 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor
from torch.optim.adam import adam

from stages.core.kernels.interop import device_of, launch, view

wp.set_module_options({"enable_backward": False})

BETA1, BETA2 = 0.9, 0.999
EPSILON = 1e-15  # as in 3D Gaussian splatting: the gradient of a single splat is small


@wp.kernel
def _step(
    grads: wp.array[float], steps: wp.array[float], rate: wp.array[float], values: wp.array[float],
    first: wp.array[float], second: wp.array[float],
):  # fmt: skip
    i = wp.tid()
    g = grads[i]
    m = wp.static(BETA1) * first[i] + wp.static(1 - BETA1) * g
    v = wp.static(BETA2) * second[i] + wp.static(1 - BETA2) * g * g
    first[i] = m
    second[i] = v
    m /= 1.0 - wp.pow(wp.float32(wp.static(BETA1)), steps[0])
    v /= 1.0 - wp.pow(wp.float32(wp.static(BETA2)), steps[0])
    values[i] -= rate[0] * m / (wp.sqrt(v) + wp.static(EPSILON))


@dataclass
class Moments:
    """Adam's state for one tensor: running means of the gradient and of its square."""

    first: Tensor
    second: Tensor

    @classmethod
    def like(cls, value: Tensor) -> Moments:
        """Return the moments of a tensor before its first step: zeros."""
        zeros = torch.zeros_like(value.detach())
        return cls(zeros, zeros.clone())


@torch.no_grad()
def adam_step(value: Tensor, grad: Tensor, moments: Moments, rate: Tensor, steps: Tensor) -> None:
    """Update `value` and its moments in place by one step.

    `rate` (1,) is the learning rate, `steps` (1,) the number of this step, counted from 1. All tensors are on one
    device. On CUDA the call does not synchronise, and `steps` and `rate` may change between replays of a CUDA graph.
    """
    grad = grad.contiguous()
    if not value.is_cuda:
        adam([value], [grad], [moments.first], [moments.second], [], [steps - 1], fused=True, amsgrad=False,
             beta1=BETA1, beta2=BETA2, lr=float(rate), weight_decay=0.0, eps=EPSILON, maximize=False)  # fmt: skip
        return
    flat = [view(t.view(-1)) for t in (grad, steps, rate, value, moments.first, moments.second)]
    launch(_step, value.numel(), flat, device=device_of(value))
