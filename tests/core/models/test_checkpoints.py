"""Saving and loading checkpoints: round trips and error messages."""

import json
import math

import pytest
import torch

from stages.core.errors import InputError
from stages.core.models.checkpoints import MODELS, build, find, halve, load, save
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


def test_weight_search_order(saved, monkeypatch, tmp_path):
    monkeypatch.delenv("NGFF_WEIGHTS", raising=False)
    assert find("w", saved) == saved and find("w", tmp_path) == saved
    with pytest.raises(InputError, match="w: no weights w.safetensors in .*; train them with `ngff-lab train w`"):
        find("w")
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    assert find("w") == saved
