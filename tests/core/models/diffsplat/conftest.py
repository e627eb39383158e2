"""One tiny model for all tests of this folder, saved and loaded like the published one."""

from importlib.util import find_spec

import pytest

# find_spec instead of an import, which would take seconds in every worker that collects these tests
if not (find_spec("diffusers") and find_spec("transformers")):
    pytest.skip("needs the extra diffsplat", allow_module_level=True)


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    from tests.core.models.diffsplat.tiny_model import save_tiny_model

    return save_tiny_model(tmp_path_factory.mktemp("weights") / "diffsplat")


@pytest.fixture(scope="module")
def model(folder, device):
    from stages.core.models.diffsplat.weights import find, load

    return load(find(folder), device)
