"""`--device cuda:1` does not use GPU 0."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch

from stages.core.backends import pick_device
from stages.simulate.options import QUALITIES, MpmQuality, SimulateOptions
from stages.simulate.solid_bodies import solid_bodies
from tests.conftest import two_balls_scene
from tests.simulate.motion import roll_out

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two NVIDIA GPUs"),
]


@contextmanager
def gpu_0_unused() -> Iterator[None]:
    """Assert that PyTorch does not allocate memory on GPU 0 within the context."""
    torch.cuda.init()  # statistics exist only after initialisation
    torch.cuda.reset_peak_memory_stats(0)
    before = torch.cuda.memory_allocated(0)
    try:
        yield
        assert torch.cuda.max_memory_allocated(0) == before
    finally:
        torch.cuda.set_device(0)


def test_solid_bodies():
    with gpu_0_unused():
        torch.cuda.reset_peak_memory_stats(1)
        found = solid_bodies(two_balls_scene(), 0.01, pick_device("cuda:1"))
        assert torch.cuda.max_memory_allocated(1) > torch.cuda.memory_allocated(1)
    for body, expected in zip(found, solid_bodies(two_balls_scene(), 0.01, "cpu"), strict=True):
        torch.testing.assert_close(body.inertia, expected.inertia, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("engine", ["ngff", "mpm"])
def test_motion_is_that_of_the_first_gpu(engine, monkeypatch):
    monkeypatch.setitem(QUALITIES, "draft", MpmQuality(particles=800, step=0.014))
    options = {"engine": engine, "steps": 4, "keypoints": 32, "quality": "draft"}
    with gpu_0_unused():
        second = roll_out(two_balls_scene(), SimulateOptions(**options, device=pick_device("cuda:1")))
    first = roll_out(two_balls_scene(), SimulateOptions(**options, device="cuda:0"))
    torch.testing.assert_close(second.positions, first.positions, rtol=0, atol=1e-5)
