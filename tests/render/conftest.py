"""Every test of this folder runs on the CPU and, where there is one, on a GPU."""

import pytest

from stages.render.options import RenderOptions
from tests.conftest import DEVICES

_current = {"device": "cpu"}


@pytest.fixture(params=DEVICES, autouse=True)
def render_device(request):
    """The device that `render_options` asks for during a test."""
    _current["device"] = request.param
    return request.param


def render_options(**choices) -> RenderOptions:
    """Small pictures, on the device of the test."""
    return RenderOptions(**{"resolution": 96, **_current, **choices})
