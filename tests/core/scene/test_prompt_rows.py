"""The prompts in a traj.h5 are checked when read, so that all code can rely on their fields."""

import math
import re

import pytest

from stages.core.scene.prompt_rows import read_prompts

FORCE = {"kind": "force", "object_id": 2, "force": [0, 0, 8], "start": 0.1, "end": None}
CHANGE = {"kind": "change", "what": "gravity", "value": 1.6, "start": 0.5, "object_id": None}


def test_fields_that_may_be_left_out_are_added():
    (row,) = read_prompts([{k: v for k, v in FORCE.items() if k != "kind"}], [2])
    assert row == {**FORCE, "force": (0.0, 0.0, 8.0), "torque": (0.0, 0.0, 0.0), "at": None}
    assert read_prompts([CHANGE]) == (CHANGE,)


@pytest.mark.parametrize(("row", "message"), [
    ([], "none of the kinds"), ({"kind": "spell"}, "none of the kinds"), ({"kind": ["force"]}, "none of the kinds"),
    ({**FORCE, "force": "012"}, "force of a force is '012', not 3 numbers"),
    ({**FORCE, "force": [0, 0, math.inf]}, "not a number"), ({**FORCE, "start": "0"}, "start of a force is '0'"),
    ({**FORCE, "end": 0.1}, "a force from 0.1 s to 0.1 s"), ({**FORCE, "start": -1}, "start"),
    ({**FORCE, "object_id": 3}, "acts on object 3, which is not among the objects"),
    ({**FORCE, "object_id": 1.5}, "not a whole number"), ({"kind": "pin"}, "a prompt of kind pin has no object_id"),
    ({"kind": "lift", "object_id": 2, "height": "nan"}, "height"), ({**CHANGE, "what": "colour"}, "a change of colour"),
    ({**CHANGE, "value": "1.6"}, "gravity is '1.6'"), ({**CHANGE, "object_id": 2}, "that is of one object"),
    ({**CHANGE, "what": "pinned", "value": True}, "that is not of one object"),
    ({**CHANGE, "what": "pinned", "value": 1, "object_id": 2}, "not true or false"),
])  # fmt: skip
def test_others_are_refused(row, message):
    with pytest.raises(ValueError, match=message):
        read_prompts([row], [2])


LIMITS = [  # a row, the field of the value, and the minimum and maximum of the value
    (FORCE, "start", 0, 1e9), (FORCE, "object_id", 1, 65535), ({**CHANGE, "what": "friction"}, "value", 0, 100),
    (CHANGE, "value", -1e9, 1e9), ({"kind": "lift", "object_id": 2, "height": 0}, "height", -1e9, 1e9),
    (CHANGE, "start", 0, 1e9), ({"kind": "pin"}, "object_id", 1, 65535),
]  # fmt: skip


@pytest.mark.parametrize(("row", "field", "low", "high"), LIMITS)
def test_values_up_to_the_limits_are_read_and_no_others(row, field, low, high):
    for value in (low, high):
        assert read_prompts([{**row, field: value}])[0][field] == value
    for value in (low - 1, high + 1):
        with pytest.raises(ValueError, match=re.escape(f"not a number from {low:g} to {high:g}")):
            read_prompts([{**row, field: value}])
