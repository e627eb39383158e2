"""Types and limits of option fields when Python sets them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.options import check_types, device_option, option, seed_option
from stages.evaluate.options import EvaluateOptions
from stages.reconstruct.options import ReconstructOptions
from stages.refine.options import RefineOptions
from stages.render.options import RenderOptions
from stages.segment.options import SegmentOptions
from stages.simulate.options import SimulateOptions


@dataclass(frozen=True)
class Options:
    """One field of each type."""

    steps: int = option(1, "")
    frame: int | None = option(None, "")
    dt: float = option(0.1, "")
    rest: bool = option(True, "")
    view: str = option("novel", "")
    background: str | None = option(None, "")
    cameras: Path | None = option(None, "")
    lift: tuple[str, ...] = option((), "")
    seed: int = seed_option()
    device: str = device_option()
    inner: object = None  # of Python alone

    def __post_init__(self):
        check_types(self)


@pytest.mark.parametrize(
    ("field", "given", "expected"),
    [("steps", 3.0, 3), ("steps", np.int64(3), 3), ("steps", torch.tensor(3), 3), ("frame", None, None),
     ("frame", np.int32(-1), -1), ("dt", 1, 1.0), ("dt", np.float32(0.5), 0.5), ("rest", np.bool_(False), False),
     ("background", Path("a/b.jpg"), "a/b.jpg"), ("cameras", "a/b.json", Path("a/b.json")),
     ("lift", ["1=0.3", 0.25], ("1=0.3", "0.25")), ("lift", "1=0.3", ("1=0.3",)), ("lift", 2, ("2",)),
     ("device", torch.device("cuda", 1), "cuda:1"), ("inner", [1], [1])],
)  # fmt: skip
def test_values_that_mean_the_same_are_converted(field, given, expected):
    value = getattr(Options(**{field: given}), field)
    assert value == expected and type(value) is type(expected)


@pytest.mark.parametrize(
    ("field", "given", "message"),
    [("steps", "3", "--steps '3': give a whole number"), ("steps", 2.5, "--steps 2.5: give a whole"),
     ("steps", None, "--steps None: give a whole"), ("dt", "0.1", "--dt '0.1': give a number"),
     ("dt", float("nan"), "--dt nan: give a number"), ("rest", "no", "--rest 'no': give True or False"),
     ("view", None, "--view None: give text"), ("cameras", {"frames": []}, "--cameras {'frames': ..}: give a path"),
     ("lift", [("1", 0.3)], r"--lift .'1', 0.3.: give text"), ("seed", -1, "--seed -1: give 0 to 2147483647"),
     ("seed", 2**40, "give 0 to 2147483647")],
)  # fmt: skip
def test_other_values_are_refused_by_name(field, given, message):
    with pytest.raises(InputError, match=message):
        Options(**{field: given})


@pytest.mark.parametrize(
    "cls", [ReconstructOptions, SegmentOptions, RefineOptions, SimulateOptions, RenderOptions, EvaluateOptions]
)
def test_every_stage_checks_its_options(cls):
    field = "repeats" if cls is EvaluateOptions else "device"
    with pytest.raises(InputError, match=f"--{field} {{}}: give "):
        cls(**{field: {}})
