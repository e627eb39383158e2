"""These tests run on one thread: their tensors are too small for more to help."""

import pytest


@pytest.fixture(autouse=True)
def _one_thread(one_thread):
    """Applies the fixture to every test of the folder."""
