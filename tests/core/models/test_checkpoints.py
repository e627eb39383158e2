"""Weights on disk: round trips, and one clear sentence for what is wrong."""

import json
import math

import pytest
import torch

from stages.core.errors import InputError
from stages.core.models.checkpoints import MODELS, build, find, halve, load, save
from tests.core.models.worlds import SMALL, crowd


@pytest.mark.parametrize("name", SMALL)
def test_round_trip(tmp_path, name):
    torch.manual_seed(1)
    model = build(name, **SMALL[name]).eval()
    file = tmp_path / f"{name}.safetensors"
    save(file, name, model, {"score": 0.5, "seed": 3})
    again, card = load(file)
    assert card["score"] == 0.5 and card["model"] == name and type(again) is type(model)
    initial = crowd().to(torch.float32)
    with torch.no_grad():
        assert torch.equal(again.rollout(initial, 4), model.rollout(initial, 4))
    assert not list(tmp_path.glob(".part*"))


def test_every_model_is_tested():
    assert SMALL.keys() == MODELS.keys()


def test_half_precision_is_half_the_file_and_nearly_the_model(tmp_path):
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


def test_numbers_too_large_for_16_bits_are_kept_whole(tmp_path):
    model = build("gcn", hidden=8, layers=1)
    with torch.no_grad():
        next(model.parameters()).view(-1)[0] = 1e6
    save(tmp_path / "a.safetensors", "gcn", model, half=True)
    assert float(next(load(tmp_path / "a.safetensors")[0].parameters()).view(-1)[0]) == 1e6


def test_a_card_has_a_line_for_each_entry_and_row(tmp_path):
    runs = [{"minutes": 1 / 3, "loss": math.nan}, {"minutes": 1.0, "loss": 1.0}]
    save(tmp_path / "a.safetensors", "gcn", build("gcn", hidden=8), {"runs": runs, "curve": {"loss": [1.0]}})
    card = load(tmp_path / "a.safetensors")[1]
    assert card["runs"] == [{"minutes": 0.33333333, "loss": None}, runs[1]] and card["curve"] == {"loss": [1.0]}
    assert len((tmp_path / "a.json").read_text().splitlines()) == 2 + 4 + 4


@pytest.fixture
def saved(tmp_path):
    save(tmp_path / "w.safetensors", "gcn", build("gcn", hidden=8, layers=1))
    return tmp_path / "w.safetensors"


def edit(file, **changes):
    card = json.loads(file.with_suffix(".json").read_text())
    file.with_suffix(".json").write_text(json.dumps({**card, **changes}))


def test_one_flipped_bit(saved):
    data = bytearray(saved.read_bytes())
    data[-3] ^= 1
    saved.write_bytes(data)
    with pytest.raises(InputError, match="w.safetensors: does not have the sha256 that w.json states"):
        load(saved)


def test_damaged_file_with_a_fitting_sum(saved):
    import hashlib

    saved.write_bytes(b"not weights at all")
    edit(saved, sha256=hashlib.sha256(saved.read_bytes()).hexdigest())
    with pytest.raises(InputError, match="is no safetensors file"):
        load(saved)


@pytest.mark.parametrize("changes, message", [
    ({"config": {"hidden": 9, "layers": 1}}, "does not fit the model 'gcn'"),
    ({"config": {"width": 9}}, "does not fit the model 'gcn'"),
    ({"model": "pointformer", "config": {}}, "does not fit the model 'pointformer'"),
    ({"model": "gnc"}, "w.json: needs model \\(one of ngff-paper"),
    ({"config": 3}, "w.json: needs model"),
])  # fmt: skip
def test_a_card_of_something_else(saved, changes, message):
    edit(saved, **changes)
    with pytest.raises(InputError, match=message):
        load(saved)


@pytest.mark.parametrize("text", ["{", "[1]", '{"model": "gcn"}'])
def test_a_damaged_card(saved, text):
    saved.with_suffix(".json").write_text(text)
    with pytest.raises(InputError, match="w.json: is not the card of weights"):
        load(saved)


def test_missing_files(saved):
    with pytest.raises(InputError, match="none.safetensors: no such file"):
        load(saved.with_name("none.safetensors"))
    saved.with_suffix(".json").unlink()
    with pytest.raises(InputError, match="w.json: no such file; the card of w.safetensors is expected"):
        load(saved)


@pytest.mark.parametrize("content", [b"rubbish", {"predictor.x": torch.zeros(2)}, {"epoch": 3}])
def test_a_checkpoint_of_something_else(tmp_path, content):
    file = tmp_path / "c.pth"
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        torch.save(content, file)
    with pytest.raises(InputError, match="c.pth: (cannot be read|does not fit)"):
        load(file)


def test_weights_are_found(saved, monkeypatch, tmp_path):
    monkeypatch.delenv("NGFF_WEIGHTS", raising=False)
    assert find("w", saved) == saved and find("w", tmp_path) == saved
    with pytest.raises(InputError, match="w: no weights w.safetensors in .*; train them with `ngff-lab train w`"):
        find("w")
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    assert find("w") == saved
