"""Imports by each command during a complete run; packages that it does not use would add seconds to short runs."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest

from stages.core.scene.scene_ply import write_scene
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run as simulate
from tests.conftest import two_balls_scene
from tests.reconstruct.raycast import arc, write_set

ROOT = Path(__file__).resolve().parents[2]
# no command compiles with PyTorch (`import torch` itself imports torch.distributed, but none of these) or solves ODEs;
# gsplat is used only for comparisons
COMPILERS = {"torch._dynamo", "torch._inductor", "torch.distributed.fsdp", "torch.onnx", "sympy"}
UNUSED = {*COMPILERS, "gsplat", "torchdiffeq", "scipy.interpolate", "transformers", "diffusers", "av"}

# command line -> further packages that it must not import
COMMANDS = {
    "reconstruct set/images --cameras set/transforms.json --quality draft --iterations 0 -o out.ply": {
        "h5py",
        "scipy.optimize",
    },
    "segment scene.ply -o out.ply": {"h5py", "pycolmap"},
    "refine scene.ply -o out.ply": {"h5py", "pycolmap", "scipy.optimize"},
    "simulate scene.ply --quality draft --steps 3 -o out.h5": {"cv2", "pycolmap", "scipy.optimize"},
    "render traj.h5 --resolution 32 -o out.png": {"pycolmap", "scipy.optimize"},
    "evaluate traj.h5 --against traj.h5 -o out.json": {"cv2", "pycolmap", "scipy", "warp"},
}
SLOW_COMMANDS = {  # the same stages with scenes instead of trajectories
    "render scene.ply --resolution 32 -o out.png": {"pycolmap", "scipy"},
    "evaluate scene.ply --against scene.ply -o out.json": {"cv2", "h5py", "pycolmap", "warp"},
}

# PyTorch and the command line, which every command needs, are imported once; each command runs in a fork of the process
RUNNER = """
import json, os, sys, traceback
import ngff_cli.app, torch

for words, unused in json.loads(sys.argv[1]):
    if os.fork() == 0:
        status = None
        try:
            sys.argv = ["ngff", *words]
            ngff_cli.app.main()
        except SystemExit as ended:
            status = ended.code
        except BaseException:
            traceback.print_exc()
        with open("found.txt", "a") as file:
            print(json.dumps([status, sorted(set(unused) & set(sys.modules))]), file=file)
        os._exit(0)
    os.wait()
"""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory, device) -> Path:
    """A folder with a scene, a trajectory and a photo set with cameras."""
    folder = tmp_path_factory.mktemp("inputs")
    scene = two_balls_scene()
    near = (scene.gaussians.means[:, :2].abs() < 0.6).all(1)  # the balls and a third of the floor
    write_scene(folder / "scene.ply", replace(scene, gaussians=scene.gaussians[near]))
    simulate(folder / "scene.ply", folder / "traj.h5", SimulateOptions(steps=3, quality="draft", device=device))
    (folder / "set").mkdir()
    write_set(folder / "set", arc(4, (96, 72), sweep=40.0))
    return folder


@pytest.mark.parametrize("chosen", [COMMANDS, pytest.param(SLOW_COMMANDS, marks=pytest.mark.slow)])
def test_commands_do_not_import_what_they_do_not_use(inputs, device, chosen):
    commands = {command: sorted(UNUSED | extra) for command, extra in chosen.items()
                if find_spec("pycolmap") or not command.startswith("reconstruct")}  # fmt: skip
    rows = [(command.split() + ([] if command.startswith("evaluate") else ["--device", device]), unused)
            for command, unused in commands.items()]  # fmt: skip
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run([sys.executable, "-c", RUNNER, json.dumps(rows)], capture_output=True, text=True, cwd=inputs,
                          env={**os.environ, "PYTHONPATH": path})  # fmt: skip
    found = [json.loads(line) for line in (inputs / "found.txt").read_text().splitlines()]
    (inputs / "found.txt").unlink()
    assert dict(zip(commands, found, strict=True)) == {command: [0, []] for command in commands}, done.stderr


@pytest.mark.parametrize("script", ["ngff", "ngff_lab"])
@pytest.mark.parametrize("interrupted", ["builtins.__import__", "signal.signal"])
def test_an_interrupt_before_the_command_line_catches_it_ends_in_one_line(script, interrupted):
    """The interrupt occurs while the command line is imported, or directly after it."""
    code = f"""
import builtins, signal, sys
from ngff_cli import {script}
def interrupt(*_):
    raise KeyboardInterrupt
{interrupted} = interrupt
{script}()
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "ngff: interrupted\n")
