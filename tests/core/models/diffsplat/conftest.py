"""One tiny model for all tests of this folder, saved and loaded like the published one."""

import pytest

pytest.importorskip("diffusers", reason="needs the extra diffsplat")
pytest.importorskip("transformers", reason="needs the extra diffsplat")


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    from tests.core.models.diffsplat.tiny_model import save_tiny_model

    return save_tiny_model(tmp_path_factory.mktemp("weights") / "diffsplat")


@pytest.fixture(scope="module")
def model(folder, device):
    from stages.core.models.diffsplat.weights import find, load

    return load(find(folder), device)
