"""Runs every test of this folder on each device."""

import pytest

from stages.render.options import RenderOptions


@pytest.fixture(autouse=True)
def on_each_device(device):
    """Runs the tests on each device; `render_options` leave --device at auto, which is the device of the test."""


def render_options(**choices) -> RenderOptions:
    """Options for small images without shadows, because the search for the light takes half a second."""
    return RenderOptions(**{"resolution": 96, "shadows": "off", **choices})
