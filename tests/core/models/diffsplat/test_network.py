"""DiffSplat's sampler: components compared with explicit formulas, and all of it with a network of known output."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from stages.core.models.diffsplat.maps import cameras, plucker
from stages.core.models.diffsplat.network import STEPS, VIEWS, share_attention, triangle
from stages.core.models.diffsplat.weights import find, load, sampler
from tests.core.models.diffsplat.tiny_model import SCHEDULER, SIDE, unet

LATENT = SIDE // 2


@torch.no_grad()
def test_shared_attention_is_softmax_over_the_tokens_of_all_views():
    """The reference is Vaswani et al. 2017, equation 1, in 64 bit, with the layer's own matrices."""
    network, views = unet(), 3
    share_attention(network, views)
    layer = network.down_blocks[0].attentions[0].transformer_blocks[0].attn1.double()
    x = torch.randn(2 * views, 5, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    actual = layer(x)
    tokens = x.reshape(2, views * 5, 8)
    q, k, v = ((tokens @ m.weight.T).reshape(2, -1, layer.heads, 8 // layer.heads)
               for m in (layer.to_q, layer.to_k, layer.to_v))  # fmt: skip
    scores = torch.einsum("bihd,bjhd->bhij", q, k) / (8 // layer.heads) ** 0.5
    mixed = torch.einsum("bhij,bjhd->bihd", scores.softmax(-1), v).reshape(2, -1, 8)
    expected = (mixed @ layer.to_out[0].weight.T + layer.to_out[0].bias).reshape(2 * views, 5, 8)
    torch.testing.assert_close(actual, expected)


@torch.no_grad()
def test_attention_is_shared_between_views_and_not_between_objects():
    network, rng = unet(), torch.Generator().manual_seed(2)
    share_attention(network, 2)
    x, text = torch.randn(4, 11, 8, 8, generator=rng), torch.randn(4, 3, 16, generator=rng)
    before = network(x, 500, text).sample
    x[1] += 1  # the second view of the first object
    after = network(x, 500, text).sample
    assert (after[0] - before[0]).abs().max() > 1e-4
    assert torch.equal(after[2:], before[2:])
    swapped = network(x[[1, 0, 2, 3]], 500, text[[1, 0, 2, 3]]).sample  # views are distinguished only by their rays
    torch.testing.assert_close(swapped[[1, 0, 2, 3]], after, rtol=0, atol=1e-5)


@torch.no_grad()
def test_shared_attention_of_one_view_equals_the_plain_network():
    shared, plain = unet(), unet()
    share_attention(shared, 1)
    x, text = torch.randn(2, 11, 8, 8), torch.randn(2, 3, 16)
    torch.testing.assert_close(shared(x, 7, text).sample, plain(x, 7, text).sample)


def test_guidance_is_triangular_over_the_views():
    """The public code joins linspace(low, high, 3) and linspace(high, low, 3)[1:-1]."""
    assert triangle(1.0, 2.0).tolist() == [1.0, 1.5, 2.0, 1.5]


def test_scheduler_equals_the_public_code():
    """The public code changes configuration entries after the scheduler has read them: some have no effect."""
    from diffusers import DPMSolverMultistepScheduler

    reference, actual = DPMSolverMultistepScheduler.from_config(SCHEDULER), sampler(SCHEDULER)
    reference.config.algorithm_type = "sde-dpmsolver++"
    reference.config.timestep_spacing = "trailing"
    reference.config.rescale_betas_zero_snr = True
    reference.config.prediction_type = "v_prediction"
    rng, x = torch.Generator().manual_seed(0), [torch.ones(1, 4, 2, 2)] * 2
    for scheduler in (reference, actual):
        scheduler.set_timesteps(STEPS)
    assert actual.timesteps.tolist() == list(range(999, 0, -50)) == reference.timesteps.tolist()
    for t in actual.timesteps:
        guess, noise = torch.randn(2, 1, 4, 2, 2, generator=rng)
        x = [
            s.step(guess, t, one, variance_noise=noise).prev_sample
            for s, one in zip((reference, actual), x, strict=True)
        ]
        assert torch.equal(*x)


class Oracle:
    """Network that predicts the velocity towards known target latents of each view.

    Velocity alpha eps - sigma x0 (Salimans and Ho 2022); alpha^2 is the running product of 1 - beta, and the roots of
    the betas are evenly spaced from 0.00085 to 0.012 (Rombach et al. 2022).
    """

    config = SimpleNamespace(sample_size=LATENT)

    def __init__(self, unconditional: torch.Tensor, conditional: torch.Tensor):
        self.targets, self.calls = torch.stack([unconditional, conditional]), []
        self.device = unconditional.device
        betas = np.linspace(0.00085**0.5, 0.012**0.5, 1000) ** 2
        self.alpha2 = np.cumprod(1 - betas)

    def __call__(self, views, t, text, return_dict):
        self.calls.append((views, text))
        alpha, sigma = self.alpha2[int(t)] ** 0.5, (1 - self.alpha2[int(t)]) ** 0.5
        x = views.unflatten(0, (2, VIEWS + 1))[:, 1:, :4].double()
        v = alpha * (x - alpha * self.targets) / sigma - sigma * self.targets
        unused = torch.full_like(v[:, :1], torch.nan)  # the output for the input view must not be used
        return (torch.cat([unused, v], 1).flatten(0, 1).float(),)


@torch.no_grad()
def test_sampling_with_an_oracle_reaches_its_target(model, device):
    rng = torch.Generator().manual_seed(4)
    unconditional, conditional = torch.randn(2, VIEWS, 4, LATENT, LATENT, generator=rng).to(device)
    oracle, image = Oracle(unconditional, conditional), torch.rand(SIDE, SIDE, 3, generator=rng)
    actual = replace(model, unet=oracle).sample(image, cameras(10.0), "a duck", seed=1)
    guidance = torch.tensor([1.0, 1.5, 2.0, 1.5], device=device)[:, None, None, None]
    latents = (unconditional + guidance * (conditional - unconditional)) / model.gsvae.config.scaling_factor
    expected = model.gsvae.decode(latents).sample.clamp(-1, 1)
    # a GPU rounds the inputs of convolutions to TF32
    torch.testing.assert_close(actual, expected, rtol=0, atol=2e-3 if device == "cpu" else 2e-2)
    assert len(oracle.calls) == STEPS
    check_network_inputs(model, image.to(device), *oracle.calls[0])


def check_network_inputs(model, image, views, text):
    """The batch holds unconditional inputs (no image, negative prompt), then conditional ones, with rays and flags."""
    views, text = views.unflatten(0, (2, VIEWS + 1)), text.unflatten(0, (2, VIEWS + 1))
    latent = model.vae.encode(2 * image.permute(2, 0, 1)[None] - 1).latent_dist.mode()[0]
    assert not views[0, 0, :4].any()
    torch.testing.assert_close(views[1, 0, :4], latent * model.vae.config.scaling_factor)
    assert torch.equal(views[0, 1:], views[1, 1:])
    rays = plucker(cameras(10.0), SIDE).to(views)
    halved = (rays[..., ::2, ::2] + rays[..., 1::2, ::2] + rays[..., ::2, 1::2] + rays[..., 1::2, 1::2]) / 4
    torch.testing.assert_close(views[0, 1:, 4:10], halved)
    assert torch.equal(views[:, 0, 4:10], views[:, 1, 4:10])
    assert not views[:, 0, 10].any() and bool((views[:, 1:, 10] == 1).all())
    assert not torch.equal(text[0, 0], text[1, 0]) and torch.equal(text[:, 0], text[:, VIEWS])


@pytest.mark.slow
def test_generation_is_deterministic_for_a_seed(model):
    image = torch.rand(SIDE, SIDE, 3, generator=torch.Generator().manual_seed(0))
    first, repeated, other = (model.generate(image, 10.0, "a duck", seed) for seed in (0, 0, 1))
    assert torch.equal(first.means, repeated.means) and len(first) > 1000
    assert len(first) != len(other) or not torch.equal(first.means, other.means)
    assert model.side == SIDE and first.means.device.type == "cpu"
    norms = first.quats.norm(dim=1)
    torch.testing.assert_close(norms, torch.ones_like(norms))


@torch.no_grad()
def test_gpu_equals_cpu(folder, device):
    if device == "cpu":
        pytest.skip("no NVIDIA GPU")
    image = torch.rand(SIDE, SIDE, 3, generator=torch.Generator().manual_seed(0))
    maps = [load(find(folder), device).sample(image, cameras(10.0), "a duck").cpu() for device in ("cpu", "cuda")]
    assert (maps[0] - maps[1]).abs().mean() < 0.05  # the network runs in bfloat16 on the GPU
