"""The Adam step, compared with PyTorch's optimiser."""

import torch

from stages.core.kernels.adam import EPSILON, Moments, adam_step


def test_steps_equal_those_of_pytorch(device):
    rng = torch.Generator().manual_seed(0)
    start, grads = torch.randn(40, 3, generator=rng), torch.randn(20, 40, 3, generator=rng)
    exact = start.double().requires_grad_()
    optimiser = torch.optim.Adam([exact], lr=0.01, eps=EPSILON)
    value, rate, steps = start.to(device), torch.full((1,), 0.01, device=device), torch.zeros(1, device=device)
    moments = Moments.like(value)
    for grad in grads:
        steps += 1
        adam_step(value, grad.to(device), moments, rate, steps)
        exact.grad = grad.double()
        optimiser.step()
    torch.testing.assert_close(value.cpu().double(), exact.detach(), rtol=1e-5, atol=1e-6)
