"""Weights of SAM 2.1: search, checks and download."""

import json
import logging
import sys
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file, save_file

from stages.core.errors import InputError, MissingPackage
from stages.core.models.sam2.weights import download, find, load
from stages.core.scene.files import sha256
from tests.core.models.sam2.tiny_model import random_model, save_tiny_model

pytestmark = pytest.mark.usefixtures("empty_weight_folders")


def test_weight_search_order(tmp_path):
    with pytest.raises(InputError, match=(
        r"config.json with model.safetensors in .*weights/sam2 or .*ngff/sam2; download "
        r".*facebook/sam2.1-hiera-large \(0.9 GB.*Apache.*--download"
    )):  # fmt: skip
        find()
    save_tiny_model(tmp_path / "cache/ngff/sam2")
    assert find() == tmp_path / "cache/ngff/sam2/model.safetensors"
    save_tiny_model(tmp_path / "weights/sam2")
    assert find() == tmp_path / "weights/sam2/model.safetensors"
    assert find(tmp_path / "cache/ngff/sam2") == find(tmp_path / "cache/ngff/sam2/model.safetensors")
    (tmp_path / "weights/sam2/config.json").unlink()
    with pytest.raises(InputError, match="config.json: no such file"):
        find(tmp_path / "weights/sam2/model.safetensors")
    with pytest.raises(InputError, match="no such file; the weights of SAM 2.1"):
        find(tmp_path / "absent.safetensors")


def test_saved_weights_load_in_float32(tmp_path):
    save_tiny_model(tmp_path / "a", seed=3)
    state = random_model(3).state_dict()
    model = load(find(tmp_path / "a"))
    assert not any(p.requires_grad for p in model.parameters()) and not model.training
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())
    file = tmp_path / "a/model.safetensors"
    save_file({k: v.bfloat16() for k, v in load_file(file).items()}, file)
    assert all(p.dtype == torch.float32 for p in load(file).parameters())


def modified_weights(folder, change):
    file = save_tiny_model(folder) / "model.safetensors"
    state = load_file(file)
    change(state)
    save_file(state, file)
    return file


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("no_memory_embedding"), "1 tensors missing: no_memory_embedding"),
        (lambda s: s.update(no_memory_embedding=torch.zeros(1, 1, 7)), "other shapes"),
        (lambda s: s.clear() or s.update(x=torch.zeros(1)), "tensors missing"),
    ],
)
def test_mismatched_weights_are_refused(tmp_path, change, message):
    with pytest.raises(InputError, match=f"model.safetensors: does not fit the config.json.*{message}"):
        load(modified_weights(tmp_path / "a", change))


def test_damaged_files_are_refused(tmp_path):
    file = save_tiny_model(tmp_path / "a") / "model.safetensors"
    whole, config = file.read_bytes(), file.with_name("config.json").read_text()
    file.write_bytes(whole[:1000])
    with pytest.raises(InputError, match="not a complete safetensors file"):
        load(file)
    file.write_bytes(whole)
    for broken in ("{", json.dumps({**json.loads(config), "model_type": "sam2"}), "[]", '{"model_type": "bert"}'):
        file.with_name("config.json").write_text(broken)
        with pytest.raises(InputError, match="config.json: does not describe SAM 2.1"):
            load(file)


def test_missing_transformers_names_the_extra(tmp_path, monkeypatch):
    file = find(save_tiny_model(tmp_path / "a"))
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(MissingPackage, match=r"pip install -U 'ngff\[sam2\]'"):
        load(file)


def test_download_fetches_both_files_and_logs_them_first(tmp_path, monkeypatch, caplog):
    remote = save_tiny_model(tmp_path / "remote")
    weights = SimpleNamespace(rfilename="model.safetensors", size=10**6,
                              lfs=SimpleNamespace(sha256=sha256(remote / "model.safetensors")))  # fmt: skip
    others = [SimpleNamespace(rfilename=name, size=9, lfs=None) for name in ("README.md", "config.json")]
    info = SimpleNamespace(siblings=[weights, *others], sha="0123456789abcdef", card_data=None)
    logs = []

    def hub_download(repository, filename, revision, local_dir):
        logs.append(caplog.text)
        local_dir.mkdir(parents=True, exist_ok=True)
        (local_dir / filename).write_bytes((remote / filename).read_bytes())
        return str(local_dir / filename)

    api = SimpleNamespace(model_info=lambda repository, files_metadata: info)
    monkeypatch.setitem(sys.modules, "huggingface_hub",
                        SimpleNamespace(HfApi=lambda: api, hf_hub_download=hub_download))  # fmt: skip
    with caplog.at_level(logging.INFO):
        path = download()
    assert path == find() == tmp_path / "weights/sam2/model.safetensors"
    assert weights.lfs.sha256 in logs[0] and "Apache-2.0" in logs[0]
    info.siblings = others
    with pytest.raises(InputError, match="it holds no model.safetensors.*put config.json and model.safetensors in"):
        download()
