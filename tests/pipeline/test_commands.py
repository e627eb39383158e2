"""The command line: options, help, completion and the whole chain."""

import dataclasses
import inspect
import json
import os
import subprocess
import sys
import typing
from importlib import import_module
from pathlib import Path

import pytest
import typer

from ngff_cli import app as commands
from ngff_cli.app import app
from ngff_cli.lab import app as lab_app
from ngff_cli.options import print_results, with_options
from stages.core.errors import InputError
from stages.core.models.segmenter import segment as network_segmenter
from stages.core.models.segmenter.voxels import SCALES
from stages.core.options import option
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.trajectory import read_trajectory
from stages.reconstruct.options import QUALITY_PRESETS
from tests.conftest import CliRunner
from tests.reconstruct.raycast import arc, write_set

ROOT = Path(__file__).resolve().parents[2]
PIPELINE = ("reconstruct", "segment", "refine", "simulate", "render", "evaluate")


def call(*args, app=app) -> tuple[int, str, str]:
    """Exit status, stdout and stderr of `ngff ARGS`, or of another Typer `app` with these arguments."""
    done = CliRunner().invoke(app, [str(a) for a in args])
    return done.exit_code, done.stdout, done.stderr


def all_commands(app, prefix=()):
    """Yield the words and the callback of every command of a Typer app and its sub-apps."""
    for command in app.registered_commands:
        yield (*prefix, command.name or command.callback.__name__), command.callback
    for group in app.registered_groups:
        yield from all_commands(group.typer_instance, (*prefix, *filter(None, [group.name])))


COMMANDS = {" ".join(words): callback for words, callback in
            [*all_commands(app, ("ngff",)), *all_commands(lab_app, ("ngff-lab",))]}  # fmt: skip


def first_paragraph(callback) -> str:
    """The first paragraph of the docstring, on one line."""
    return " ".join(inspect.getdoc(callback).split("\n\n")[0].split())


def test_exactly_six_commands_in_the_order_of_the_pipeline():
    names = [c.name or c.callback.__name__ for c in app.registered_commands]
    assert names == list(PIPELINE)


@pytest.mark.parametrize("command", PIPELINE)
def test_every_field_of_the_options_class_is_an_option(command):
    options = getattr(inspect.getmodule(getattr(commands, command)), f"{command.capitalize()}Options")
    words = {w for p in typer.main.get_command(app).commands[command].params for w in p.opts}
    assert {"--" + f.name.replace("_", "-") for f in dataclasses.fields(options)} <= words


@dataclasses.dataclass(frozen=True)
class Some:
    many: tuple[int, ...] = option((1, 2), "numbers", "--number")
    flag: bool = option(False, "a flag")
    on: bool = option(True, "with a form for no")
    few: int = option(3, "up to five", max=5)
    inner: int = 7  # a field that is not an option


@dataclasses.dataclass(frozen=True)
class Others:
    few: int = option(3, "shared")
    path: Path | None = option(None, "a file")


def test_options_of_a_command_are_the_fields_of_its_classes():
    seen, own = [], typer.Typer()

    @own.command()
    @with_options
    def command(*, word: str, some: Some, others: Others) -> None:
        """Do nothing."""
        seen.append((word, some, others))

    assert call("a", app=own)[0] == 0
    assert call("a", "--number", 5, "--number", 6, "--flag", "--no-on", "--few", 4, "--path", "b", app=own)[0] == 0
    assert seen == [("a", Some(), Others()), ("a", Some((5, 6), True, False, 4), Others(4, Path("b")))]
    for wrong in (["--few", 6], ["--inner", 1], ["--no-flag"]):
        assert call("a", *wrong, app=own)[0] == 2
    assert "up to five" in call("--help", app=own)[1]


@pytest.mark.parametrize("line", [
    "evaluate a.mp4 --judge --timeout nan", "evaluate a.mp4 --seed 9223372036854775808",
    "train ngff --data a -o b --minutes nan", "train ngff --data a -o b --lr nan",
])  # fmt: skip
def test_numbers_that_no_option_takes(line):
    words = line.split()
    status, _, err = call(*words, app=app if words[0] == "evaluate" else lab_app)
    assert status == 2 and err.strip().startswith(f"ngff: {words[-2]} {words[-1]}: give a")


def counts():
    """Pairs (option class, field) of all integer options of all commands."""
    for callback in COMMANDS.values():
        for cls in typing.get_type_hints(inspect.unwrap(callback)).values():
            if dataclasses.is_dataclass(cls):
                hints = typing.get_type_hints(cls)
                yield from ((cls, f) for f in dataclasses.fields(cls) if "help" in f.metadata and hints[f.name] is int)


COUNTS = {f"{cls.__name__}-{f.name}": (cls, f) for cls, f in counts()}


@pytest.mark.parametrize(("cls", "field"), COUNTS.values(), ids=COUNTS)
def test_counts_are_not_negative(cls, field):
    if "min" not in field.metadata:
        with pytest.raises(InputError):
            cls(**{field.name: -1})


BENCHMARKS = [
    (line.split()[-1], bench) for line, callback in COMMANDS.items() if (bench := getattr(callback, "run", ""))
]


@pytest.mark.parametrize(("name", "run"), BENCHMARKS)
def test_benchmarks_run_what_they_name(name, run, monkeypatch):
    module, function = run.split(":")
    assert callable(getattr(import_module(module), function))
    seen = []
    monkeypatch.setattr(f"{module}.{function}", lambda path, options: seen.append((path, options)) or ["a line"])
    status, out, _ = call("bench", name, app=lab_app)
    assert status == 0 and out == "a line\n" and len(seen) == 1


def test_options_that_are_given_are_told_from_those_that_are_not(monkeypatch, tmp_path):
    """A recording (--forces) does not replace an option that was given, even with its default value."""
    seen = []
    monkeypatch.setattr(commands, "load", lambda entry: lambda *arguments: seen.append(arguments))
    assert call("simulate", tmp_path / "a.ply", "--gravity", "9.81")[0] == 0
    *_, options, given = seen[0]
    assert options.gravity == 9.81 and "gravity" in given and "steps" not in given


@pytest.mark.parametrize("command", PIPELINE)
def test_help_names_input_and_output(command):
    status, out, _ = call(command, "--help")
    assert status == 0 and "->" in out


@pytest.mark.parametrize("script", ["ngff", "ngff-lab"])
def test_help_shows_the_whole_sentence_of_each_command(script):
    done = CliRunner().invoke({"ngff": app, "ngff-lab": lab_app}[script], ["--help"], terminal_width=80)
    text = " ".join(done.stdout.split())
    for name, callback in COMMANDS.items():
        if name.split()[:-1] == [script]:
            assert f"{name.split()[-1]} {first_paragraph(callback)}" in text


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_and_option_is_documented(name):
    assert first_paragraph(COMMANDS[name]).endswith((".", ")."))
    hints = typing.get_type_hints(COMMANDS[name], include_extras=True)
    assert all(hint.__metadata__[0].help for option, hint in hints.items() if option not in ("return", "context"))


@pytest.mark.parametrize("name", COMMANDS)
def test_an_empty_path_is_an_error(name):
    """Otherwise Path("") would be the current folder."""
    script, *words = name.split()
    script = {"ngff": app, "ngff-lab": lab_app}[script]
    command = typer.main.get_command(script)
    for word in words:
        command = command.commands[word]
    hints, before = typing.get_type_hints(COMMANDS[name]), []
    for parameter in command.params:
        is_option = parameter.param_type_name == "option"
        if Path in (hints[parameter.name], *typing.get_args(hints[parameter.name])):
            given = [parameter.opts[0], ""] if is_option else [*before, ""]
            status, _, err = call(*words, *given, app=script)
            assert status == 2 and err.startswith("ngff: ") and "the path is empty" in err, (given, err)
        if not is_option:
            before.append("x")


@pytest.mark.parametrize("name, script", [("ngff", app), ("ngff-lab", lab_app)], ids=["ngff", "ngff-lab"])
def test_shell_completion(name, script, monkeypatch):
    variable = f"_{name.replace('-', '_').upper()}_COMPLETE"
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    done = CliRunner().invoke(script, ["--show-completion", "bash"], prog_name=name)
    assert done.exit_code == 0 and variable in done.stdout
    env = {variable: "complete_bash", "COMP_WORDS": f"{name} re", "COMP_CWORD": "1"}
    done = CliRunner().invoke(script, [], prog_name=name, env=env)
    expected = [c.split()[1] for c in COMMANDS if c.startswith(f"{name} re") and len(c.split()) == 2]
    assert done.exit_code == 0 and done.stdout.split() == expected


def test_six_commands_in_a_row(tmp_path, monkeypatch, device):
    """Each command uses the output of the preceding one, on a given device."""
    draft = dataclasses.replace(QUALITY_PRESETS["draft"], gaussians=2000)
    monkeypatch.setitem(QUALITY_PRESETS, "draft", draft)
    monkeypatch.setattr(network_segmenter, "SCALES", SCALES[:1])  # one of three
    monkeypatch.setattr(network_segmenter, "REDUCTIONS", ())
    monkeypatch.setattr(network_segmenter, "COPIES", 1)  # one instead of four
    cameras = write_set(tmp_path, arc(4, (96, 72), sweep=40.0))
    scene, labelled, refined, motion = (tmp_path / name for name in ("a.ply", "b.ply", "c.ply", "t.h5"))
    quick = "--quality", "draft"
    for words in (
        ("reconstruct", tmp_path / "images", "-o", scene, "--cameras", cameras, *quick, "--iterations", 2),
        ("segment", scene, "-o", labelled), ("refine", labelled, "-o", refined),
        ("simulate", refined, "-o", motion, *quick, "--steps", 4, "--lift", 0.3),
        ("render", motion, "--view", "input:0", "--resolution", 64),
    ):  # fmt: skip
        status, out, err = call(*words, "--device", device)
        assert status == 0, err
    assert "t_input_0.mp4" in out
    trajectory = read_trajectory(motion)
    assert len(trajectory) == 4
    fallen = float(trajectory.com[0, 0, 2] - trajectory.com[3, 0, 2])  # in 3 frames of 0.02 s
    assert fallen == pytest.approx(-trajectory.info.gravity[2] * 0.06**2 / 2, rel=0.1)
    status, out, err = call("evaluate", motion, "--against", motion, "--json")
    assert status == 0 and json.loads(out) == json.loads((tmp_path / "metrics.json").read_text()), err
    status, out, err = call("evaluate", motion, "--against", motion)
    assert out.split()[:2] == ["MSE", "RMSE"]
    (found,) = read_scene(labelled).objects  # the block; its texture is noise without a definite colour
    assert status == 0 and found.name in out, err


def test_json_replaces_the_table_on_stdout(tmp_path, capsys):
    def run(out):
        yield "a table"
        if out is not None:
            out.write_text('{"PSNR": 30}\n')

    print_results(run, None, as_json=False)
    assert capsys.readouterr() == ("a table\n", "")
    for out in (None, tmp_path / "results.json"):
        print_results(run, out, as_json=True)
        assert capsys.readouterr() == ('{"PSNR": 30}\n', "a table\n")
    assert (tmp_path / "results.json").exists()


def test_commands_that_print_tables_have_json():
    tables = {"ngff evaluate", "ngff-lab doctor", "ngff-lab fuzz", "ngff-lab statistics", "ngff-lab study",
              *(name for name in COMMANDS if name.startswith("ngff-lab bench"))}  # fmt: skip
    given = {name for name, callback in COMMANDS.items() if "as_json" in inspect.signature(callback).parameters}
    assert given == tables


def test_threads_limits_pytorch():
    code = ("import sys; sys.argv = ['ngff', '--threads', '1', 'simulate', '--help']\n"
            "import ngff_cli.app as a\n"
            "try:\n a.main()\nexcept SystemExit: pass\n"
            "import torch; print(torch.get_num_threads())")  # fmt: skip
    env = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=env, check=True)
    assert done.stdout.split()[-1] == "1"
