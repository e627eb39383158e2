"""Errors of the command line: one line on stderr, exit status 2, and no incomplete file."""

import os
import re
import signal
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from tqdm import tqdm

from ngff_cli.lab import app as lab_app
from ngff_cli.options import fail, run_command_line
from stages.core.models.segmenter import segment as network_segmenter
from stages.core.models.segmenter.voxels import SCALES
from stages.core.scene.scene_ply import write_scene
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run
from tests.conftest import two_balls_scene
from tests.limits import file_size_limit
from tests.pipeline.test_commands import call

pytestmark = pytest.mark.usefixtures("device", "input_files")
WRONG = [
    "reconstruct absent -o o.ply",
    "reconstruct empty -o o.ply",
    "reconstruct text.h5 -o o.ply",
    "reconstruct damaged -o o.ply",
    "reconstruct damaged -o nowhere/o.ply",
    "segment absent.ply -o o.ply",
    "segment text.ply -o o.ply",
    "segment cut.ply -o o.ply",
    "segment empty -o o.ply",
    "segment good.ply -o nowhere/o.ply",
    "refine text.ply -o o.ply",
    "refine empty.ply -o o.ply",
    "refine cut.ply -o o.ply",
    "refine good.h5 -o o.ply",
    "refine good.ply -o empty",
    "simulate text.ply -o o.h5",
    "simulate cut.ply -o o.h5",
    "simulate good.h5 -o o.h5",
    "simulate good.ply -o nowhere/o.h5",
    "simulate good.ply -o o.h5 --engine magic",
    "simulate good.ply -o o.h5 --force nonsense",
    "simulate good.ply -o o.h5 --device abacus",
    "render absent.h5",
    "render text.h5",
    "render cut.h5",
    "render empty.h5",
    "render empty",
    "render good.ply -o o.gif",
    "render good.ply -o nowhere/o.png",
    "evaluate text.h5 --against text.h5",
    "evaluate good.h5 --against cut.h5",
    "evaluate good.h5 --against good.ply",
    "evaluate good.ply --against absent.ply",
    "evaluate good.h5 --against good.h5 -o nowhere/m.json",
    "evaluate good.h5 --against good.h5 -o m.json --report nowhere/r.html",
]


@pytest.fixture(autouse=True)
def quick_segmentation(monkeypatch):
    monkeypatch.setattr(network_segmenter, "SCALES", SCALES[:1])  # one of three, each of which takes time


@pytest.fixture(scope="module")
def made_files(tmp_path_factory, device):
    """A valid scene and trajectory, and files that are missing, empty, truncated, or have a different format."""
    folder = tmp_path_factory.mktemp("wrong")
    for name in ("empty", "damaged"):
        (folder / name).mkdir()
    for i in range(3):
        (folder / f"damaged/{i}.jpg").write_bytes(b"\xff\xd8\xff\xe0 and no more")
    for name in ("empty.ply", "empty.h5"):
        (folder / name).touch()
    for name in ("text.ply", "text.h5"):
        (folder / name).write_text("not the format of the suffix")
    write_scene(folder / "good.ply", two_balls_scene())
    run(folder / "good.ply", folder / "good.h5", SimulateOptions(steps=3, quality="draft", device=device))
    for kind in ("ply", "h5"):
        content = (folder / f"good.{kind}").read_bytes()
        (folder / f"cut.{kind}").write_bytes(content[: 2 * len(content) // 3])
    return folder


@pytest.fixture
def input_files(made_files, monkeypatch):
    """The folder of these files, set as the working directory."""
    monkeypatch.chdir(made_files)
    return made_files


def fails_cleanly(words: str, command=call, expected=2) -> str:
    """Assert one line on stderr, the expected status, empty stdout and no new file; returns the line on stderr."""
    before = sorted(p.name for p in Path.cwd().iterdir())
    status, out, err = command(*words.split())
    lines = [line for line in err.splitlines() if line.startswith("ngff: ")]
    assert status == expected and len(lines) == 1, err
    assert "Traceback" not in err and out == ""
    assert sorted(p.name for p in Path.cwd().iterdir()) == before
    return lines[0]


@pytest.mark.parametrize("line", WRONG)
def test_wrong_input_gives_one_line_and_status_2(line):
    fails_cleanly(line)


@pytest.mark.parametrize("words", [["foo"], [""], ["bench", "foo"]])
def test_a_command_that_does_not_exist_is_an_error_of_usage(words):
    status, _, err = call(*words, app=lab_app)
    assert status == 2 and f"Error: No such command '{words[-1]}'" in err


def test_an_error_is_one_line_below_the_progress_bar(capsys):
    bar = iter(tqdm(range(3), file=sys.stderr))
    next(bar)
    with pytest.raises(SystemExit):
        fail("--sync a\nb\x1b: choose", 2)
    assert re.search(r"[^\n]\nngff: --sync a\?b\?: choose\n$", capsys.readouterr().err)
    assert list(bar) == [1, 2]


def work(*_, **__):
    pytest.fail("the work has begun")


WORK = {  # for each stage, the function that is called after the check of the output, and its replacement
    "reconstruct": ("read_photos", work), "segment": ("choose", lambda *_: work), "refine": ("refine", work),
    "simulate": ("with_objects", work), "render": ("load", lambda *_: work), "evaluate": ("load", lambda *_: work),
}  # fmt: skip
SOURCES = {"evaluate": "good.h5 --against good.h5"}  # other stages use good.ply


@pytest.mark.parametrize(("out", "message"), [("nowhere/o{}", "no folder"), ("empty", "is a folder"),
                                              ("", "--out: the path is empty"), (".", "is a folder")])  # fmt: skip
@pytest.mark.parametrize("stage", WORK)
def test_an_output_that_cannot_be_written_is_reported_before_the_work(stage, out, message, monkeypatch):
    if stage == "render" and message == "is a folder":
        pytest.skip("a folder gets PLY files")
    monkeypatch.setattr(f"stages.{stage}.stage.{WORK[stage][0]}", WORK[stage][1])
    suffix = {"simulate": ".h5", "evaluate": ".json"}.get(stage, ".ply")
    words = [stage, *SOURCES.get(stage, "good.ply").split(), "-o", out.format(suffix)]
    status, _, err = call(*words)
    assert status == 2 and message in err and "Traceback" not in err


@pytest.mark.parametrize("line", [
    "reconstruct damaged -o good.h5", "segment good.ply -o good.h5", "refine good.ply -o good.h5",
    "simulate good.ply -o good.ply", "evaluate good.h5 --against good.h5 -o good.h5", "segment good.ply -o labelled",
])  # fmt: skip
def test_outputs_have_the_suffix_of_their_format_so_that_other_files_are_not_replaced(input_files, line):
    before = {name: (input_files / name).read_bytes() for name in ("good.ply", "good.h5")}
    assert "suffix" in fails_cleanly(line)
    assert before == {name: (input_files / name).read_bytes() for name in before}


@pytest.mark.parametrize("line", [
    "fit good.ply good.h5 -o good.h5", "estimate-materials good.ply -o good.ply", "track good.ply empty -o good.ply",
])  # fmt: skip
def test_outputs_of_the_lab_have_the_suffix_of_their_format(input_files, line):
    before = {name: (input_files / name).read_bytes() for name in ("good.ply", "good.h5")}
    assert "suffix" in fails_cleanly(line, lambda *words: call(*words, app=lab_app))
    assert before == {name: (input_files / name).read_bytes() for name in before}


@pytest.mark.parametrize("line", ["clutter good.ply", "objects good.ply", "backgrounds good.ply", "dataset good.ply",
                                  "heldout good.ply"])  # fmt: skip
def test_folders_of_the_lab_that_are_files_are_reported_before_the_work(line):
    assert re.search("good.ply.*: is not a folder", fails_cleanly(line, lambda *words: call(*words, app=lab_app)))


def test_a_file_is_not_rendered_over_itself(input_files):
    before = (input_files / "good.ply").read_bytes()
    assert "is one of the files to render; name another" in fails_cleanly("render good.ply -o good.ply")
    assert (input_files / "good.ply").read_bytes() == before


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="permissions are those of POSIX")
def test_a_folder_that_cannot_be_written_to_is_reported_before_the_work(input_files, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # root may write everywhere
    assert "o.ply: its folder is not writable" in fails_cleanly("segment good.ply -o o.ply")


FULL = [
    "segment good.ply -o o.ply",
    "refine good.ply -o o.ply",
    "simulate good.ply -o o.h5 --steps 3 --quality draft",
    "render good.h5 -o o.mp4 --resolution 64",
    "render good.ply -o o.png --resolution 64",
    "evaluate good.h5 --against good.h5 -o m.json",
]


@pytest.mark.parametrize("line", FULL)
def test_full_disk_gives_one_line_and_status_2(line):
    def limited(*args):
        with file_size_limit(600):
            return call(*args)

    assert "cannot be written" in fails_cleanly(line, limited)


EXHAUSTED = [
    ("reconstruct damaged -o o.ply", "photo_reader:_is_truncated", "--quality or --resolution"),
    ("segment good.ply -o o.ply", "stage:rename_objects", "--max-objects"),
    ("refine good.ply -o o.ply", "stage:fill_background", "--resolution"),
    ("simulate good.ply -o o.h5 --engine ngff", "learned:TimeStepper", "--quality or --keypoints"),
    ("render good.h5 -o o.mp4", "draw:rasterise", "--resolution"),
]


@pytest.mark.parametrize(("line", "where", "options"), EXHAUSTED)
def test_gpu_out_of_memory_gives_one_line_and_status_1(monkeypatch, line, where, options):
    def exhausted(*_, **__):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB")

    module, name = where.split(":")
    monkeypatch.setattr(import_module(f"stages.{line.split()[0]}.{module}"), name, exhausted)
    message = fails_cleanly(line, expected=1)
    assert "the GPU is out of memory" in message and f"lower {options}, use --device cpu" in message


@pytest.mark.parametrize("allocate", [torch.empty, np.empty], ids=["torch", "numpy"])
def test_out_of_memory_gives_one_line_and_status_1(monkeypatch, allocate):
    monkeypatch.setattr(import_module("stages.render.draw"), "rasterise", lambda *_, **__: allocate(1 << 50))
    line = fails_cleanly("render good.h5 -o o.mp4", expected=1)
    assert line.endswith("the machine is out of memory: close other programs that use it, lower --resolution")


def test_out_of_memory_names_only_options_that_the_command_has(monkeypatch):
    """The field `quality` of `bench track` is the option --reconstructed."""

    def exhausted(*_):
        raise MemoryError

    monkeypatch.setattr("stages.lab.bench.track.run", exhausted)
    status, _, err = call("bench", "track", app=lab_app)
    assert status == 1 and err.strip() == "ngff: the machine is out of memory: close other programs that use it"


def test_out_of_memory_before_a_command_begins_gives_one_line(capsys):
    def app(words):
        raise ImportError("x.so: failed to map segment from shared object")

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with pytest.raises(SystemExit) as ended:
            run_command_line(app, [])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    line = capsys.readouterr().err
    assert ended.value.code == 1 and line == "ngff: the machine is out of memory: close other programs that use it\n"


def test_out_of_memory_while_a_file_is_read_is_not_reported_as_a_damaged_file(monkeypatch):
    monkeypatch.setattr(import_module("stages.core.scene.trajectory"), "_read", lambda *_: np.empty(1 << 50))
    line = fails_cleanly("render good.h5 -o o.mp4", expected=1)
    assert "the machine is out of memory" in line and "good.h5" not in line


def test_other_runtime_errors_are_not_reported_as_out_of_memory(input_files, monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("a mistake of ours")

    monkeypatch.setattr(import_module("stages.render.draw"), "rasterise", broken)
    status, _, err = call("render", input_files / "good.ply", "-o", input_files / "o.png")
    assert status == 1 and "out of memory" not in err and not (input_files / "o.png").exists()
