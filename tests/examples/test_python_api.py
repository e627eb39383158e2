import runpy
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).resolve().parents[2] / "examples/python_api.py"


@pytest.mark.slow
@pytest.mark.usefixtures("device")
def test_every_stage_is_callable_from_python(tmp_path):
    metrics = runpy.run_path(str(EXAMPLE))["main"](tmp_path)  # the example itself asserts the outcome of each stage
    assert set(metrics["objects"]) == {"red block", "blue block"}
