"""The contact sheet: one row per scene, in which motion is visible."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stages.core.errors import InputError
from stages.lab.dataset import contact_sheet, generate
from stages.lab.dataset.contact_sheet import SHEET_COLUMNS, SheetOptions, write_sheet
from tests.lab.small_world import OPTIONS, shrink

SIZE, CAPTION = 64, 20  # size of an image and height of its caption [px]


def test_one_row_per_scene_from_first_to_last_frame(tmp_path, monkeypatch):
    shrink(monkeypatch.setattr, monkeypatch.setitem)
    monkeypatch.setattr(contact_sheet, "IMAGE_SIZE", SIZE)
    with pytest.raises(InputError, match="contains none of 3_9"):
        write_sheet(tmp_path, tmp_path / "s.jpg", SheetOptions(groups=("3_9",), count=2))
    generate.run(tmp_path, replace(OPTIONS, groups="3_9,4", parts="motions", frames=20))
    write_sheet(tmp_path, tmp_path / "s.jpg", SheetOptions(groups=("3_9", "4"), count=2))
    sheet = cv2.imread(str(tmp_path / "s.jpg")).astype(float)
    assert sheet.shape == (2 * SIZE, SHEET_COLUMNS * SIZE, 3)
    cells = sheet.reshape(2, SIZE, SHEET_COLUMNS, SIZE, 3)[:, CAPTION:]
    change = [np.abs(cells[:, :, k] - cells[:, :, 0]).mean() for k in range(SHEET_COLUMNS)]
    assert change[1] > 0.2 and change[-1] > 2 * change[1]  # the objects fall
    assert np.abs(cells[0] - cells[1]).mean() > 5  # backgrounds and views differ


def test_row_count_is_checked():
    with pytest.raises(InputError, match="--scenes 0"):
        SheetOptions(groups=("3_9",), count=0)
