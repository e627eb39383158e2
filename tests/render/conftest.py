"""Runs every test of this folder on each device present: the CPU and, if there is one, a GPU."""

import pytest

from stages.render.options import RenderOptions
from tests.conftest import DEVICES

_current = {"device": "cpu"}


@pytest.fixture(params=DEVICES, autouse=True)
def render_device(request):
    """The device that `render_options` selects during a test."""
    _current["device"] = request.param
    return request.param


def render_options(**choices) -> RenderOptions:
    """Options for small images, on the device of the test."""
    return RenderOptions(**{"resolution": 96, **_current, **choices})
