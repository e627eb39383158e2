"""The chain's benchmark, with small functions instead of the stages."""

import json
import threading

import pytest
import torch

from stages.core.errors import InputError
from stages.core.scene.scene_ply import write_scene
from stages.lab.bench import chain
from stages.lab.bench.speed_options import ChainBenchOptions
from tests.conftest import two_balls_scene


@pytest.mark.usefixtures("device")
def test_repeated_files_are_compared_and_times_written(tmp_path, monkeypatch):
    def calls(photos, folder, options):
        return {
            "reconstruct": lambda: write_scene(folder / "scene.ply", two_balls_scene()),
            "segment": lambda: write_scene(folder / "labelled.ply", two_balls_scene()),
            "render": lambda: (folder / "film.mp4").write_text(folder.name),  # the file differs between runs
        }

    monkeypatch.setattr(chain, "stage_calls", calls)
    monkeypatch.setattr(chain, "_command_seconds", lambda line: 1.5)
    lines = list(chain.run(tmp_path, tmp_path / "chain.json", ChainBenchOptions()))
    assert "files that differ between runs: film.mp4" in lines
    facts = json.loads((tmp_path / "chain.json").read_text())
    assert facts["objects"] == [2, 2] and len(facts["runs"]) == 2 and facts["commands"]["refine"] == 1.5
    assert facts["sha256"][0]["scene.ply"] == facts["sha256"][1]["scene.ply"]


def test_utilisation_is_that_of_the_current_gpu(monkeypatch):
    """The thread that reads the utilisation has its own current GPU, which is GPU 0."""
    caller, asked, twice = threading.get_ident(), [], threading.Event()

    def utilization(gpu: int) -> int:
        asked.append(gpu)
        if len(asked) > 1:
            twice.set()
        return 50

    monkeypatch.setattr(torch.cuda, "current_device", lambda: int(threading.get_ident() == caller))
    monkeypatch.setattr(torch.cuda, "utilization", utilization)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    monkeypatch.setattr(chain, "SAMPLE_SECONDS", 0.01)
    assert chain.timed(lambda: twice.wait(120), "cuda")[1] == 0.5
    assert set(asked) == {1}


@pytest.mark.parametrize("refine", [True, False])
def test_functions_and_commands_are_the_same_stages(tmp_path, refine):
    options = ChainBenchOptions(refine=refine)
    names = list(chain.stage_calls(tmp_path, tmp_path, options))
    lines = chain.command_lines(tmp_path, tmp_path, options)
    assert names == list(lines) and ("refine" in names) == refine
    assert (str(tmp_path / "refined.ply") in lines["simulate"]) == refine


def test_a_failing_command_is_named():
    with pytest.raises(InputError, match="(?s)ngff segment failed: .*No such option: --colour"):
        chain._command_seconds(["segment", "--colour"])  # the option is refused before the stage is imported
