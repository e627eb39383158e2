"""Advice for known camera positions, and scale references."""

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import intrinsics, orbit
from stages.core.scene.cameras import Cameras
from stages.reconstruct.advice import advise, widest_gap
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.scale import parse_scale


def ring(count: int, sweep: float = 360.0, elevation: float = 30.0, azimuth: float = 0.0) -> Cameras:
    viewmats = orbit(count, torch.zeros(3), 2.0, elevation, azimuth=azimuth, sweep=sweep)
    sizes = torch.tensor([[64, 48]] * count)
    Ks = intrinsics(64, 48, 60.0).expand(count, 3, 3)
    return Cameras(viewmats, Ks, sizes, tuple(f"{i}.jpg" for i in range(count)))


def advice_for(cameras: Cameras, confirmed: float = 0.8, supported: bool = True, dropped=None, sharp=None) -> str:
    sharp = torch.ones(len(cameras)) if sharp is None else sharp
    return "\n".join(
        advise(cameras, torch.zeros(3), torch.full((len(cameras),), confirmed), sharp, supported, dropped or {})
    )


def test_no_advice_for_a_good_set():
    assert advice_for(ring(24)) == ""


def test_widest_gap_is_named_by_the_photos_at_its_ends():
    # 13 photos at intervals of 20 degrees span 240 degrees, with a gap from the last to the first
    cameras = ring(13, sweep=260.0)
    gap, before, after = widest_gap(cameras, torch.zeros(3))
    assert gap == pytest.approx(120, abs=0.1) and {before, after} == {"0.jpg", "12.jpg"}
    assert "120 degrees between" in advice_for(cameras) and "about 7 more photos" in advice_for(cameras)


def test_gap_across_azimuth_zero():
    cameras = ring(10, sweep=300.0, azimuth=100.0)  # at intervals of 30 degrees
    assert widest_gap(cameras, torch.zeros(3))[0] == pytest.approx(90, abs=0.1)


@pytest.mark.parametrize(("elevation", "words"), [(8.0, "from low down"), (70.0, "steeply down"), (35.0, "")])
def test_cameras_all_low_or_all_high(elevation, words):
    assert words in advice_for(ring(24, elevation=elevation))
    if not words:
        assert advice_for(ring(24, elevation=elevation)) == ""


def test_advice_for_few_blurred_inconsistent_and_unsupported_photos():
    assert "7 photos are few" in advice_for(ring(7))
    assert "no table or floor" in advice_for(ring(24), supported=False)
    assert "only 20 %" in advice_for(ring(24), confirmed=0.2) and "glass" in advice_for(ring(24), confirmed=0.2)
    sharp = torch.ones(24)
    sharp[3] = 0.1
    assert "blurred compared with the others: 3.jpg;" in advice_for(ring(24), sharp=sharp)


def test_dropped_photos_are_named_with_limits():
    text = advice_for(ring(24), dropped={"a.jpg": "is dark", **{f"{i:03d}.jpg": "is blank" for i in range(30)}})
    assert text.splitlines() == [
        "only 24 of 55 photos show enough of the same objects: take them closer together, each showing two thirds of "
        "what the one before it shows",
        "a.jpg was left out: it is dark",
        "000.jpg, 001.jpg, 002.jpg and 27 more were left out: each is blank",
    ]
    text = advice_for(ring(24), dropped={f"{i}.jpg": f"has {i} points in common" for i in range(8)})
    assert len(text.splitlines()) == 6 and "4.jpg was left out: it has 4" in text
    assert text.endswith("3 more photos were left out for similar reasons")


def test_scale_reference_between_two_cameras_or_to_the_focus():
    cameras = ring(4)  # at intervals of 90 degrees on a circle of radius 2 cos 30
    known = parse_scale("photos=0.jpg,1.jpg distance=0.5")
    assert known.in_scene_units(cameras, 2.0) == pytest.approx(2 * 3**0.5 / 2 * 2**0.5, rel=1e-5)
    assert parse_scale("distance=0.6").in_scene_units(cameras, 2.0) == 2.0
    assert parse_scale("photos=IMG 1.jpg,IMG 2.jpg distance=1e-1").photos == ("IMG 1.jpg", "IMG 2.jpg")
    assert parse_scale("") is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("object=1 height=0.12", "not known before segmentation"),
        ("distance=far", "in metres"),
        ("distance=-1", "more than 0"),
        ("photos=a.jpg distance=1", "in metres"),
        ("0.5", "in metres"),
    ],
)
def test_invalid_scale_references(text, words):
    with pytest.raises(InputError, match=words):
        ReconstructOptions(scale_reference=text)


def test_photos_of_a_scale_reference_must_have_distinct_cameras():
    cameras = ring(4)
    with pytest.raises(InputError, match="the scene has no camera of 9.jpg"):
        parse_scale("photos=0.jpg,9.jpg distance=1").in_scene_units(cameras, 2.0)
    with pytest.raises(InputError, match="nearly the same position"):
        parse_scale("photos=0.jpg,0.jpg distance=1").in_scene_units(cameras, 2.0)
