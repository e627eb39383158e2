"""What each command imports from start to end: packages that it does not use would add seconds to short runs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stages.core.scene.scene_ply import write_scene
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run as simulate
from tests.conftest import two_balls_scene
from tests.reconstruct.raycast import arc, write_set

ROOT = Path(__file__).resolve().parents[2]
# no command compiles with PyTorch (`import torch` itself imports torch.distributed, but not these) or solves ODEs;
# gsplat is for comparisons
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
    "render scene.ply --resolution 32 -o out.png": {"pycolmap", "scipy"},
    "evaluate traj.h5 --against traj.h5 -o out.json": {"cv2", "pycolmap", "scipy", "warp"},
    "evaluate scene.ply --against scene.ply -o out.json": {"cv2", "h5py", "pycolmap", "warp"},
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory, device) -> Path:
    """A folder with a scene, a trajectory and a photo set with cameras."""
    folder = tmp_path_factory.mktemp("inputs")
    write_scene(folder / "scene.ply", two_balls_scene())
    simulate(folder / "scene.ply", folder / "traj.h5", SimulateOptions(steps=3, quality="draft", device=device))
    (folder / "set").mkdir()
    write_set(folder / "set", arc(4, (96, 72), sweep=40.0))
    return folder


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.split(" -")[0].replace(" ", "-"))
def test_commands_do_not_import_what_they_do_not_use(command, inputs, device):
    if command.startswith("reconstruct"):
        pytest.importorskip("pycolmap")
    words = command.split() + ([] if command.startswith("evaluate") else ["--device", device])
    code = f"import sys; sys.argv = {['ngff', *words]!r}\nimport ngff_cli.app as a\n"
    code += "try:\n a.main()\nexcept SystemExit as ended: status = ended.code\n"
    code += f"print(status, sorted({UNUSED | COMMANDS[command]!r} & set(sys.modules)))"
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=inputs,
                          env={**os.environ, "PYTHONPATH": path})  # fmt: skip
    assert done.returncode == 0 and done.stdout.splitlines()[-1] == "0 []", done.stdout + done.stderr
