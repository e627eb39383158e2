"""Warp without its compiler for the CPU."""

import pytest
import torch

from stages.core.errors import MissingPackage
from stages.core.kernels import interop
from stages.core.kernels.skinning import skin_gaussians
from tests.core.kernels.test_skinning import random_inputs


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
