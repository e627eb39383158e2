"""Features of photos on a full disk."""

from types import SimpleNamespace

import numpy as np
import pytest

from stages.core.errors import InputError
from stages.reconstruct import features


def test_a_disk_without_space_for_features_is_one_sentence(monkeypatch):
    """COLMAP aborts the process if it cannot write, so the space is checked before."""
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(features.shutil, "disk_usage", lambda folder: SimpleNamespace(free=10_000))
    with pytest.raises(InputError, match="MB free.*TMPDIR"):
        features._sift([np.zeros((100, 100), np.uint8)])


def test_errors_of_colmap_in_writing_name_the_folder(tmp_path):
    with pytest.raises(InputError, match="COLMAP cannot write"), features.writing_database(tmp_path):
        raise RuntimeError("No registered database factory succeeded.")


def test_a_path_that_is_too_long_for_a_database_is_refused(tmp_path):
    folder = tmp_path / ("d" * 200) / ("e" * 240)
    with pytest.raises(InputError, match="has [0-9]+ bytes, .* a shorter path"), features.writing_database(folder):
        pass
