"""Options of `ngff segment`: limits of values, and options that exclude each other."""

from functools import partial
from pathlib import Path

import pytest

from stages.core.errors import InputError
from stages.segment.options import SegmentOptions
from tests.limits import check_limits

SOME = Path("some")


@pytest.mark.parametrize(("name", "accepted", "refused"), [
    ("max_objects", (1, 100), (0,)), ("min_size", (0.001, 0.999), (0.0, 1.0)), ("detail", (0.001, 1.999), (0.0, 2.0)),
    ("scale_reference", ("", "object=1 height=0.12"), ("object=1", "object=1 height=0")),
    ("names", ("", "1=duck", "65535=a, 007=b b,"), ("duck", "0=a", "1=", "1 2=a", "x=a", "123456=a")),
])  # fmt: skip
def test_limits_of_options(name, accepted, refused):
    check_limits(partial(SegmentOptions, backend="geometric"), name, accepted, refused)


def test_names_by_number():
    assert SegmentOptions(names=" 2 = rubber duck ,1=a=b,").renamed == {2: "rubber duck", 1: "a=b"}


@pytest.mark.parametrize(("options", "message"), [
    ({"masks": SOME, "boxes": SOME}, "give only one of them"),
    ({"masks": SOME, "points": ("a",)}, "give only one of them"),
    ({"boxes": SOME, "points": ("a",)}, "give only one of them"),
    ({"backend": "sam2", "masks": SOME}, "--backend sam2 generates masks itself"),
    ({"backend": "sam2", "points": ("a",)}, "--backend sam2 generates masks itself"),
    ({"photos": SOME}, "--photos and --download only work with --backend sam2"),
    ({"download": True}, "--photos and --download only work"),
    ({"backend": "geometric", "weights": SOME}, "--weights only works with --backend sam2 or learned"),
    ({"undistorted": True}, "--undistorted: only applies to"),
    ({"detail": 0.3}, "--detail: only works with --backend geometric"),
    ({"backend": "geometric", "detail": 0.3, "points": ("a",)}, "--points selects its own backend"),
])  # fmt: skip
def test_options_that_exclude_each_other(options, message):
    with pytest.raises(InputError, match=message):
        SegmentOptions(**options)


@pytest.mark.parametrize(("options", "chosen"), [
    ({}, "learned"), ({"backend": "geometric"}, "geometric"), ({"masks": SOME}, "masks"), ({"boxes": SOME}, "boxes"),
    ({"points": ("a",)}, "points"), ({"backend": "sam2", "boxes": SOME, "undistorted": True}, "sam2"),
    ({"backend": "sam2", "photos": SOME, "undistorted": True, "download": True, "weights": SOME}, "sam2"),
    ({"masks": SOME, "undistorted": True, "weights": SOME}, "masks"), ({"weights": SOME}, "learned"),
    ({"points": ("a",), "undistorted": True}, "points"),
])  # fmt: skip
def test_prompts_select_their_backend_unless_a_network_is_given(options, chosen):
    assert SegmentOptions(**options).chosen == chosen
