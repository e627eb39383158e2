"""Runs these tests on one thread, because their tensors are too small to benefit from more."""

import pytest


@pytest.fixture(autouse=True)
def _one_thread(one_thread):
    """Applies the fixture to every test of the folder."""


@pytest.fixture
def empty_weight_folders(monkeypatch, tmp_path):
    """Search for weights in weights/ and cache/ngff/ of the test's folder, which do not exist."""
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
