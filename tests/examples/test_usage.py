"""Examples without arguments print their usage, and with arguments they run as programs."""

import runpy
from pathlib import Path

import pytest

from stages.core.scene.scene_ply import write_scene
from stages.core.scene.trajectory import read_trajectory

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def start(monkeypatch):
    """Function that runs an example like `python SCRIPT ARGS`."""

    def run(script: Path, *args: object) -> None:
        monkeypatch.setattr("sys.argv", [str(script), *map(str, args)])
        runpy.run_path(str(script), run_name="__main__")

    return run


@pytest.mark.parametrize("script", sorted(EXAMPLES.rglob("*.py")), ids=lambda path: path.name)
def test_without_arguments_the_usage_is_printed(script, start, capsys):
    with pytest.raises(SystemExit) as stopped:
        start(script)
    assert stopped.value.code == 2 and capsys.readouterr().err.startswith(f"usage: {script.name}")


def test_trajectory_written_with_h5py_alone(start, tmp_path):
    start(EXAMPLES / "write_trajectory.py", tmp_path / "t.h5")
    assert len(read_trajectory(tmp_path / "t.h5")) == 50


def test_bounce_from_file_to_file(start, tmp_path, two_balls):
    write_scene(tmp_path / "scene.ply", two_balls)
    start(EXAMPLES / "new_backend/bounce.py", tmp_path / "scene.ply", tmp_path / "t.h5")
    assert read_trajectory(tmp_path / "t.h5").info.engine == "bounce"
