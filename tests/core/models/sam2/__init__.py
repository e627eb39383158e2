"""All of these need the package transformers, which is optional."""

import pytest

pytest.importorskip("transformers")
