"""Published weights of π³: search, loading from both file formats, error messages and download."""

import logging
import math
import sys
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import save_file

from stages.core.errors import InputError, MissingPackage
from stages.core.models.pi3.download import download
from stages.core.models.pi3.network import Pi3
from stages.core.models.pi3.splat import Pi3Splat
from stages.core.models.pi3.weights import MAX_DEPTH, find, load
from stages.core.scene.files import sha256
from tests.core.models.pi3.test_network import TINY, random_weights, views
from tests.core.models.pi3.test_splat import TINY_SPLAT

pytestmark = pytest.mark.usefixtures("empty_weight_folders")


@torch.no_grad()
def test_safetensors_and_pickle_files_load_the_saved_network(tmp_path):
    model = random_weights(Pi3(TINY))
    save_file(model.state_dict(), tmp_path / "a.safetensors")
    torch.save({"epoch": 3, "state_dict": model.state_dict()}, tmp_path / "b.pth")
    expected = model(views()).points
    for name in ("a.safetensors", "b.pth"):
        loaded = load(tmp_path / name, "pi3")
        assert torch.equal(loaded(views()).points, expected)
        assert not any(p.requires_grad for p in loaded.parameters())


@torch.no_grad()
def test_half_precision_files_load_in_float32(tmp_path):
    model = random_weights(Pi3Splat(TINY_SPLAT))
    state = {k: v.half() if v.is_floating_point() else v for k, v in model.state_dict().items()}
    save_file(state, tmp_path / "a.safetensors")
    loaded = load(tmp_path / "a.safetensors", "pi3-splat")
    assert all(p.dtype == torch.float32 for p in loaded.parameters())
    torch.testing.assert_close(loaded(views())[0].poses, model(views())[0].poses, rtol=0.05, atol=0.05)


def test_error_lists_missing_unknown_and_mismatched_tensors(tmp_path):
    state = Pi3(TINY).state_dict()
    del state["point_head.proj.bias"], state["encoder.norm.bias"]
    state["extra.weight"] = torch.zeros(1)
    state["conf_head.proj.bias"] = torch.zeros(7)
    save_file(state, tmp_path / "a.safetensors")
    with pytest.raises(InputError) as caught:
        load(tmp_path / "a.safetensors", "pi3")
    message = str(caught.value)
    assert "2 tensors missing: encoder.norm.bias, point_head.proj.bias" in message
    assert "1 tensors unknown: extra.weight" in message
    assert "conf_head.proj.bias (7,) instead of (196,)" in message


@pytest.mark.parametrize(("name", "values", "message"), [
    ("register_token", torch.zeros(1, 1, 5, 32, dtype=torch.int64), "1 tensors that are no real numbers: regis"),
    ("register_token", torch.full((1, 1, 5, 32), math.nan), "register_token has values that are not finite"),
    ("decoder.0.attn.q_norm.weight", torch.zeros(()), "holds no weights of pi3 .*are those of another network"),
    ("encoder.pos_embed", torch.zeros(1, 0, 4), "holds no weights of pi3 .*are those of another network"),
    *((f"{part}.{MAX_DEPTH}.norm1.weight", None, "holds no weights of pi3 .*are those of another network")
      for part in ("encoder.blocks", "decoder", "point_decoder.blocks")),
])  # fmt: skip
def test_tensors_that_no_such_network_has(tmp_path, name, values, message):
    state = Pi3(TINY).state_dict()
    if values is None:  # deeper than any
        part, _, rest = name.partition(f".{MAX_DEPTH}")
        state |= {f"{part}.{i}{rest}": torch.zeros(1) for i in range(MAX_DEPTH + 1)}
    else:
        state[name] = values
    save_file(state, tmp_path / "a.safetensors")
    with pytest.raises(InputError, match=f"a.safetensors: .*{message}"):
        load(tmp_path / "a.safetensors", "pi3")


def test_other_networks_and_broken_files_are_refused(tmp_path):
    save_file({"conv.weight": torch.zeros(3)}, tmp_path / "other.safetensors")
    with pytest.raises(InputError, match="no weights of pi3.*yyfz233/Pi3"):
        load(tmp_path / "other.safetensors", "pi3")
    save_file(Pi3(TINY).state_dict(), tmp_path / "pi3.safetensors")
    with pytest.raises(InputError, match="no weights of pi3-splat"):
        load(tmp_path / "pi3.safetensors", "pi3-splat")
    for name in ("a.safetensors", "a.pth"):
        (tmp_path / name).write_bytes(b"not at all")
        with pytest.raises(InputError, match=f"{name}: .*download it again"):
            load(tmp_path / name, "pi3")


def test_pickle_with_code_is_refused(tmp_path):
    torch.save({"register_token": print}, tmp_path / "a.pth")
    with pytest.raises(InputError, match="cannot be read as a PyTorch checkpoint"):
        load(tmp_path / "a.pth", "pi3")


def test_weight_search_order(tmp_path):
    with pytest.raises(InputError, match=r"weights or .*cache/ngff; download .*yyfz233/Pi3 .*CC BY-NC.*--download"):
        find("pi3")
    folder = tmp_path / "cache/ngff/pi3"
    folder.mkdir(parents=True)
    (folder / "README.md").touch()
    (folder / "model.safetensors").touch()
    assert find("pi3") == folder / "model.safetensors"
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights/pi3.pth").touch()
    assert find("pi3") == tmp_path / "weights/pi3.pth"
    assert find("pi3", tmp_path / "cache/ngff") == folder / "model.safetensors"
    with pytest.raises(InputError, match="no such file; weights of pi3"):
        find("pi3", tmp_path / "missing.pth")


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """Replace huggingface_hub by a stub that serves one small file."""
    remote = tmp_path / "remote.safetensors"
    save_file(Pi3(TINY).state_dict(), remote)
    file = SimpleNamespace(rfilename="model.safetensors", size=remote.stat().st_size,
                           lfs=SimpleNamespace(sha256=sha256(remote)))  # fmt: skip
    card = SimpleNamespace(license="cc-by-nc-4.0")
    readme = SimpleNamespace(rfilename="README.md", size=10**9, lfs=None)
    info = SimpleNamespace(siblings=[readme, file], sha="0123456789abcdef", card_data=card)

    def fetch(repository, filename, revision, local_dir):
        assert (repository, filename, revision) == ("yyfz233/Pi3", "model.safetensors", info.sha)
        local_dir.mkdir(parents=True)
        (local_dir / filename).write_bytes(remote.read_bytes())
        return str(local_dir / filename)

    def model_info(repository, files_metadata):
        assert files_metadata
        return info

    module = SimpleNamespace(HfApi=lambda: SimpleNamespace(model_info=model_info), hf_hub_download=fetch, file=file)
    monkeypatch.setitem(sys.modules, "huggingface_hub", module)
    return module


def test_size_licence_and_checksum_are_logged_before_download(hub, caplog, monkeypatch, tmp_path):
    fetch, logs = hub.hf_hub_download, []
    hub.hf_hub_download = lambda *args, **kwargs: (logs.append(caplog.text), fetch(*args, **kwargs))[1]
    with caplog.at_level(logging.INFO):
        path = download("pi3")
    assert "GB, licence cc-by-nc-4.0, sha256 " + hub.file.lfs.sha256 in logs[0]
    assert path == find("pi3") == tmp_path / "weights/pi3/model.safetensors"
    assert isinstance(load(path, "pi3"), Pi3)


def test_damaged_download_is_removed(hub, tmp_path):
    hub.file.lfs.sha256 = "0" * 64
    with pytest.raises(InputError, match="is incomplete or altered"):
        download("pi3")
    assert not list((tmp_path / "weights/pi3").iterdir())


def test_missing_network_or_package_is_explained(hub, monkeypatch):
    def no_network(*_, **__):
        raise ConnectionError("no route to host")

    hub.hf_hub_download = no_network
    with pytest.raises(InputError, match="no route to host.*save it as .*pi3.safetensors"):
        download("pi3")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingPackage, match=r"pip install 'ngff\[hub\]'"):
        download("pi3")
