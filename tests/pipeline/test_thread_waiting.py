"""Threads wait passively, and NumPy uses one: variables for this are set before importing libraries that read them."""

import json
import os
import subprocess
import sys

import pytest

from tests.pipeline.test_commands import ROOT

VARIABLES = {"OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1"}
RECORDER = """
import json, os, sys

class Recorder:
    def find_spec(name, path, target=None):
        if name in ("torch", "numpy"):
            print(json.dumps({v: os.environ.get(v) for v in VARIABLES}), flush=True)
            os._exit(0)

sys.meta_path.insert(0, Recorder)
"""


def environment_at_import(statement: str, **given: str) -> dict[str, str | None]:
    """Values of VARIABLES when a new process begins to import PyTorch or NumPy."""
    code = f"VARIABLES = {list(VARIABLES)}{RECORDER}{statement}"
    env = {name: value for name, value in os.environ.items() if name not in VARIABLES} | given
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=env, check=True)
    return json.loads(done.stdout)


@pytest.mark.parametrize("statement", ["import stages.core.scene.gaussians", "import ngff_cli.app, torch"],
                         ids=["library", "command line"])  # fmt: skip
def test_they_are_set_before_the_libraries_are_imported(statement):
    assert environment_at_import(statement) == VARIABLES


def test_a_policy_set_by_the_user_is_kept():
    seen = environment_at_import("import stages.core.scene.gaussians", OMP_WAIT_POLICY="ACTIVE")
    assert seen["OMP_WAIT_POLICY"] == "ACTIVE"
