"""Published weights of OSEDiff: layout, names and sizes, and error messages."""

import json
import shutil
import sys

import pytest
import torch

from stages.core.errors import InputError, MissingPackage
from stages.core.models.osediff.weights import BASE, LORA, find, load, merge_lora, read_lora
from tests.core.models.osediff.tiny_model import lora_file, unet

pytestmark = pytest.mark.usefixtures("empty_weight_folders")


@pytest.fixture
def lora() -> dict:
    return lora_file()


def check_refused(lora, path, match):
    """Reading the file, or merging it into the U-Net, raises an error that names it."""
    torch.save(lora, path)
    with pytest.raises(InputError, match=match) as caught:
        merge_lora(unet().requires_grad_(False), read_lora(path), "unet", path)
    assert str(caught.value).startswith(f"{path}: ")


def test_weight_search_order(folder, tmp_path):
    with pytest.raises(InputError) as caught:
        find()
    for needed in ("github.com/cswry/OSEDiff", "Apache-2.0", "stabilityai/stable-diffusion-2-1-base", "RAIL++-M",
                   "5.2 GB", LORA, str(tmp_path / "weights/osediff")):  # fmt: skip
        assert needed in str(caught.value)
    shutil.copytree(folder / "osediff", tmp_path / "cache/ngff/osediff")
    assert find(tmp_path).base == tmp_path / "cache/ngff/osediff" / BASE
    assert find(folder).lora == folder / "osediff" / LORA
    shutil.rmtree(tmp_path / "cache/ngff/osediff" / BASE / "unet")
    with pytest.raises(InputError, match=f"cache/ngff/osediff lacks {BASE}/unet.; download"):
        find()


def test_merged_weights_are_in_32_bit_and_frozen(model):
    state, plain = model.unet.state_dict(), unet().state_dict()
    changed = {k for k in plain if not torch.equal(state[k].cpu(), plain[k])}
    assert changed == {f"{n}.weight" for n in sum((lora_file()[k] for k in lora_file() if "unet_lora" in k), [])} | {
        "conv_in.bias"
    }
    parameters = [p for part in (model.unet, model.vae, model.text_encoder) for p in part.parameters()]
    assert {p.dtype for p in parameters} == {torch.float32} and not any(p.requires_grad for p in parameters)


def test_wrong_ranks_are_refused(lora, tmp_path):
    check_refused({**lora, "rank_unet": 2}, tmp_path / "a", r"does not fit osediff: .*lora_A.default_encoder.weight "
                  r"\(4, .*\) instead of \(2, ")  # fmt: skip
    for rank in (0, -1, "4", 10**30):
        check_refused({**lora, "rank_unet": rank}, tmp_path / "a", "missing or unusable: rank_unet")


def test_missing_and_unknown_tensors_are_refused(lora, tmp_path):
    state, key = lora["state_dict_unet"], "conv_out.lora_B.default_decoder.weight"
    without = {k: v for k, v in state.items() if k != key}
    check_refused({**lora, "state_dict_unet": without}, tmp_path / "a", f"1 tensors missing: {key}")
    check_refused({**lora, "state_dict_unet": {**state, key: "text"}}, tmp_path / "a", f"1 tensors missing: {key}")
    check_refused({**lora, "state_dict_unet": {**state, 7: state[key]}}, tmp_path / "a", "1 tensors unknown: 7")
    without = {k: v for k, v in state.items() if k != "conv_in.base_layer.bias"}
    check_refused({**lora, "state_dict_unet": without}, tmp_path / "a", "missing: conv_in.base_layer.bias")
    check_refused({**lora, "state_dict_unet": {**state, key: torch.zeros(5, 4, 1, 1)}}, tmp_path / "a",
                  rf"{key} \(5, 4, 1, 1\) instead of \(4, 4, 1, 1\)")  # fmt: skip


def test_missing_entries_and_unknown_layers_are_refused(lora, tmp_path):
    for key in lora:
        check_refused({k: v for k, v in lora.items() if k != key}, tmp_path / "a", f"missing or unusable: {key}")
    check_refused({**lora, "unet_lora_others_modules": [3]}, tmp_path / "a", "unusable: unet_lora_others_modules")
    check_refused({**lora, "state_dict_vae": []}, tmp_path / "a", "unusable: state_dict_vae")
    check_refused([lora], tmp_path / "a", "is not osediff.pkl of OSEDiff")
    for name in ("conv_norm_out", "nowhere.to_q"):
        check_refused(
            {**lora, "unet_lora_others_modules": [name]}, tmp_path / "a", f"lists '{name}', which is no layer of"
        )


def test_what_is_no_checkpoint_is_refused(tmp_path):
    for content in (b"", b"no", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"):
        (tmp_path / "osediff.pkl").write_bytes(content)
        with pytest.raises(InputError, match="osediff.pkl: cannot be read as a PyTorch checkpoint"):
            read_lora(tmp_path / "osediff.pkl")
    torch.save({"rank_unet": print}, tmp_path / "osediff.pkl")  # a pickle that would run code
    with pytest.raises(InputError, match="cannot be read as a PyTorch checkpoint"):
        read_lora(tmp_path / "osediff.pkl")


def test_another_base_is_refused(folder, tmp_path):
    files = find(shutil.copytree(folder, tmp_path / "copy"))
    scheduler = files.base / "scheduler/scheduler_config.json"
    config = json.loads(scheduler.read_text())
    # the prediction type of Stable Diffusion 2.1 for 768 px
    scheduler.write_text(json.dumps({**config, "prediction_type": "v_prediction"}))
    with pytest.raises(InputError, match="as Stable Diffusion 2.1 base .*v_prediction and not noise"):
        load(files)
    scheduler.write_text(json.dumps(config))
    (files.base / "unet/diffusion_pytorch_model.safetensors").write_bytes(b"no")
    with pytest.raises(
        InputError, match=f"{BASE}: cannot be read as Stable Diffusion 2.1 base .*download its tokenizer"
    ):
        load(files)


def test_missing_package_is_reported(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(MissingPackage, match=r"osediff: .*ngff\[diffsplat\]"):
        load(find(folder))


def test_size_that_is_stated_is_that_of_the_published_base():
    """Computed from its configurations: 865,910,724 U-Net parameters; text encoder and autoencoder as published."""
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    with torch.device("meta"):
        network = UNet2DConditionModel(
            cross_attention_dim=1024, attention_head_dim=(5, 10, 20, 20), use_linear_projection=True
        )
        vae = AutoencoderKL(block_out_channels=(128, 256, 512, 512), down_block_types=("DownEncoderBlock2D",) * 4,
                            up_block_types=("UpDecoderBlock2D",) * 4, layers_per_block=2)  # fmt: skip
        text = CLIPTextModel(CLIPTextConfig(hidden_size=1024, intermediate_size=4096, num_hidden_layers=23,
                                            num_attention_heads=16))  # fmt: skip
    counts = [sum(p.numel() for p in part.parameters()) for part in (network, vae, text)]
    assert counts[0] == 865_910_724
    assert f"{4 * sum(counts) / 1e9:.1f}" == "5.2"
