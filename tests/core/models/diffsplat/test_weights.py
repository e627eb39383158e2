"""Published weights of DiffSplat: layout, names and sizes, error messages, and download."""

import json
import logging
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file, save_file

from stages.core.errors import InputError, MissingPackage
from stages.core.models.diffsplat.download import download
from stages.core.models.diffsplat.weights import BASE, GSVAE, UNET, find, gaussian_vae, load
from stages.core.scene.files import sha256
from tests.core.models.diffsplat.tiny_model import autoencoder, unet

pytestmark = pytest.mark.usefixtures("empty_weight_folders")


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy")


def test_all_tensors_are_loaded(model):
    for loaded, expected in ((model.unet, unet()), (model.gsvae, autoencoder(12)), (model.vae, autoencoder(3))):
        state = loaded.state_dict()
        assert state.keys() == expected.state_dict().keys()
        assert all(torch.equal(state[k].cpu(), v) for k, v in expected.state_dict().items())
        assert not any(p.requires_grad for p in loaded.parameters())


def test_newest_checkpoint_is_used(copy):
    assert find(copy).unet.parent.name == "013020"
    shutil.copytree(copy / UNET / "checkpoints/013020", copy / UNET / "checkpoints/100000")
    (copy / UNET / "checkpoints/README").mkdir()
    assert find(copy).unet.parent.name == "100000"


def test_weight_search_order(folder, tmp_path):
    with pytest.raises(InputError) as caught:
        find()
    for needed in ("chenguolin/DiffSplat", "MIT", "stable-diffusion-v1-5", "OpenRAIL", "3.8 GB", "--download"):
        assert needed in str(caught.value)
    shutil.copytree(folder, tmp_path / "cache/ngff/diffsplat")
    assert find().base == tmp_path / "cache/ngff/diffsplat" / BASE
    shutil.copytree(folder, tmp_path / "weights/diffsplat")
    assert find().base == tmp_path / "weights/diffsplat" / BASE
    shutil.rmtree(tmp_path / "weights/diffsplat" / GSVAE)
    with pytest.raises(InputError, match="no .*gsvae_gobj265k_sd.*model.safetensors"):
        find(tmp_path / "weights/diffsplat")


def test_half_precision_files_load_in_float32(copy):
    file = find(copy).gsvae
    save_file({k: v.half() for k, v in load_file(file).items()}, file)
    assert {p.dtype for p in load(find(copy)).gsvae.parameters()} == {torch.float32}


def test_mismatched_weights_are_refused(copy):
    files = find(copy)
    state = load_file(files.gsvae)
    save_file({k: v for k, v in state.items() if "conv_out.bias" not in k}, files.gsvae)
    with pytest.raises(InputError, match="model.safetensors: .*2 tensors missing: encoder.conv_out.bias"):
        load(files)
    save_file(state, files.gsvae)
    text_encoder = files.base / "text_encoder/model.safetensors"
    text_state = load_file(text_encoder)
    save_file(
        {k: v for k, v in text_state.items() if "final_layer_norm" not in k}, text_encoder, metadata={"format": "pt"}
    )
    with pytest.raises(InputError, match="text_encoder lacks 2 tensors such as .*final_layer_norm.bias"):
        load(files)
    save_file(text_state, text_encoder, metadata={"format": "pt"})
    text_only = {**json.loads((files.unet / "config.json").read_text()), "in_channels": 10}
    (files.unet / "config.json").write_text(json.dumps(text_only))
    with pytest.raises(InputError, match="10 input channels; the one that takes an image has 11"):
        load(files)
    (files.base / "vae/diffusion_pytorch_model.safetensors").write_bytes(b"no")
    with pytest.raises(InputError, match="Stable Diffusion 1.5 .*download"):
        load(files)


def test_missing_package_is_named(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(MissingPackage, match=r"ngff\[diffsplat\]"):
        load(find(folder))


def test_published_parameter_counts():
    """The hub lists 3.44 GB for the U-Net; its autoencoder's first and last layer are those of the public code."""
    from diffusers import UNet2DConditionModel

    with torch.device("meta"):
        network = UNet2DConditionModel(in_channels=11, cross_attention_dim=768)
    count = sum(p.numel() for p in network.parameters())
    assert len(network.state_dict()) == 686 and count == 859_541_124
    assert f"{4 * count / 1e9:.2f}" == "3.44"
    published = {"block_out_channels": (128, 256, 512, 512), "down_block_types": ("DownEncoderBlock2D",) * 4,
                 "layers_per_block": 2, "up_block_types": ("UpDecoderBlock2D",) * 4, "latent_channels": 4}  # fmt: skip
    state = gaussian_vae(published).state_dict()
    assert state["encoder.conv_in.weight"].shape == (128, 12, 3, 3)
    assert state["decoder.conv_out.weight"].shape == (12, 128, 3, 3)
    assert sum(v.numel() for v in state.values()) == pytest.approx(84e6, rel=0.01)  # the public README: 84 M


@pytest.fixture
def hub(monkeypatch, folder):
    """Replace huggingface_hub by a stub that serves the tiny model as two repositories."""
    corrupted = []

    def files(root):
        return [SimpleNamespace(rfilename=str(p.relative_to(root)), size=p.stat().st_size,
                                lfs=SimpleNamespace(sha256="0" * 64 if corrupted else sha256(p))
                                if p.suffix == ".safetensors" else None)
                for p in sorted(root.rglob("*")) if p.is_file()]  # fmt: skip

    def model_info(repository, files_metadata):
        assert files_metadata
        base = repository == "stable-diffusion-v1-5/stable-diffusion-v1-5"
        siblings = files(folder / BASE) if base else [f for f in files(folder) if not f.rfilename.startswith(BASE)]
        for file in siblings:  # the hub has both precisions
            if file.rfilename == "text_encoder/model.safetensors":
                file.rfilename = "text_encoder/model.fp16.safetensors"
        card = SimpleNamespace(license="creativeml-openrail-m") if base else None
        siblings.append(SimpleNamespace(rfilename="big.ckpt", size=10**10, lfs=None))
        return SimpleNamespace(siblings=siblings, sha="0123456789abcdef", card_data=card)

    def fetch(repository, filename, revision, local_dir):
        source = folder / BASE if repository.startswith("stable") else folder
        out = local_dir / filename
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes((source / filename.replace(".fp16", "")).read_bytes())
        return str(out)

    module = SimpleNamespace(
        HfApi=lambda: SimpleNamespace(model_info=model_info), hf_hub_download=fetch, corrupted=corrupted
    )
    monkeypatch.setitem(sys.modules, "huggingface_hub", module)
    return module


def test_download_logs_licences_and_fetches_only_the_needed_files(hub, folder, tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        files = download()
    assert files.base == tmp_path / "weights/diffsplat" / BASE
    for needed in ("licence MIT", "licence creativeml-openrail-m", sha256(find(folder).gsvae), "3.8 GB of"):
        assert needed in caplog.text
    assert not list((tmp_path / "weights").rglob("big.ckpt"))
    assert [sha256(p) for p in (files.gsvae, files.unet / "config.json")] == [
        sha256(p) for p in (find(folder).gsvae, find(folder).unet / "config.json")
    ]
    assert find() == files


def test_damaged_download_is_removed(hub):
    hub.corrupted.append(True)
    with pytest.raises(InputError, match="is incomplete or altered") as caught:
        download()
    assert not Path(str(caught.value).split(": did not")[0]).exists()


def test_missing_network_is_explained(hub):
    def fails(*_, **__):
        raise ConnectionError("no route\n to host")

    hub.HfApi = lambda: SimpleNamespace(model_info=fails)
    with pytest.raises(
        InputError, match="chenguolin/DiffSplat could not be downloaded .no route to host.; .*--weights"
    ):
        download()
