import math
import re
from pathlib import Path

import pytest

from stages.core.errors import InputError
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Result, format_table, to_json
from stages.evaluate.stage import run
from tests.evaluate.motions import write


def test_the_table_is_aligned():
    result = Result("trajectories", {"RMSE": 0.5, "R": math.nan, "frames": 3}, {"duck": {"RMSE": 0.00001}}, [])
    assert format_table(result).splitlines() == [
        "        RMSE  R  frames",
        "duck   1e-05  -       -",
        "all   0.5000  -       3",
    ]
    assert to_json(result)["overall"] == {"RMSE": 0.5, "R": None, "frames": 3}


def test_metrics_stand_beside_the_prediction_when_no_name_is_given(tmp_path, two_balls):
    (tmp_path / "a").mkdir()
    mine, true = write(tmp_path / "a/mine.h5", two_balls), write(tmp_path / "true.h5", two_balls)
    facts = run(mine, true, None, EvaluateOptions())
    assert (tmp_path / "a/metrics.json").exists()
    assert [row["name"] for row in facts["provenance"]["inputs"]] == ["mine.h5", "true.h5"]


def test_the_report_of_trajectories_draws_every_object(tmp_path, two_balls):
    true = write(tmp_path / "true.h5", two_balls)
    mine = write(tmp_path / "mine.h5", two_balls, speed=0.05)
    run(mine, true, None, EvaluateOptions(report=tmp_path / "report.html"))
    html = (tmp_path / "report.html").read_text()
    assert html.count("<polyline") == 2 and "red ball" in html and "http" not in html
    ends = [float(points.split()[-1].split(",")[1]) for points in re.findall(r'points="([^"]*)"', html)]
    starts = [float(points.split()[0].split(",")[1]) for points in re.findall(r'points="([^"]*)"', html)]
    assert starts[0] == starts[1] > ends[0] > ends[1]  # errors grow upward, the faster ball's more


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [("x.txt", b"hello", "not a kind of file"), ("x.h5", b"", "is empty"), ("x.h5", b"hello", "not a readable HDF5"),
     ("x.ply", b"hello", "compare two of a kind"), ("x.h5", None, "no such file"),
     ("x.mp4", b"hello", "two of a kind")],
)  # fmt: skip
def test_wrong_files_get_one_sentence_and_leave_nothing(tmp_path, two_balls, name, content, says):
    true = write(tmp_path / "true.h5", two_balls)
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        run(tmp_path / name, true, None, EvaluateOptions())
    assert "\n" not in str(caught.value) and not (tmp_path / "metrics.json").exists()


def test_options_that_cannot_act_are_refused(tmp_path, two_balls):
    with pytest.raises(InputError, match="--frames 0"):
        EvaluateOptions(frames=0)
    with pytest.raises(InputError, match="--report x.pdf"):
        EvaluateOptions(report=Path("x.pdf"))
    (tmp_path / "a.png").write_bytes(b"x")
    with pytest.raises(InputError, match="--align: has no meaning for pictures"):
        run(tmp_path / "a.png", tmp_path / "a.png", None, EvaluateOptions(align=True))
