"""Benchmark of segmentation on real photos: rows, files and errors, with existing scenes and simulated stages."""

import json

import pytest
import torch

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.scene.images import write_labels, write_png
from stages.core.scene.scene_ply import write_scene
from stages.lab.bench.scene_options import SegmentPhotosOptions
from stages.lab.bench.segment_photos import labels_of, run
from tests.conftest import CliRunner
from tests.evaluate.test_labels import NAMES, SIZE, billboards, picture


@pytest.fixture
def sets(tmp_path):
    """Photo sets `desk` and `shelf`, each with labels of one of two photos, and a labelled scene of `desk`."""
    truth = picture(a_1=(4, 4, 24, 24), b_2=(30, 4, 50, 24), c_3=(40, 30, 60, 40))
    for name in ("desk", "shelf"):
        (tmp_path / name / "images").mkdir(parents=True)
        for photo in "ab":
            write_png(tmp_path / name / "images" / f"{photo}.png", torch.zeros(*SIZE[::-1], 3))
        (tmp_path / "labels" / name).mkdir(parents=True)
        write_labels(tmp_path / "labels" / name / "a.png", torch.from_numpy(truth))
        (tmp_path / "labels" / name / "names.json").write_text(json.dumps(NAMES))
    found = picture(a_5=(4, 4, 24, 24), c_7=(4, 30, 24, 40))
    (tmp_path / "ready").mkdir()
    write_scene(tmp_path / "ready/desk.ply", billboards([found, 0 * found], ["a.png", "b.png"], SIZE))
    return tmp_path


def test_ready_scenes_give_a_row_and_a_table(sets):
    options = SegmentPhotosOptions(sets / "labels", sets / "ready")
    lines = list(run([sets / "desk"], sets / "out.json", options))
    facts = json.loads((sets / "out.json").read_text())
    row = facts["sets"]["desk"]
    assert (row["photos"], row["placed"], row["labelled_photos"], row["objects"], row["found"]) == (2, 2, 1, 2, 2)
    assert row["recall"] == 0.5 and 0.4 < row["PQ"] <= 0.5 and set(row["objects_iou"]) == {"duck", "cup"}
    assert row["by_labels"]["recall"] == 1 and row["by_labels"]["PQ"] > 0.8
    assert "torch" in facts["machine"] and facts["command"] == "ngff-lab bench segment PHOTOSET..."
    assert lines[-1].startswith("desk") and "2 of 2" in lines[-1] and "ready" in lines[-1]
    table = (sets / "out.md").read_text().splitlines()
    assert table[-3].startswith("| set |") and table[-1].startswith("| desk | 2 of 2 | 1 | 2 | 2 | 0.50 |")


def test_missing_scenes_are_made_and_kept(sets, monkeypatch):
    made = []

    def reconstruct(photos, out, options):
        if photos.parent.name == "shelf":
            raise InputError(f"{photos}: no two photos overlap")
        made.append(photos)
        write_scene(out, billboards([picture(), picture()], ["a.png", "b.png"], SIZE))

    def segment(scene, out):
        write_scene(out, billboards([picture(a_5=(4, 4, 24, 24)), picture()], ["a.png", "b.png"], SIZE))

    monkeypatch.setattr("stages.reconstruct.stage.run", reconstruct)
    monkeypatch.setattr("stages.segment.stage.run", segment)
    options = SegmentPhotosOptions(sets / "labels", sets / "new")
    *_, desk, shelf = run([sets / "desk", sets / "shelf"], sets / "out.json", options)
    rows = json.loads((sets / "out.json").read_text())["sets"]
    assert rows["shelf"] == {"failed": "no two photos overlap"} and "no two photos overlap" in shelf
    assert rows["desk"]["false"] == 0 and rows["desk"]["seconds"].keys() == {"reconstruct", "segment"}
    assert [p.name for p in (sets / "new").iterdir()] == ["desk.ply"] and len(made) == 1
    assert "| shelf | no two photos overlap |" in (sets / "out.md").read_text()
    list(run([sets / "desk"], None, options))
    assert len(made) == 1


def test_folder_of_the_labels(sets):
    own = sets / "labels/desk"
    assert labels_of(sets / "desk", SegmentPhotosOptions(sets / "labels")) == own
    assert labels_of(sets / "desk", SegmentPhotosOptions(own)) == own
    own.rename(sets / "desk/labels")
    assert labels_of(sets / "desk", SegmentPhotosOptions()) == sets / "desk/labels"
    with pytest.raises(InputError, match="labels/desk: contains no names.json; give the folder .* with --labels"):
        labels_of(sets / "desk", SegmentPhotosOptions(sets / "labels"))


def test_command_line(sets):
    options = ["--labels", str(sets / "labels"), "--labelled", str(sets / "ready"), "--json"]
    done = CliRunner().invoke(app, ["bench", "segment", str(sets / "desk"), *options])
    assert done.exit_code == 0 and '"recall": 0.5' in done.stdout
    done = CliRunner().invoke(app, ["bench", "segment", "--labels", str(sets / "labels")])
    assert done.exit_code == 2 and "name their folders (PHOTOSET)" in done.stderr
