"""Averages of weights, and the training runs in their cards."""

import pytest
import torch

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.models.checkpoints import build, load, save
from stages.lab.training.average import run
from stages.lab.training.history import runs_of, total_minutes
from tests.conftest import CliRunner


def trained(path, seed, of="ngff", runs=()):
    """Save random weights with a card of one run after `runs`."""
    torch.manual_seed(seed)
    model = build(of, hidden=8)
    save(path, of, model, {"runs": [*runs, {"minutes": 2.0, "processes": 3}], "curve": {"minutes": [2.0]}})
    return path


def digest(path):
    return load(path)[1]["sha256"]


def test_parameters_are_averaged_and_the_card_lists_all_runs(tmp_path):
    old = trained(tmp_path / "old.safetensors", 0)
    a, b = (trained(tmp_path / f"{n}.safetensors", i, runs=runs_of(load(old)[1])) for n, i in (("a", 1), ("b", 2)))
    args = ["average", str(a), str(b), str(old), "--ratios", "0.5,0.2,0.3", "-o", str(tmp_path / "mean.safetensors")]
    done = CliRunner().invoke(app, args)
    assert done.exit_code == 0 and "0.5 of" in done.stdout, done.stderr
    mean, card = load(tmp_path / "mean.safetensors")
    states = [load(file)[0].state_dict() for file in (a, b, old)]
    for name, value in mean.state_dict().items():
        x, y, z = (s[name] for s in states)
        torch.testing.assert_close(value, 0.5 * x + 0.2 * y + 0.3 * z)
    *trainings, last = card["runs"]
    assert [run["sha256"] for run in trainings] == [digest(old), digest(a), digest(b)]
    parts = zip((0.5, 0.2, 0.3), (a, b, old), strict=True)
    assert last["average"] == [{"ratio": r, "sha256": digest(file)} for r, file in parts] and "sha256" not in last
    assert card["curve"] == {"minutes": [2.0]}
    assert total_minutes(card) == 3 * 2.0 * 3  # the common start counts once


def test_an_average_of_averages_lists_the_runs_of_both(tmp_path):
    a, b, c = (trained(tmp_path / f"{n}.safetensors", i) for i, n in enumerate("abc"))
    run([a, b], "0.5,0.5", tmp_path / "ab.safetensors")
    run([tmp_path / "ab.safetensors", c], "0.8,0.2", tmp_path / "abc.safetensors")
    assert total_minutes(load(tmp_path / "abc.safetensors")[1]) == 3 * 2.0 * 3
    run([a, a], "0.8,0.2", tmp_path / "aa.safetensors")
    assert total_minutes(load(tmp_path / "aa.safetensors")[1]) == 3 * 2.0


def test_weights_without_known_runs_can_be_averaged(tmp_path):
    for name in "ab":
        save(tmp_path / f"{name}.safetensors", "gcn", build("gcn", hidden=8))
    a, b = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    run([a, b], "0.5,0.5", tmp_path / "mean.safetensors")
    card = load(tmp_path / "mean.safetensors")[1]
    assert card["runs"][:2] == [{"sha256": digest(a)}, {"sha256": digest(b)}] and total_minutes(card) is None


def test_half_precision_shrinks_the_file(tmp_path):
    a, b = trained(tmp_path / "a.safetensors", 1), trained(tmp_path / "b.safetensors", 2)
    for half in (False, True):
        run([a, b], "0.5,0.5", tmp_path / f"{half}.safetensors", half)
    whole, small = ((tmp_path / f"{half}.safetensors").stat().st_size for half in (False, True))
    assert small < 0.8 * whole


@pytest.mark.parametrize("shares", ["0.5", "0.5,0.6", "1.5,-0.5", "half,half", "nan,nan", "0.4,0.3,0.3"])
def test_ratios_must_add_up_to_one(shares, tmp_path):
    a, b = trained(tmp_path / "a.safetensors", 1), trained(tmp_path / "b.safetensors", 2)
    with pytest.raises(InputError, match="--ratios"):
        run([a, b], shares, tmp_path / "mean.safetensors")


def test_weights_of_different_models_are_rejected(tmp_path):
    a, b = trained(tmp_path / "a.safetensors", 1), trained(tmp_path / "b.safetensors", 2, of="gcn")
    with pytest.raises(InputError, match=r"b\.safetensors: contains gcn"):
        run([a, b], "0.5,0.5", tmp_path / "mean.safetensors")
