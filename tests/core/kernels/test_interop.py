"""Warp without its compiler for the CPU."""

import pytest
import torch

from stages.core.errors import MissingPackage
from stages.core.kernels import interop
from stages.core.kernels.skinning import skin_gaussians
from tests.core.kernels.test_skinning import random_inputs


def test_missing_compiler_is_reported_by_every_kernel_on_the_cpu(monkeypatch):
    monkeypatch.setattr(interop, "compiles_for_cpu", lambda: False)
    for work in (lambda: interop.view(torch.zeros(3)), lambda: skin_gaussians(*random_inputs("cpu"))):
        with pytest.raises(MissingPackage, match="pip install --force-reinstall warp-lang"):
            work()
