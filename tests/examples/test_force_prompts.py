"""examples/force_prompts: both engines obey the force prompts."""

import importlib.util
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
FOLDER = Path(__file__).resolve().parents[2] / "examples/force_prompts"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("compare_force_prompts", FOLDER / "compare.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def results(example, tmp_path_factory, device):
    out, quick = tmp_path_factory.mktemp("force_prompts"), {"keypoints": 64, "quality": "draft", "device": device}
    return {name: example.compare(name, out, 25, **quick) for name in example.PROMPTS}


@pytest.mark.parametrize("name", ["pillow", "cloth"])
@pytest.mark.parametrize("engine", ["mpm", "ngff"])
def test_objects_follow_the_force(results, name, engine):
    _, moved = results[name]
    assert moved[engine] > 0.05


def test_engines_are_compared_at_the_same_keypoints(results):
    for metrics, _ in results.values():
        assert metrics["overall"]["frames"] == 25 and metrics["overall"]["RMSE"] < 0.5
