"""Saving and loading of checkpoints: round trips and error messages."""

import json
import math
import struct
import zipfile

import pytest
import torch

from stages.core.errors import InputError
from stages.core.models.checkpoints import MODELS, build, find, halve, load, save
from stages.core.scene.files import sha256
from tests.core.models.dynamics_fixtures import SMALL_CONFIGS, overlapping_objects


@pytest.mark.parametrize("name", SMALL_CONFIGS)
def test_save_load_round_trip(tmp_path, name):
    torch.manual_seed(1)
    model = build(name, **SMALL_CONFIGS[name]).eval()
    file = tmp_path / f"{name}.safetensors"
    save(file, name, model, {"score": 0.5, "seed": 3})
    loaded, card = load(file)
    assert card["score"] == 0.5 and card["model"] == name and type(loaded) is type(model)
    initial = overlapping_objects().to(torch.float32)
    with torch.no_grad():
        assert torch.equal(loaded.rollout(initial, 4), model.rollout(initial, 4))
    assert not list(tmp_path.glob(".part*"))


def test_every_model_is_tested():
    assert SMALL_CONFIGS.keys() == MODELS.keys()


def test_half_precision_halves_the_file_and_keeps_parameters_within_1e_3(tmp_path):
    model = build("gcn").eval()
    for name in "ab":
        save(tmp_path / f"{name}.safetensors", "gcn", model, {"minutes": 2.0})
    halve(tmp_path / "b.safetensors")
    assert load(tmp_path / "b.safetensors")[1]["minutes"] == 2.0
    sizes = [(tmp_path / f"{n}.safetensors").stat().st_size for n in "ab"]
    assert sizes[1] < 0.55 * sizes[0]
    for (_, p), (_, q) in zip(
        model.named_parameters(), load(tmp_path / "b.safetensors")[0].named_parameters(), strict=True
    ):
        assert q.dtype == torch.float32
        torch.testing.assert_close(q, p, rtol=1e-3, atol=1e-6)


def test_tensors_out_of_half_precision_range_stay_in_float32(tmp_path):
    model = build("gcn", hidden=8, layers=1)
    with torch.no_grad():
        next(model.parameters()).view(-1)[0] = 1e6
    save(tmp_path / "a.safetensors", "gcn", model, half=True)
    assert float(next(load(tmp_path / "a.safetensors")[0].parameters()).view(-1)[0]) == 1e6


def test_card_is_written_with_one_line_per_entry_and_run(tmp_path):
    runs = [{"minutes": 1 / 3, "loss": math.nan}, {"minutes": 1.0, "loss": 1.0}]
    save(tmp_path / "a.safetensors", "gcn", build("gcn", hidden=8), {"runs": runs, "curve": {"loss": [1.0]}})
    card = load(tmp_path / "a.safetensors")[1]
    assert card["runs"] == [{"minutes": 0.33333333, "loss": None}, runs[1]] and card["curve"] == {"loss": [1.0]}
    assert len((tmp_path / "a.json").read_text().splitlines()) == 2 + 4 + 4


@pytest.fixture
def saved(tmp_path):
    save(tmp_path / "w.safetensors", "gcn", build("gcn", hidden=8, layers=1))
    return tmp_path / "w.safetensors"


def edit_card(file, **changes):
    card = json.loads(file.with_suffix(".json").read_text())
    file.with_suffix(".json").write_text(json.dumps({**card, **changes}))


def test_flipped_bit_fails_the_checksum(saved):
    data = bytearray(saved.read_bytes())
    data[-3] ^= 1
    saved.write_bytes(data)
    with pytest.raises(InputError, match="w.safetensors: does not have the sha256 that w.json states"):
        load(saved)


def test_damaged_file_with_matching_checksum_is_refused(saved):
    import hashlib

    saved.write_bytes(b"not weights at all")
    edit_card(saved, sha256=hashlib.sha256(saved.read_bytes()).hexdigest())
    with pytest.raises(InputError, match="is not a safetensors file"):
        load(saved)


@pytest.mark.parametrize("changes, message", [
    ({"config": {"hidden": 9, "layers": 1}}, "does not fit the model 'gcn'"),
    ({"config": {"width": 9}}, "does not fit the model 'gcn'"),
    ({"model": "pointformer", "config": {}}, "does not fit the model 'pointformer'"),
    ({"model": "gnc"}, "w.json: needs model \\(one of ngff-paper"),
    ({"config": 3}, "w.json: needs model"),
])  # fmt: skip
def test_card_of_another_model_is_refused(saved, changes, message):
    edit_card(saved, **changes)
    with pytest.raises(InputError, match=message):
        load(saved)


@pytest.mark.parametrize("text", ["{", "[1]", '{"model": "gcn"}'])
def test_damaged_card_is_refused(saved, text):
    saved.with_suffix(".json").write_text(text)
    with pytest.raises(InputError, match="w.json: is not the card of weights"):
        load(saved)


def test_missing_files_are_reported(saved):
    with pytest.raises(InputError, match="none.safetensors: no such file"):
        load(saved.with_name("none.safetensors"))
    saved.with_suffix(".json").unlink()
    with pytest.raises(InputError, match="w.json: no such file; the card of w.safetensors is expected"):
        load(saved)


@pytest.mark.parametrize("content", [b"not a checkpoint", {"predictor.x": torch.zeros(2)}, {"epoch": 3}])
def test_unrelated_checkpoint_is_refused(tmp_path, content):
    file = tmp_path / "c.pth"
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        torch.save(content, file)
    with pytest.raises(InputError, match="c.pth: (cannot be read|does not fit)"):
        load(file)


EMBEDDING = "predictor.state_embedding.0.weight"
BLOCKS = {f"predictor.pointnet.extraction_blocks.{i}.0.weight": torch.zeros(1) for i in range(5000)}
LOOP: dict = {}
LOOP["model"] = LOOP


@pytest.mark.parametrize(("content", "message"), [
    (LOOP, "does not fit the published NGFF model"), ({EMBEDDING: torch.tensor(1.0)}, "does not fit"),
    ({EMBEDDING: torch.zeros(1).expand(10**9)}, ".*0.weight is not a dense tensor"),
    ({EMBEDDING: torch.zeros(8, 3, device="meta")}, ".*0.weight is not a dense tensor"),
    ({EMBEDDING: torch.zeros(8, 3).to_sparse()}, ".*0.weight is not a dense tensor"),
    ({EMBEDDING: torch.zeros(10**5)}, "does not fit .*hidden is 100000, not"),
    ({EMBEDDING: torch.zeros(8, 3), **BLOCKS}, "does not fit .*layers is 5000, not"),
], ids=["loop", "number", "expanded", "meta", "sparse", "wide", "deep"])  # fmt: skip
def test_checkpoints_that_would_take_any_time_or_memory_are_refused(tmp_path, content, message):
    torch.save(content, tmp_path / "c.pth")
    with pytest.raises(InputError, match=f"c.pth: {message}"):
        load(tmp_path / "c.pth")


def test_checkpoints_with_code_and_compressed_ones_are_refused(tmp_path):
    torch.save({EMBEDDING: print}, tmp_path / "code.pth")
    torch.save({EMBEDDING: torch.zeros(1 << 16)}, tmp_path / "a.pth")
    with zipfile.ZipFile(tmp_path / "a.pth") as plain, \
            zipfile.ZipFile(tmp_path / "bomb.pth", "w", zipfile.ZIP_DEFLATED) as bomb:  # fmt: skip
        for name in plain.namelist():
            bomb.writestr(name, plain.read(name))
    for name in ("code.pth", "bomb.pth"):
        with pytest.raises(
            InputError, match=f"{name}: cannot be read .* damaged or contains other objects than tensors"
        ):
            load(tmp_path / name)


@pytest.mark.skipif(not hasattr(torch, "float4_e2m1fn_x2"), reason="a PyTorch without floats of 4 bits")
def test_floats_of_four_bits_are_refused(saved):
    data = saved.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    table = json.loads(data[8 : 8 + size])
    length = len(data) - 8 - size
    table["more"] = {"dtype": "F4", "shape": [16], "data_offsets": [length, length + 8]}
    header = json.dumps(table).encode()
    saved.write_bytes(struct.pack("<Q", len(header)) + header + data[8 + size :] + bytes(8))
    card = json.loads(saved.with_suffix(".json").read_text())
    saved.with_suffix(".json").write_text(json.dumps({**card, "sha256": sha256(saved)}))
    with pytest.raises(InputError, match="w.safetensors: more is not a dense tensor of numbers"):
        load(saved)


def test_weight_search_order(saved, monkeypatch, tmp_path):
    monkeypatch.delenv("NGFF_WEIGHTS", raising=False)
    assert find("w", saved) == saved and find("w", tmp_path) == saved
    with pytest.raises(InputError, match="w: no weights w.safetensors in .*; train them with `ngff-lab train w`"):
        find("w")
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    assert find("w") == saved
