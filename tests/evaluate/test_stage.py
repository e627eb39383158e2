"""Stage evaluate: table, output files, report and errors."""

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from stages.core.errors import InputError
from stages.core.scene.images import write_png
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Curve, Result, format_number, format_table, to_json
from stages.evaluate.stage import run
from tests.browser import until
from tests.evaluate.motions import write_motion


def test_table_is_aligned():
    result = Result("trajectories", {"RMSE": 0.5, "R": math.nan, "frames": 3}, {"duck": {"RMSE": 0.00001}}, [])
    assert format_table(result).splitlines() == [
        "        RMSE  R  frames",
        "duck   1e-05  -       -",
        "all   0.5000  -       3",
    ]
    assert to_json(result)["overall"] == {"RMSE": 0.5, "R": None, "frames": 3}


def test_default_output_is_beside_the_prediction(tmp_path, two_balls):
    (tmp_path / "a").mkdir()
    mine, true = write_motion(tmp_path / "a/mine.h5", two_balls), write_motion(tmp_path / "true.h5", two_balls)
    facts = run(mine, true, None, EvaluateOptions())
    assert (tmp_path / "a/metrics.json").exists()
    assert [row["name"] for row in facts["provenance"]["inputs"]] == ["mine.h5", "true.h5"]


def test_report_of_trajectories_has_a_curve_per_object(tmp_path, two_balls):
    true = write_motion(tmp_path / "true.h5", two_balls)
    mine = write_motion(tmp_path / "mine.h5", two_balls, speed=0.05)
    run(mine, true, None, EvaluateOptions(report=tmp_path / "report.html"))
    html = (tmp_path / "report.html").read_text()
    assert html.count("<polyline") == 2 and "red ball" in html and "http" not in html.replace("http-equiv", "")
    ends = [float(points.split()[-1].split(",")[1]) for points in re.findall(r'points="([^"]*)"', html)]
    starts = [float(points.split()[0].split(",")[1]) for points in re.findall(r'points="([^"]*)"', html)]
    assert starts[0] == starts[1] > ends[0] > ends[1]  # errors increase, for the faster ball more (y points down)


def test_report_has_a_player_whose_time_is_that_of_the_curves(tmp_path, two_balls, open_page):
    true = write_motion(tmp_path / "true.h5", two_balls)
    run(true, true, None, EvaluateOptions(report=tmp_path / "report.html"))
    page = open_page(tmp_path / "report.html", "document.querySelector('iframe').contentWindow.player !== undefined")
    assert "1 red ball" in page.inner_text("table >> nth=0") and "--lift 1=0.3" in page.inner_text("pre")
    of_player = "document.querySelector('iframe').contentWindow.player"
    page.evaluate(f"{of_player}.play(false); {of_player}.seek({of_player}.duration / 2)")
    cursor = page.locator("#cursor")
    left, right = (float(cursor.get_attribute(f"data-{side}")) for side in ("left", "right"))
    until(page, f"Math.abs(document.getElementById('cursor').getAttribute('x1') - {(left + right) / 2}) < 1")
    plot = page.locator("body > figure svg")
    plot.click(position={"x": plot.bounding_box()["width"] * right / 720, "y": 20})
    until(page, f"{of_player}.time > 0.98 * {of_player}.duration")


def test_report_shows_photos_objects_and_times(tmp_path, two_balls):
    reconstruct, segment = {"command": "reconstruct", "seconds": 130.2}, {"command": "segment", "seconds": 9.8}
    scene = replace(two_balls, provenance={**segment, "options": {"masks": "labels"}, "scene": reconstruct})
    true = write_motion(tmp_path / "true.h5", scene)
    (tmp_path / "photos").mkdir()
    for name in scene.cameras.names:
        write_png(tmp_path / "photos" / name, torch.full((64, 90, 3), 0.5))  # the lens is unknown
    for photos, shown in ((tmp_path / "photos", ["photo", "drawing", "objects"]), (None, ["drawing", "objects"])):
        run(true, true, None, EvaluateOptions(report=tmp_path / "report.html", photos=photos))
        html = (tmp_path / "report.html").read_text()
        assert re.findall(r'<img alt="([^"]*)"', html) == shown * 3
    for text in ("reconstruct</td><td>130.2 s", "all</td><td>140.0 s", "were given (--masks)", "</span> red ball",
                 "--force &quot;object=1 force="):  # fmt: skip
        assert text in html


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [("x.txt", b"hello", "suffix .txt cannot be compared"), ("x.h5", b"", "is empty"),
     ("x.h5", b"hello", "not a readable HDF5"),
     ("x.ply", b"hello", "two files of the same kind"), ("x.h5", None, "no such file"),
     ("x.mp4", b"hello", "two files of the same kind")],
)  # fmt: skip
def test_wrong_files_give_one_line_and_write_nothing(tmp_path, two_balls, name, content, message):
    true = write_motion(tmp_path / "true.h5", two_balls)
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        run(tmp_path / name, true, None, EvaluateOptions())
    assert "\n" not in str(caught.value) and not (tmp_path / "metrics.json").exists()


def test_one_prediction_is_compared_with_one_truth():
    with pytest.raises(InputError, match="a.ply: the ground truth is missing; name it with --against"):
        run([Path("a.ply")], None, None, EvaluateOptions())
    with pytest.raises(InputError, match="b.ply: is a second prediction; give only one with --against"):
        run([Path("a.ply"), Path("b.ply")], Path("c.ply"), None, EvaluateOptions())


def test_options_that_do_not_apply_are_errors(tmp_path, two_balls):
    with pytest.raises(InputError, match="--frames 0"):
        EvaluateOptions(frames=0)
    with pytest.raises(InputError, match="--report x.pdf"):
        EvaluateOptions(report=Path("x.pdf"))
    (tmp_path / "a.png").write_bytes(b"x")
    with pytest.raises(InputError, match="--align: does not apply to files of kind image"):
        run(tmp_path / "a.png", tmp_path / "a.png", None, EvaluateOptions(align=True))


@pytest.mark.parametrize(("value", "text"), [
    (None, "-"), (math.nan, "-"), (7, "7"), (0.001, "0.0010"), (0.00099951, "0.0009995"), (-0.5, "-0.5000"),
    (9999.5, "9999.5000"), (10000.0, "1e+04"), (math.inf, "inf"), (0.0, "0"),
])  # fmt: skip
def test_numbers_have_four_significant_digits(value, text):
    assert format_number(value) == text


def test_values_of_json_that_json_has_not():
    found = to_json(Result("pictures", {"a": math.inf, "b": -math.inf, "c": math.nan, "d": 3}, {}, ["x"],
                           [Curve("duck", [0.5, math.nan])]))  # fmt: skip
    assert found == {"kind": "pictures", "overall": {"a": "inf", "b": "-inf", "c": None, "d": 3}, "objects": {},
                     "notes": ["x"], "per_frame": {"duck": [0.5, None]}}  # fmt: skip
