"""The command line as users meet it."""

import dataclasses
import inspect
import os
import resource
import subprocess
import sys
import typing
from contextlib import contextmanager
from pathlib import Path

import pytest
from typer.testing import CliRunner

from ngff_cli import app as commands
from ngff_cli.app import app
from stages import PIPELINE
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.trajectory import read_trajectory
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run
from tests.conftest import two_balls_scene

ROOT = Path(__file__).resolve().parents[2]
NOT_OPTIONS = {"out", "imgs", "scene", "source", "prediction", "against"}


def call(*args) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, [str(a) for a in args])
    return done.exit_code, done.stdout, done.stderr


def test_exactly_six_commands_in_the_order_of_the_pipeline():
    names = [c.name or c.callback.__name__ for c in app.registered_commands]
    assert names == list(PIPELINE) and len(names) == 6


@pytest.mark.parametrize("command", list(PIPELINE))
def test_every_field_of_the_options_is_on_its_command_with_the_same_default(command):
    options = getattr(commands, f"{command.capitalize()}Options")
    given = {n: p for n, p in inspect.signature(getattr(commands, command)).parameters.items() if n not in NOT_OPTIONS}
    fields = {f.name: f.default for f in dataclasses.fields(options)}
    assert list(given) == list(fields)
    for name, default in fields.items():
        assert (given[name].default or ()) == (default or ()), name


@pytest.mark.parametrize("command", list(PIPELINE))
def test_help_explains_every_option(command):
    status, out, _ = call(command, "--help")
    assert status == 0 and "->" in out or command == "evaluate"
    hints = typing.get_type_hints(getattr(commands, command), include_extras=True)
    assert all(hint.__metadata__[0].help for name, hint in hints.items() if name != "return")


def test_simulate_render_evaluate_in_a_row(tmp_path, two_balls):
    write_scene(tmp_path / "scene.ply", two_balls)
    few = ("--steps", 4, "--quality", "draft")
    status, _, err = call("simulate", tmp_path / "scene.ply", "-o", tmp_path / "t.h5", *few)
    assert status == 0, err
    trajectory = read_trajectory(tmp_path / "t.h5")
    assert len(trajectory) == 4
    # the green ball hangs in the air: after 3 frames of 0.02 s it has fallen g t^2 / 2 = 1.8 cm
    fallen = float(trajectory.com[0, 1, 2] - trajectory.com[3, 1, 2])
    assert fallen == pytest.approx(9.81 * 0.06**2 / 2, rel=0.1)
    status, out, err = call("render", tmp_path / "t.h5", "--resolution", 64)
    assert status == 0 and "t_novel.mp4" in out, err
    status, out, err = call("evaluate", tmp_path / "t.h5", "--against", tmp_path / "t.h5")
    assert status == 0 and (tmp_path / "metrics.json").exists(), err


def test_refine_reads_what_segment_writes(tmp_path, two_balls):
    write_scene(tmp_path / "scene.ply", two_balls)
    status, _, err = call("refine", tmp_path / "scene.ply", "-o", tmp_path / "refined.ply")
    assert status == 0, err
    assert {o.name for o in read_scene(tmp_path / "refined.ply").objects} == {"red ball", "green ball"}


WRONG = [
    ("reconstruct", "{}/absent", "-o", "{}/o.ply"),
    ("reconstruct", "{}/empty", "-o", "{}/o.ply"),
    ("reconstruct", "{}/text.h5", "-o", "{}/o.ply"),
    ("reconstruct", "{}/damaged", "-o", "{}/o.ply"),
    ("reconstruct", "{}/damaged", "-o", "{}/nowhere/o.ply"),
    ("segment", "{}/absent.ply", "-o", "{}/o.ply"),
    ("segment", "{}/text.ply", "-o", "{}/o.ply"),
    ("segment", "{}/cut.ply", "-o", "{}/o.ply"),
    ("segment", "{}/empty", "-o", "{}/o.ply"),
    ("segment", "{}/good.ply", "-o", "{}/nowhere/o.ply"),
    ("refine", "{}/text.ply", "-o", "{}/o.ply"),
    ("refine", "{}/empty.ply", "-o", "{}/o.ply"),
    ("refine", "{}/cut.ply", "-o", "{}/o.ply"),
    ("refine", "{}/good.h5", "-o", "{}/o.ply"),
    ("refine", "{}/good.ply", "-o", "{}/empty"),
    ("simulate", "{}/text.ply", "-o", "{}/o.h5"),
    ("simulate", "{}/cut.ply", "-o", "{}/o.h5"),
    ("simulate", "{}/good.h5", "-o", "{}/o.h5"),
    ("simulate", "{}/good.ply", "-o", "{}/nowhere/o.h5"),
    ("simulate", "{}/good.ply", "-o", "{}/o.h5", "--engine", "magic"),
    ("simulate", "{}/good.ply", "-o", "{}/o.h5", "--force", "nonsense"),
    ("simulate", "{}/good.ply", "-o", "{}/o.h5", "--device", "abacus"),
    ("render", "{}/absent.h5"),
    ("render", "{}/text.h5"),
    ("render", "{}/cut.h5"),
    ("render", "{}/empty.h5"),
    ("render", "{}/empty"),
    ("render", "{}/good.ply", "-o", "{}/o.gif"),
    ("render", "{}/good.ply", "-o", "{}/nowhere/o.png"),
    ("evaluate", "{}/text.h5", "--against", "{}/text.h5"),
    ("evaluate", "{}/good.h5", "--against", "{}/cut.h5"),
    ("evaluate", "{}/good.h5", "--against", "{}/good.ply"),
    ("evaluate", "{}/good.ply", "--against", "{}/absent.ply"),
    ("evaluate", "{}/good.h5", "--against", "{}/good.h5", "-o", "{}/nowhere/m.json"),
]


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A scene and a trajectory that are well, and every way in which a file can be bad."""
    folder = tmp_path_factory.mktemp("wrong")
    for name in ("empty", "damaged"):
        (folder / name).mkdir()
    for i in range(3):
        (folder / f"damaged/{i}.jpg").write_bytes(b"\xff\xd8\xff\xe0 and no more")
    for name in ("empty.ply", "empty.h5"):
        (folder / name).touch()
    for name in ("text.ply", "text.h5"):
        (folder / name).write_text("not what it says")
    write_scene(folder / "good.ply", two_balls_scene())
    run(folder / "good.ply", folder / "good.h5", SimulateOptions(steps=3, quality="draft"))
    for kind in ("ply", "h5"):
        whole = (folder / f"good.{kind}").read_bytes()
        (folder / f"cut.{kind}").write_bytes(whole[: 2 * len(whole) // 3])
    return folder


def fails_cleanly(folder, args, command=call) -> str:
    """One sentence, status 2, nothing on stdout and nothing left behind; returns the sentence."""
    before = sorted(p.name for p in folder.iterdir())
    status, out, err = command(*(str(a).format(folder) for a in args))
    lines = [line for line in err.splitlines() if line.startswith("ngff: ")]
    assert status == 2 and len(lines) == 1, err
    assert "Traceback" not in err and out == ""
    assert sorted(p.name for p in folder.iterdir()) == before
    return lines[0]


@pytest.mark.parametrize("args", WRONG, ids=lambda a: " ".join(a).replace("{}/", ""))
def test_a_mistake_is_one_sentence_and_status_two(workplace, args):
    fails_cleanly(workplace, args)


@contextmanager
def at_most(size: int):
    """No file may grow beyond `size` bytes: to a program, much like a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


FULL = [
    ("segment", "{}/good.ply", "-o", "{}/o.ply"),
    ("refine", "{}/good.ply", "-o", "{}/o.ply"),
    ("simulate", "{}/good.ply", "-o", "{}/o.h5", "--steps", 3, "--quality", "draft"),
    ("render", "{}/good.h5", "-o", "{}/o.mp4", "--resolution", 64),
    ("render", "{}/good.ply", "-o", "{}/o.png", "--resolution", 64),
    ("evaluate", "{}/good.h5", "--against", "{}/good.h5", "-o", "{}/m.json"),
]


@pytest.mark.parametrize("args", FULL, ids=lambda a: a[0] + a[3][-4:])
def test_a_full_disk_is_one_sentence_too(workplace, args):
    def limited(*args):
        with at_most(600):
            return call(*args)

    assert "cannot be written" in fails_cleanly(workplace, args, limited)


@pytest.mark.parametrize("count", [1, 2])
def test_threads_limits_pytorch(count):
    code = (f"import sys; sys.argv = ['ngff', '--threads', '{count}', 'simulate', 'missing.ply']\n"
            "import ngff_cli.app as a\n"
            "try:\n a.main()\nexcept SystemExit: pass\n"
            "import torch; print(torch.get_num_threads())")  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == str(min(count, os.cpu_count()))  # OpenMP starts no more threads than there are cores
