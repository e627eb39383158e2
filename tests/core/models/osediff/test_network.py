"""The single step of OSEDiff, compared with the published code's procedure with unmerged updates."""

import pytest
import torch

from stages.core.models.osediff.network import match_colours
from stages.core.models.osediff.weights import find, load
from tests.core.models.diffsplat.tiny_model import SCHEDULER
from tests.core.models.osediff.tiny_model import autoencoder, lora_file, unet

ADAPTERS = ("encoder", "decoder", "others")


def add_updates(network, state, rank):
    """Apply the updates beside their layers, as peft does: y + (alpha / rank) B(A(x)); alpha is 8 by default."""

    def hook(layer, inputs, output, down, up):
        if isinstance(layer, torch.nn.Conv2d):
            update = torch.nn.functional.conv2d(inputs[0], down, stride=layer.stride, padding=layer.padding)
            return output + 8 / rank * torch.nn.functional.conv2d(update, up)
        return output + 8 / rank * (inputs[0] @ down.T) @ up.T

    for name, layer in network.named_modules():
        for adapter in ADAPTERS:
            if f"{name}.lora_A.default_{adapter}.weight" in state:
                a, b = (state[f"{name}.lora_{letter}.default_{adapter}.weight"] for letter in "AB")
                layer.register_forward_hook(lambda *x, a=a, b=b: hook(*x, a, b))
    return network


@torch.no_grad()
def public_procedure(model, image, prompt, seed, updated=True):
    """Encode, apply one step of DDPM from t = 999 to the end, decode; without colours, for sizes divisible by 8."""
    from diffusers import DDPMScheduler

    lora, vae, network = lora_file(), autoencoder().eval(), unet().eval()
    if updated:
        network.conv_in.weight.copy_(lora["state_dict_unet"]["conv_in.base_layer.weight"])
        network.conv_in.bias.copy_(lora["state_dict_unet"]["conv_in.base_layer.bias"])
        add_updates(network, lora["state_dict_unet"], lora["rank_unet"])
        add_updates(vae, lora["state_dict_vae"], lora["rank_vae"])
    scheduler = DDPMScheduler.from_config(SCHEDULER)
    scheduler.set_timesteps(timesteps=[999])
    tokens = model.tokenizer([prompt], padding="max_length", max_length=12, truncation=True, return_tensors="pt")
    text = model.text_encoder.cpu()(tokens.input_ids)[0]
    noise = torch.Generator().manual_seed(seed)
    latent = vae.encode(image.permute(2, 0, 1)[None] * 2 - 1).latent_dist.sample(noise) * vae.config.scaling_factor
    output = network(latent, torch.tensor([999]), encoder_hidden_states=text).sample
    clean = scheduler.step(output, torch.tensor([999]), latent).prev_sample
    return vae.decode(clean / vae.config.scaling_factor).sample.clamp(-1, 1)[0].permute(1, 2, 0) * 0.5 + 0.5


def adain(image, source):
    """Give each channel of an image the mean and standard deviation of the source, in 64 bit."""
    image, source = image.double().numpy(), source.double().numpy()
    deviation = [(x.var((0, 1), ddof=1) + 1e-5) ** 0.5 for x in (image, source)]
    out = (image - image.mean((0, 1))) / deviation[0] * deviation[1] + source.mean((0, 1))
    return torch.from_numpy(out).clamp(0, 1).float()


@pytest.fixture(scope="module")
def image():
    coarse = torch.rand(1, 3, 6, 8, generator=torch.Generator().manual_seed(3))
    return torch.nn.functional.interpolate(coarse, (48, 64), mode="bicubic")[0].clamp(0, 1).permute(1, 2, 0)


def test_output_equals_the_public_procedure(folder, image):
    model = load(find(folder))
    actual = model.restore(image, "a duck", seed=7)
    expected = public_procedure(model, image, "a duck", 7)
    torch.testing.assert_close(actual, adain(expected, image), rtol=0, atol=2e-4)
    plain = public_procedure(model, image, "a duck", 7, updated=False)
    assert (adain(plain, image) - actual).abs().mean() > 100 * 2e-4  # the updates have an effect


def test_signal_at_the_last_step_is_that_of_stable_diffusion(model):
    """In Rombach et al. 2022 the square roots of the betas are evenly spaced from 0.00085 to 0.012."""
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    assert model.signal == pytest.approx(float((1 - betas).prod()), rel=1e-4)


def test_sizes_that_are_no_multiples_of_8_are_padded_by_their_border(model, image):
    cut = image[:45, :57]
    padded = torch.cat([cut, cut[-1:].expand(3, -1, -1)])
    padded = torch.cat([padded, padded[:, -1:].expand(-1, 7, -1)], 1)
    seen = []
    hook = model.vae.encoder.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].cpu()))
    restored = model.restore(cut)
    hook.remove()
    assert restored.shape == cut.shape and restored.device.type == "cpu" and not restored.isnan().any()
    torch.testing.assert_close(seen[0][0], 2 * padded.permute(2, 0, 1) - 1)


def test_prompt_and_seed_change_the_output(model, image):
    first, again, other_prompt, other_seed = (model.restore(image, p, s) for p, s in
                                              (("a", 0), ("a", 0), ("b", 0), ("a", 1)))  # fmt: skip
    assert torch.equal(first, again)
    assert not torch.equal(first, other_prompt) and not torch.equal(first, other_seed)


def test_colours_keep_mean_and_standard_deviation():
    rng = torch.Generator().manual_seed(0)
    source = 0.5 + 0.08 * torch.randn(1, 3, 40, 30, generator=rng) + torch.tensor([0.1, 0, -0.1]).view(1, 3, 1, 1)
    image = 0.3 + 0.2 * torch.rand(1, 3, 40, 30, generator=rng)
    out = match_colours(image, source.clamp(0, 1))
    torch.testing.assert_close(out.mean((2, 3)), source.mean((2, 3)), rtol=0, atol=1e-4)
    torch.testing.assert_close(out.std((2, 3)), source.std((2, 3)), rtol=2e-3, atol=0)
    small, other = image[0, :, :3, :4], source[0, :, :3, :4].clamp(0, 1)
    expected = adain(small.permute(1, 2, 0), other.permute(1, 2, 0)).permute(2, 0, 1)
    torch.testing.assert_close(match_colours(small[None], other[None])[0], expected)
    # white stays white up to the regularisation by 1e-5
    assert match_colours(image, torch.ones_like(image)).amin() > 0.98


@torch.no_grad()
def test_gpu_restores_as_the_cpu(folder, image, device):
    if device == "cpu":
        pytest.skip("no NVIDIA GPU")
    cpu, gpu = (load(find(folder), name).restore(image, "a duck") for name in ("cpu", "cuda"))
    assert (cpu - gpu).abs().mean() < 0.05  # the network runs in bfloat16 on the GPU
