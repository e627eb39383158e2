"""The sampler's parts against formulae written out, and the whole with a network that knows the answer."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import DPMSolverMultistepScheduler

from stages.core.models.diffsplat.maps import cameras, plucker
from stages.core.models.diffsplat.network import STEPS, VIEWS, share_attention, triangle
from stages.core.models.diffsplat.weights import find, load, sampler
from tests.core.models.diffsplat.tiny import SCHEDULER, SIDE, unet

LATENT = SIDE // 2


@torch.no_grad()
def test_attention_across_views_is_softmax_over_all_their_tokens():
    """Against Vaswani et al. 2017, equation 1, in 64 bit, with the layer's own matrices."""
    network, views = unet(), 3
    share_attention(network, views)
    layer = network.down_blocks[0].attentions[0].transformer_blocks[0].attn1.double()
    x = torch.randn(2 * views, 5, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    got = layer(x)
    tokens = x.reshape(2, views * 5, 8)
    q, k, v = ((tokens @ m.weight.T).reshape(2, -1, layer.heads, 8 // layer.heads)
               for m in (layer.to_q, layer.to_k, layer.to_v))  # fmt: skip
    scores = torch.einsum("bihd,bjhd->bhij", q, k) / (8 // layer.heads) ** 0.5
    mixed = torch.einsum("bhij,bjhd->bihd", scores.softmax(-1), v).reshape(2, -1, 8)
    expected = (mixed @ layer.to_out[0].weight.T + layer.to_out[0].bias).reshape(2 * views, 5, 8)
    torch.testing.assert_close(got, expected)


@torch.no_grad()
def test_views_know_of_each_other_and_objects_do_not():
    network, rng = unet(), torch.Generator().manual_seed(2)
    share_attention(network, 2)
    x, text = torch.randn(4, 11, 8, 8, generator=rng), torch.randn(4, 3, 16, generator=rng)
    before = network(x, 500, text).sample
    x[1] += 1  # the second view of the first object
    after = network(x, 500, text).sample
    assert (after[0] - before[0]).abs().max() > 1e-4
    assert torch.equal(after[2:], before[2:])
    swapped = network(x[[1, 0, 2, 3]], 500, text[[1, 0, 2, 3]]).sample  # nothing but the rays tells views apart
    torch.testing.assert_close(swapped[[1, 0, 2, 3]], after, rtol=0, atol=1e-5)


@torch.no_grad()
def test_one_view_alone_is_the_plain_network():
    shared, plain = unet(), unet()
    share_attention(shared, 1)
    x, text = torch.randn(2, 11, 8, 8), torch.randn(2, 3, 16)
    torch.testing.assert_close(shared(x, 7, text).sample, plain(x, 7, text).sample)


def test_guidance_rises_to_the_far_side_and_falls_again():
    """The public code joins linspace(low, high, 3) and linspace(high, low, 3)[1:-1]."""
    assert triangle(1.0, 2.0).tolist() == [1.0, 1.5, 2.0, 1.5]


def test_noise_levels_are_those_of_the_public_code():
    """It changes entries of a configuration that the scheduler has read by then, so that some never take effect."""
    theirs, ours = DPMSolverMultistepScheduler.from_config(SCHEDULER), sampler(SCHEDULER)
    theirs.config.algorithm_type = "sde-dpmsolver++"
    theirs.config.timestep_spacing = "trailing"
    theirs.config.rescale_betas_zero_snr = True
    theirs.config.prediction_type = "v_prediction"
    rng, x = torch.Generator().manual_seed(0), [torch.ones(1, 4, 2, 2)] * 2
    for scheduler in (theirs, ours):
        scheduler.set_timesteps(STEPS)
    assert ours.timesteps.tolist() == list(range(999, 0, -50)) == theirs.timesteps.tolist()
    for t in ours.timesteps:
        guess, noise = torch.randn(2, 1, 4, 2, 2, generator=rng)
        x = [s.step(guess, t, one, variance_noise=noise).prev_sample for s, one in zip((theirs, ours), x, strict=True)]
        assert torch.equal(*x)


class Oracle:
    """A network that knows what each view will be, and answers with the velocity that leads there.

    Velocity alpha eps - sigma x0 (Salimans and Ho 2022); alpha^2 is the running product of 1 - beta, and the roots of
    the betas are evenly spaced from 0.00085 to 0.012 (Rombach et al. 2022).
    """

    device, config = torch.device("cpu"), SimpleNamespace(sample_size=LATENT)

    def __init__(self, away: torch.Tensor, toward: torch.Tensor):
        self.goals, self.calls = torch.stack([away, toward]), []
        betas = np.linspace(0.00085**0.5, 0.012**0.5, 1000) ** 2
        self.alpha2 = np.cumprod(1 - betas)

    def __call__(self, views, t, text, return_dict):
        self.calls.append((views, text))
        alpha, sigma = self.alpha2[int(t)] ** 0.5, (1 - self.alpha2[int(t)]) ** 0.5
        x = views.unflatten(0, (2, VIEWS + 1))[:, 1:, :4].double()
        v = alpha * (x - alpha * self.goals) / sigma - sigma * self.goals
        given = torch.full_like(v[:, :1], torch.nan)  # what is said of the given picture must not matter
        return (torch.cat([given, v], 1).flatten(0, 1).float(),)


@torch.no_grad()
def test_a_network_that_knows_the_answer_leads_to_it(model):
    rng = torch.Generator().manual_seed(4)
    away, toward = torch.randn(2, VIEWS, 4, LATENT, LATENT, generator=rng)
    oracle, picture = Oracle(away, toward), torch.rand(SIDE, SIDE, 3, generator=rng)
    got = replace(model, unet=oracle).sample(picture, cameras(10.0), "a duck", seed=1)
    guidance = torch.tensor([1.0, 1.5, 2.0, 1.5])[:, None, None, None]
    latents = (away + guidance * (toward - away)) / model.gsvae.config.scaling_factor
    expected = model.gsvae.decode(latents).sample.clamp(-1, 1)
    torch.testing.assert_close(got, expected, rtol=0, atol=2e-3)
    assert len(oracle.calls) == STEPS
    check_what_was_told(model, picture, *oracle.calls[0])


def check_what_was_told(model, picture, views, text):
    """First without the picture and with the words to avoid, then with both; rays and flags in both."""
    views, text = views.unflatten(0, (2, VIEWS + 1)), text.unflatten(0, (2, VIEWS + 1))
    latent = model.vae.encode(2 * picture.permute(2, 0, 1)[None] - 1).latent_dist.mode()[0]
    assert not views[0, 0, :4].any()
    torch.testing.assert_close(views[1, 0, :4], latent * model.vae.config.scaling_factor)
    assert torch.equal(views[0, 1:], views[1, 1:])
    rays = plucker(cameras(10.0), SIDE)
    halved = (rays[..., ::2, ::2] + rays[..., 1::2, ::2] + rays[..., ::2, 1::2] + rays[..., 1::2, 1::2]) / 4
    torch.testing.assert_close(views[0, 1:, 4:10], halved)
    assert torch.equal(views[:, 0, 4:10], views[:, 1, 4:10])
    assert not views[:, 0, 10].any() and bool((views[:, 1:, 10] == 1).all())
    assert not torch.equal(text[0, 0], text[1, 0]) and torch.equal(text[:, 0], text[:, VIEWS])


def test_a_picture_becomes_gaussians_and_a_seed_gives_them_again(model):
    picture = torch.rand(SIDE, SIDE, 3, generator=torch.Generator().manual_seed(0))
    first, again, other = (model.generate(picture, 10.0, "a duck", seed) for seed in (0, 0, 1))
    assert torch.equal(first.means, again.means) and len(first) > 1000
    assert len(first) != len(other) or not torch.equal(first.means, other.means)
    assert model.side == SIDE and first.means.device.type == "cpu"
    norms = first.quats.norm(dim=1)
    torch.testing.assert_close(norms, torch.ones_like(norms))


@pytest.mark.gpu
@torch.no_grad()
def test_the_gpu_agrees_with_the_cpu(folder):
    if not torch.cuda.is_available():
        pytest.skip("no NVIDIA GPU")
    picture = torch.rand(SIDE, SIDE, 3, generator=torch.Generator().manual_seed(0))
    maps = [load(find(folder), device).sample(picture, cameras(10.0), "a duck").cpu() for device in ("cpu", "cuda")]
    assert (maps[0] - maps[1]).abs().mean() < 0.05  # the network runs in bfloat16 there
