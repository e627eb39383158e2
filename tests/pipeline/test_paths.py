"""Files of any name, in folders that cannot be written, and in any locale."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stages.core.scene.scene_ply import write_scene
from tests.conftest import two_balls_scene
from tests.pipeline.test_commands import ROOT, call


def commands(scene: Path, out: Path) -> list[list]:
    """Command lines that write trajectories, pages, images and reports of a scene."""
    t, film = out / "t ü.h5", out / "f ü.html"
    return [
        ["simulate", scene, "--engine", "rigid", "--steps", "2", "--keypoints", "16", "-o", t],
        ["render", t, "-o", film], ["render", scene, "--view", "input:0", "--resolution", "32", "-o", out / "p ü.png"],
        ["evaluate", t, "--against", t, "-o", out / "m ü.json", "--report", out / "r ü.html"],
    ]  # fmt: skip


@pytest.mark.parametrize("name", [
    os.fsdecode("it's \"q\" $x ü 図".encode() + b", no UTF-8 \xff"),
    pytest.param("/".join(["d" * 200] * 14), marks=pytest.mark.slow),
], ids=["signs", "long"])  # fmt: skip
def test_any_file_name(tmp_path, name):
    inputs = tmp_path / "inputs"
    out = tmp_path / name
    inputs.mkdir()
    out.mkdir(parents=True)
    scene = inputs / f"{Path(name).name}.ply"
    write_scene(scene, two_balls_scene())
    inputs.chmod(0o555)
    try:
        for words in commands(scene, out):
            status, _, err = call(*words)
            assert status == 0, err
    finally:
        inputs.chmod(0o755)
    assert [p.name for p in inputs.iterdir()] == [scene.name]
    assert {p.suffix for p in out.iterdir()} == {".h5", ".html", ".png", ".json"}


@pytest.mark.slow
def test_locale_without_umlauts(tmp_path):
    write_scene(tmp_path / "s.ply", two_balls_scene())
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONPATH": str(ROOT)}
    for words in commands(tmp_path / "s.ply", tmp_path):
        line = [sys.executable, "-m", "ngff_cli.app", *map(str, words)]
        done = subprocess.run(line, env=environment, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.skipif(os.name != "posix", reason="closes streams by a shell")
def test_streams_that_the_caller_closed(tmp_path):
    scene, out = tmp_path / "s.ply", tmp_path / "o.png"
    write_scene(scene, two_balls_scene())
    line = f'exec "$0" -m ngff_cli.app render "{scene}" --resolution 32 -o "{out}" <&- >&- 2>&-'
    done = subprocess.run(["sh", "-c", line, sys.executable], cwd=ROOT, check=False)
    assert done.returncode == 0 and out.read_bytes().startswith(b"\x89PNG")
