"""Tests of SAM 2.1; they need the optional package transformers."""

import pytest

pytest.importorskip("transformers")
