"""The picture of scenes: a row each, and what moves is seen to move."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stages.core.errors import InputError
from stages.lab.dataset import contact_sheet, generate
from stages.lab.dataset.contact_sheet import SHEET_COLUMNS, SheetOptions, write_sheet
from tests.lab.small_world import OPTIONS, shrink


def test_a_row_a_scene_from_start_to_end(tmp_path, monkeypatch):
    shrink(monkeypatch.setattr, monkeypatch.setitem)
    monkeypatch.setattr(contact_sheet, "IMAGE_SIZE", 64)
    with pytest.raises(InputError, match="has none of 3_9"):
        write_sheet(tmp_path, tmp_path / "s.jpg", SheetOptions(("3_9",), 2, "cpu"))
    generate.run(tmp_path, replace(OPTIONS, only="motions", frames=20))
    write_sheet(tmp_path, tmp_path / "s.jpg", SheetOptions(("3_9", "4"), 2, "cpu"))
    sheet = cv2.imread(str(tmp_path / "s.jpg")).astype(float)
    assert sheet.shape == (2 * 64, SHEET_COLUMNS * 64, 3)
    cells = sheet.reshape(2, 64, SHEET_COLUMNS, 64, 3)[:, 20:]  # below the captions
    change = [np.abs(cells[:, :, k] - cells[:, :, 0]).mean() for k in range(SHEET_COLUMNS)]
    assert change[1] > 0.2 and change[-1] > 2 * change[1]  # they fall, and farther
    assert np.abs(cells[0] - cells[1]).mean() > 5  # other tables, other sides
    with pytest.raises(InputError, match="--scenes 0"):
        SheetOptions(("3_9",), 0)
