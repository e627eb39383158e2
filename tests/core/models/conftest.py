"""These tests run on one thread: their tensors are too small for more to help."""

import pytest


@pytest.fixture(autouse=True)
def _one_thread(one_thread):
    """Applies the fixture to every test of the folder."""


@pytest.fixture
def empty_weight_folders(monkeypatch, tmp_path):
    """Where weights are searched: weights/ and cache/ngff/ of the test's folder, which do not exist."""
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
