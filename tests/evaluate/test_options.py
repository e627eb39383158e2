"""Options of `ngff evaluate`: limits of their values."""

from pathlib import Path

import pytest

from stages.evaluate.options import MAX_FILMS_PER_QUESTION, EvaluateOptions
from tests.limits import check_limits


@pytest.mark.parametrize(("name", "accepted", "refused"), [
    ("frames", (1, None), (0, -1)), ("repeats", (1, 9), (0,)),
    ("films_per_question", (1, MAX_FILMS_PER_QUESTION), (0, MAX_FILMS_PER_QUESTION + 1)),
    ("report", (Path("a.html"), Path("a.HTM"), None), (Path("a.pdf"), Path("html"))), ("photos", (None,), (Path("p"),)),
])  # fmt: skip
def test_limits_of_options(name, accepted, refused):
    check_limits(EvaluateOptions, name, accepted, refused)


def test_photos_are_for_the_report_and_objects_are_named():
    assert EvaluateOptions(photos=Path("p"), report=Path("a.html")).photos == Path("p")
    assert EvaluateOptions(objects=" duck, ,red ball,").object_names == ["duck", "red ball"]
    assert EvaluateOptions().object_names == []
