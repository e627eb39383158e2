"""The command line as users meet it."""

import dataclasses
import inspect
import typing

import pytest
from typer.testing import CliRunner

from ngff_cli import app as commands
from ngff_cli.app import app
from stages import PIPELINE
from stages.scene.scene_ply import read_scene, write_scene
from stages.scene.trajectory import read_trajectory

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
    ("segment", "{}/absent.ply", "-o", "{}/o.ply"),
    ("segment", "{}/text.ply", "-o", "{}/o.ply"),
    ("refine", "{}/text.ply", "-o", "{}/o.ply"),
    ("refine", "{}/empty.ply", "-o", "{}/o.ply"),
    ("simulate", "{}/text.ply", "-o", "{}/o.h5"),
    ("simulate", "{}/good.ply", "-o", "{}/nowhere/o.h5"),
    ("simulate", "{}/good.ply", "-o", "{}/o.h5", "--engine", "magic"),
    ("simulate", "{}/good.ply", "-o", "{}/o.h5", "--force", "nonsense"),
    ("simulate", "{}/good.ply", "-o", "{}/o.h5", "--device", "abacus"),
    ("render", "{}/absent.h5"),
    ("render", "{}/text.h5"),
    ("render", "{}/good.ply", "-o", "{}/o.gif"),
    ("evaluate", "{}/text.h5", "--against", "{}/text.h5"),
    ("evaluate", "{}/good.ply", "--against", "{}/absent.ply"),
]


@pytest.mark.parametrize("args", WRONG, ids=lambda a: " ".join(a).replace("{}/", ""))
def test_a_mistake_is_one_sentence_and_status_two(tmp_path, two_balls, args):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty.ply").touch()
    for name in ("text.ply", "text.h5"):
        (tmp_path / name).write_text("not what it says")
    write_scene(tmp_path / "good.ply", two_balls)
    before = sorted(p.name for p in tmp_path.iterdir())
    status, out, err = call(*(a.format(tmp_path) for a in args))
    lines = [line for line in err.splitlines() if line.startswith("ngff: ")]
    assert status == 2 and len(lines) == 1, err
    assert "Traceback" not in err and out == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == before
