"""The HTML report: axes, curves, images and table, compared with values computed by hand."""

import base64
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from stages.evaluate.label_pictures import RED, LabelColours
from stages.evaluate.report import _round_up, write_report
from stages.evaluate.result import Curve, Pictures, Result

RIGHT, TOP, FLOOR, LEFT = 710, 16, 244, 60  # edges of the plot area [px]


def page(folder: Path, curves: list[Curve] = (), **fields) -> str:
    result = Result("pictures", {"PSNR": 1.5}, {}, [], list(curves), "PSNR [dB]", **fields)
    write_report(folder / "r.html", result, Path("mine"), Path("true"))
    return (folder / "r.html").read_text()


def lines(html: str) -> list[list[tuple[float, float]]]:
    """The points of each curve."""
    return [[tuple(map(float, corner.split(","))) for corner in points.split()]
            for points in re.findall(r'<polyline points="([^"]*)"', html)]  # fmt: skip


def labels(html: str, anchor: str) -> list[tuple[float, float, str]]:
    """Positions (x, y) and texts of the labels of an axis."""
    found = re.findall(rf'<text x="([\d.]+)" y="([\d.]+)" text-anchor="{anchor}">([^<]*)</text>', html)
    return [(float(x), float(y), text) for x, y, text in found]


def test_curves_fill_the_frame_and_axes_have_round_ends(tmp_path):
    html = page(tmp_path, [Curve("a", [0.0, 1.0, 2.0, 3.0, 4.0]), Curve("SSIM", [9.0] * 5)], fps=2.0)
    (corners,) = lines(html)  # SSIM has a different unit
    heights = [FLOOR - v / 5 * (FLOOR - TOP) for v in range(5)]  # the axis ends at the next 1, 2 or 5
    assert corners == [pytest.approx((LEFT + i * (RIGHT - LEFT) / 4, y), abs=0.05) for i, y in enumerate(heights)]
    across = labels(html, "middle")
    assert [text for *_, text in across] == ["0 s", "0.5 s", "1 s", "1.5 s", "2 s"]  # 5 frames at 2 per second
    assert [x for x, *_ in across] == pytest.approx([LEFT + i * (RIGHT - LEFT) / 4 for i in range(5)], abs=0.05)
    up = labels(html, "end")
    assert [text for *_, text in up] == ["0", "2.5", "5"] and all(x < LEFT for x, *_ in up)
    assert [y for _, y, _ in up] == pytest.approx([FLOOR + 4, (FLOOR + TOP) / 2 + 4, TOP + 4], abs=0.05)
    levels = [float(y) for y in re.findall(r'y1="([\d.]+)" y2="\1" stroke="#ddd"', html)]
    assert levels == pytest.approx([FLOOR, (FLOOR + TOP) / 2, TOP])


def test_frames_without_a_time_are_numbered_and_gaps_are_left_out(tmp_path):
    html = page(tmp_path, [Curve("a", [1.0, math.nan, 2.0, math.inf, 1.0])])
    assert [text for *_, text in labels(html, "middle")] == ["0", "1", "2", "3", "4"]
    assert lines(html) == [[(LEFT, pytest.approx((FLOOR + TOP) / 2)), ((LEFT + RIGHT) / 2, TOP), (RIGHT, 130.0)]]
    assert not lines(page(tmp_path, [Curve("a", [1.0])])) and not lines(page(tmp_path))  # a point is not a curve


@pytest.mark.parametrize(("highest", "end"), [(0.0, "1"), (0.3, "0.5"), (1.0, "1"), (1.1, "2"), (7.0, "10")])
def test_the_axis_ends_at_the_next_1_2_or_5(tmp_path, highest, end):
    assert labels(page(tmp_path, [Curve("a", [0.0, highest])]), "end")[-1][2] == end


def test_curves_have_different_colours_and_are_named_in_them(tmp_path):
    html = page(tmp_path, [Curve(f"curve {i}", [0.0, 1.0]) for i in range(10)])
    named = re.findall(r'<span style="color:(#\w+)">&#9632; (curve \d)</span>', html)
    assert [name for _, name in named] == [f"curve {i}" for i in range(10)]
    drawn = re.findall(r'stroke="(#\w+)" stroke-width="2"', html)
    assert drawn == [colour for colour, _ in named] and len(set(drawn)) == 8 and drawn[8:] == drawn[:2]


def test_pictures_are_side_by_side_and_large_ones_reduced(tmp_path):
    wide, small = torch.zeros(420, 840, 3), torch.zeros(20, 30, 3)
    wide[:, :420], small[..., 2] = 1.0, 1.0
    html = page(tmp_path, pictures=[Pictures("two", {"a": wide, "b": small})], legend={"duck": (1.0, 0.5, 0.0)})
    found = [cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
             for data in re.findall(r"base64,([^\"]*)", html)]  # fmt: skip
    assert [image.shape for image in found] == [(210, 420, 3), (20, 30, 3)]
    assert found[0][:, :209].min() == 255 and found[0][:, 211:].max() == 0 and found[1][0, 0].tolist() == [255, 0, 0]
    assert re.findall(r'alt="(\w)" style="max-width:(\d+)%"', html) == [("a", "49"), ("b", "49")]
    assert 'rgb(255,128,0)">&#9632;</span> duck' in html and "a, b; two" in html


def test_the_title_names_both_files_and_markup_in_names_is_text(tmp_path):
    curves = [Curve("<b>", [0.0, 1.0])]
    html = page(tmp_path, curves, pictures=[Pictures("<i>", {"<s>": torch.zeros(2, 2, 3)})], legend={"<u>": (0, 0, 0)})
    assert "<h1>mine against true</h1>" in html and "<title>mine against true</title>" in html
    assert not any(tag in html for tag in ("<b>", "<i>", "<s>", "<u>"))


@pytest.mark.parametrize(("value", "top"), [(0.0, 1.0), (-1.0, 1.0), (1.0, 1.0), (1.01, 2.0), (2.0, 2.0), (3.0, 5.0),
                                            (5.1, 10.0), (0.037, 0.05), (1234.0, 2000.0)])  # fmt: skip
def test_axes_end_at_the_next_1_2_or_5_times_a_power_of_ten(value, top):
    assert _round_up(value) == pytest.approx(top)


def test_objects_have_colours_that_differ_and_are_not_that_of_false_ones():
    colours = torch.tensor(list(LabelColours.of(dict.fromkeys(range(12), 1.0), {}).truth.values()))
    assert colours.min() >= 0 and colours.max() == 1 and colours.unique(dim=0).shape == (12, 3)
    distance = torch.cdist(colours, colours) + 9 * torch.eye(12)
    pale = colours.amin(1) > 0  # every other colour is mixed with white
    assert pale.tolist() == 6 * [True, False]
    assert distance.min() > 0.05 and distance.diagonal(1).min() > 0.5  # neighbours differ clearly
    assert (colours - torch.tensor(RED)).norm(dim=1).min() > 0.2
    of = LabelColours.of({5: 1.0, 7: 1.0}, {7: 3})
    assert of.found == {3: of.truth[7]} and of.truth[5] != of.truth[7]
