"""The table of times, with small functions instead of the stages, and once with the real stages."""

import json

import pytest

from ngff_cli.lab import app
from stages.core.scene.scene_ply import write_scene
from stages.lab.bench import chain_table
from stages.lab.bench.speed_options import ChainTableOptions
from tests.conftest import CliRunner, two_balls_scene

SMALL = ChainTableOptions(objects=(3, 6), photos=4, width=64, repeat=1)


def test_the_table_has_a_row_for_each_number_of_objects_and_refinement(tmp_path, monkeypatch):
    asked = []

    def calls(photos, folder, options):
        assert len(list(photos.glob("*.jpg"))) == 4
        names = [name for name in chain_table.STAGES if options.refine or name != "refine"]
        asked.append(names)
        work = {"segment": lambda: write_scene(folder / "labelled.ply", two_balls_scene())}
        return {name: work.get(name, lambda: None) for name in names}

    monkeypatch.setattr(chain_table, "stage_calls", calls)
    monkeypatch.setattr(chain_table, "timed", lambda call, device: (call(), 1.0)[::-1])
    lines = list(chain_table.run(tmp_path / "table.json", SMALL))
    assert lines[-4:] == [
        "| 3 | 2 | yes | 1.0 | 1.0 | 1.0 | 1.0 | 1.0 | 5.0 | 37 |",
        "| 3 | 2 | no | 1.0 | 1.0 |  | 1.0 | 1.0 | 4.0 | 12 |",
        "| 6 | 2 | yes | 1.0 | 1.0 | 1.0 | 1.0 | 1.0 | 5.0 | 72 |",
        "| 6 | 2 | no | 1.0 | 1.0 |  | 1.0 | 1.0 | 4.0 | 19 |",
    ]
    assert len(json.loads((tmp_path / "table.json").read_text())["runs"]) == 4 == len(asked)


def test_photos_and_the_table_exclude_each_other(tmp_path):
    for words in ([], [str(tmp_path), "--table"]):
        done = CliRunner().invoke(app, ["bench", "chain", *words])
        assert done.exit_code == 2 and "give PHOTOS or --table" in done.output


@pytest.mark.slow
def test_three_toys_go_from_photos_to_films(tmp_path, device):
    options = ChainTableOptions(objects=(3,), photos=20, width=320, quality="draft", steps=3, repeat=1)
    lines = list(chain_table.run(tmp_path / "table.json", options))
    runs = json.loads((tmp_path / "table.json").read_text())["runs"]
    assert [run["refine"] for run in runs] == [True, False] and len(lines) == 6
    assert all(run["found"] >= 2 and min(run["seconds"].values()) > 0 for run in runs)
    assert runs[0]["seconds"]["segment"] == runs[1]["seconds"]["segment"]
