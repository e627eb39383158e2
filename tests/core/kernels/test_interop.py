"""Kernel structs made from tensors, and Warp without its CPU compiler."""

import os
import subprocess
import sys

import pytest
import torch
import warp as wp

from stages.core.errors import MissingPackage
from stages.core.kernels import interop
from stages.core.kernels.skinning import skin_gaussians
from tests.core.kernels.test_skinning import random_inputs


@wp.struct
class Points:
    at: wp.array2d[wp.vec3]
    owner: wp.array[int]


@wp.struct
class Cloud:
    points: Points


@wp.kernel(enable_backward=False)
def _first_of_owner(cloud: Cloud, first: wp.array[wp.vec3]):
    i = wp.tid()
    first[i] = cloud.points.at[cloud.points.owner[i], 0]


def test_kernels_read_tensors_that_are_not_contiguous_and_long_integers_in_nested_structs(device):
    cloud, at = Cloud(), torch.arange(24.0, device=device).view(2, 4, 3).transpose(0, 1)
    owner, first = torch.tensor([2, 0, 3], device=device), torch.zeros(3, 3, device=device)
    interop.with_arrays(cloud.points, {"at": at, "owner": owner})
    inputs = [cloud, interop.view(first, wp.vec3)]
    interop.launch(_first_of_owner, 3, inputs, device=interop.device_of(first))
    assert torch.equal(first, at[owner, 0])


@pytest.mark.parametrize(
    ("tensors", "message"),
    [({"at": torch.zeros(5, 3)}, "at has 1 dim"), ({"at": torch.zeros(5, 3, 2)}, "shape"),
     ({"owner": torch.zeros(5)}, "owner: Cannot convert")],
)  # fmt: skip
def test_tensors_that_do_not_match_a_field_are_errors(tensors, message):
    with pytest.raises(TypeError, match=message):
        interop.with_arrays(Points(), tensors)


def test_a_struct_of_tensors_is_not_copied_into_another_without_its_arrays():
    points = interop.with_arrays(Points(), {"owner": torch.zeros(3, dtype=torch.int32)})
    with pytest.raises(TypeError, match="owner"):
        Cloud().points = points


def test_missing_compiler_is_reported_by_every_kernel_on_the_cpu(monkeypatch):
    monkeypatch.setattr(interop, "compiles_for_cpu", lambda: False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for work in (lambda: interop.view(torch.zeros(3)), lambda: skin_gaussians(*random_inputs("cpu"))):
        with pytest.raises(MissingPackage, match="pip install --force-reinstall warp-lang"):
            work()


@pytest.mark.gpu
def test_without_a_compiler_cpu_tensors_are_skinned_on_the_gpu(monkeypatch):
    expected = skin_gaussians(*random_inputs("cuda"))
    monkeypatch.setattr(interop, "compiles_for_cpu", lambda: False)
    for ours, theirs in zip(skin_gaussians(*random_inputs("cpu")), expected, strict=True):
        assert ours.device.type == "cpu" and torch.equal(ours, theirs.cpu())


def test_without_a_home_kernels_are_compiled_in_a_temporary_folder(tmp_path):
    (tmp_path / "file").touch()
    code = ("import warp as wp; from stages.core.kernels import interop; interop.compiles_for_cpu();"
            "print(wp.config.kernel_cache_dir)")  # fmt: skip
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "file"), "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.startswith(str(tmp_path / "ngff-kernels-")) and "set $WARP_CACHE_PATH" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
