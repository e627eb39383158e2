"""The stages neither depend on PyTorch's global state nor change it."""

import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.scene.scene_ply import write_scene
from stages.core.torch_state import standard_torch
from stages.evaluate.stage import run as evaluate
from stages.reconstruct.stage import run as reconstruct
from stages.refine.stage import run as refine
from stages.render.stage import run as render
from stages.segment.stage import run as segment
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run as simulate
from tests.conftest import two_balls_scene


@pytest.fixture
def unusual():
    """PyTorch as a caller may have set it: float64 on another device."""
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    yield
    torch.set_default_device(None)
    torch.set_default_dtype(torch.float32)


def test_state_is_standard_inside_and_restored_after_an_error(unusual):
    state = torch.random.get_rng_state()
    with torch.inference_mode(), pytest.raises(InputError), standard_torch():
        made = torch.zeros(1, requires_grad=True)
        assert (made.dtype, made.device.type) == (torch.float32, "cpu") and not made.is_inference()
        (2 * made).sum().backward()
        torch.rand(3)
        raise InputError("x")
    made = torch.zeros(1)
    assert (made.dtype, made.device.type) == (torch.float64, "meta")
    assert torch.equal(state, torch.random.get_rng_state())


@pytest.mark.parametrize("run", [reconstruct, segment, refine, simulate, render, evaluate])
def test_every_stage_has_it(run):
    assert run.__wrapped__.__name__ == "run"


def test_simulations_are_the_same_in_any_state(tmp_path, request):
    write_scene(tmp_path / "scene.ply", two_balls_scene())
    options = SimulateOptions(steps=2, engine="ngff", contact="learned", keypoints=16)
    simulate(tmp_path / "scene.ply", tmp_path / "a.h5", options)
    request.getfixturevalue("unusual")
    before = np.random.get_state()[1].copy()
    simulate(tmp_path / "scene.ply", tmp_path / "b.h5", options)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert np.array_equal(before, np.random.get_state()[1])
