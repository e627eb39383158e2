"""Parsing of force prompts."""

import json
import math

import pytest

from stages.core.errors import InputError
from stages.core.physics import forces
from stages.core.physics.forces import Change, Force, ForcePrompts, number, parse, read_forces
from stages.core.physics.recording import read_prompts_file
from stages.core.scene.scene import SceneObject

OBJECTS = (SceneObject(1, "duck"), SceneObject(2, "phone"))


def test_force():
    (f,) = parse(OBJECTS, force=["object=2 force=0,0,8 from=0.1 to=0.3"]).forces
    assert f == Force(2, (0.0, 0.0, 8.0), (0.0, 0.0, 0.0), 0.1, 0.3, None)


def test_torque_and_point_by_name_without_times():
    (f,) = parse(OBJECTS, force=["object=duck torque=1,0,0 force=0,-2,0 at=0.1,0,.5"]).forces
    assert f == Force(1, (0.0, -2.0, 0.0), (1.0, 0.0, 0.0), 0.0, math.inf, (0.1, 0.0, 0.5))
    assert ForcePrompts((f,)).as_dicts()[0]["end"] is None  # JSON has no infinity


@pytest.mark.parametrize("start, end, fraction", [
    (0.0, 0.02, 0), (0.08, 0.12, 0.5), (0.2, 0.22, 1), (0.29, 0.33, 0.25),
])  # fmt: skip
def test_active_fraction(start, end, fraction):
    assert Force(1, start=0.1, end=0.3).active_fraction(start, end) == pytest.approx(fraction)


def test_pin_velocity_and_lift():
    p = parse(OBJECTS, pin=["phone"], velocity=["object=1 0,0,2"], lift=["0.3", "2=0.5"])
    assert p.pinned == {2} and p.velocity == {1: (0.0, 0.0, 2.0)} and p.lift == {1: 0.3, 2: 0.5}
    assert p and not parse(OBJECTS)
    assert [row["kind"] for row in p.as_dicts()] == ["pin", "velocity", "lift", "lift"]
    json.dumps(p.as_dicts())


def test_lifts_of_named_objects_count_before_that_of_all():
    assert parse(OBJECTS, lift=["2=0.5", "0.3"]).lift == {1: 0.3, 2: 0.5}


def test_the_file_format_of_ngff_counts_objects_from_0(tmp_path):
    file = tmp_path / "forces.json"
    row = {"obj_id": 0, "start": 0.2, "end": 0.4, "force": [0, 0, 8]}
    file.write_text(json.dumps({"12_duck_phone": [row], "other": [{**row, "obj_id": 1, "torque": [1, 2, 3]}]}))
    assert read_prompts_file(file, "12_duck_phone", OBJECTS).forces == (Force(1, (0.0, 0.0, 8.0), start=0.2, end=0.4),)
    assert read_prompts_file(file, "other", OBJECTS).forces[0].object_id == 2
    with pytest.raises(InputError, match="has no scene 'mine'; it has 12_duck_phone, other"):
        read_prompts_file(file, "mine", OBJECTS)
    file.write_text(json.dumps({"only": [row]}))
    assert read_prompts_file(file, "mine", OBJECTS).forces[0].object_id == 1  # a single scene matches any name


@pytest.mark.parametrize("prompt, message", [
    ({"force": ["object=2"]}, "needs object= and force="),
    ({"force": ["force=0,0,1"]}, "needs object= and force="),
    ({"force": ["object=2 force=0,0"]}, "'0,0' is not three numbers"),
    ({"force": ["object=2 force=0,0,inf"]}, "is not three numbers"),
    ({"force": ["object=2 force=0,0,1 until=3"]}, "'until' is not a known key"),
    ({"force": ["object=2 force=0,0,1 force=0,0,2"]}, "gives a value twice; write"),
    ({"force": ["object=2 force=0,0,1 from=x"]}, "'x' is not a number"),
    ({"force": ["object=2 force=0,0,1 from=0.3 to=0.1"]}, "the end must come after"),
    ({"force": ["object=2 force=0,0,1 from=-1 to=1"]}, "the simulation begins at 0 s"),
    ({"force": ["object=9 force=0,0,1"]},
     "'9' is not an object of this scene; the scene has: 1 \\(duck\\), 2 \\(phone\\)"),
    ({"pin": ["cow"]}, "--pin 'cow'"),
    ({"velocity": ["1 0,0,2"]}, 'write "object=1 0,0,2"'),
    ({"velocity": ["object=1 fast"]}, "three numbers"),
    ({"lift": ["high"]}, "'high' is not a number"),
    ({"lift": ["3=1"]}, "not an object"),
    ({"lift": ["nan"]}, "not finite"),
    ({"lift": ["0.1", "0.2"]}, r"--lift '0.2': object 1 \(duck\) occurs twice"),
    ({"lift": ["1=0.1", "duck=0.2"]}, r"--lift 'duck=0.2': object 1 \(duck\) occurs twice"),
    ({"velocity": ["object=2 0,0,1", "object=phone 0,0,2"]}, r"object 2 \(phone\) occurs twice"),
])  # fmt: skip
def test_invalid_prompts(prompt, message):
    with pytest.raises(InputError, match=message):
        parse(OBJECTS, **prompt)


@pytest.mark.parametrize("text, message", [
    ("{", "not JSON"), ("3", "scene name"), ('{"a": [{"obj_id": 0}]}', "entry 1.*start"),
    ('{"a": [{"obj_id": 5, "start": 0, "end": 1}]}', "counted from 0\\) is object 6"),
    ('{"a": [{"obj_id": 0, "start": 1, "end": 0}]}', "the end must come after"),
    ('{"a": [{"obj_id": 0, "start": 0, "end": 1, "force": [1]}]}', "3 numbers"), ('{"a": [7]}', "entry 1"),
    ('{"a": [{"obj_id": 0, "start": 0, "end": 1, "Force": [0, 0, 1]}]}', "entry 1: has neither force nor torque"),
])  # fmt: skip
def test_invalid_files(tmp_path, text, message):
    file = tmp_path / "f.json"
    file.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        read_prompts_file(file, "a", OBJECTS)
    assert str(file) in str(error.value)


def test_prompts_come_back_from_their_rows():
    push = Force(1, (0.0, 0.0, 8.0), (1.0, 2.0, 3.0), 0.1, 0.3, (0.5, 0.0, 0.0))
    changes = Change("gravity", 1.6, 0.5), Change("pinned", True, 0.5, 2)
    p = ForcePrompts((push, Force(2)), frozenset({1, 2}), {2: (0.0, 0.0, 2.0)}, {1: 0.3}, changes)
    rows = json.loads(json.dumps(p.as_dicts()))
    assert [row["kind"] for row in rows] == ["force", "force", "pin", "pin", "velocity", "lift", "change", "change"]
    assert ForcePrompts.from_dicts(rows) == p


@pytest.mark.parametrize("prompts", [ForcePrompts((Force(1),)), ForcePrompts(pinned=frozenset({1})),
                                     ForcePrompts(velocity={1: (0.0, 0.0, 0.0)}), ForcePrompts(lift={1: 0.0}),
                                     ForcePrompts(changes=(Change("gravity", 0.0, 1.0),))])  # fmt: skip
def test_any_prompt_counts(prompts):
    assert prompts and not ForcePrompts()


def test_changes_take_effect_in_the_frame_in_which_they_begin():
    changes = tuple(Change("gravity", 1.0, start) for start in (0.0, 0.1, 0.15, 0.2))
    p = ForcePrompts((Force(1, start=5.0),), changes=changes)
    assert p.during(0.1, 0.2) == (p.forces, changes[1:3]) and p.during(0.2, 0.3)[1] == changes[3:]


def test_given_prompts_are_added_to_stored_ones():
    stored = parse(OBJECTS, force=["object=1 torque=0,0,1"], pin=["1"], velocity=["object=1 1,0,0"], lift=["0.5"])
    p = parse(OBJECTS, force=["object=2 force=0,0,1"], pin=["2"], velocity=["object=1 2,0,0"], lift=["duck=0.1"],
              stored=stored)  # fmt: skip
    assert [f.object_id for f in p.forces] == [2, 1] and p.pinned == {1, 2}
    assert p.velocity == {1: (2.0, 0.0, 0.0)} and p.lift == {1: 0.1, 2: 0.5}


def test_files_of_forces_are_lists_of_bounded_length(tmp_path, monkeypatch):
    row, path = {"obj_id": 1, "start": 0, "end": 0.5, "torque": [0, 0, 1]}, tmp_path / "f.json"
    path.write_text(json.dumps([row, row]))
    assert read_forces(path, "any", OBJECTS) == [Force(2, torque=(0.0, 0.0, 1.0), end=0.5)] * 2
    monkeypatch.setattr(forces, "MAX_ROWS", 1)
    with pytest.raises(InputError, match="f.json: has 2 entries; at most 1 are allowed"):
        read_forces(path, "any", OBJECTS)
    path.write_text('{"any": {}}')
    with pytest.raises(InputError, match="f.json: must be {scene name"):
        read_forces(path, "any", OBJECTS)


@pytest.mark.parametrize("text", ["1e9", "-1e9"])
def test_numbers_up_to_a_billion(text):
    assert number(text, "x") == float(text)
    with pytest.raises(InputError, match="x: .* is not finite or exceeds 1e"):
        number(text.replace("1", "1.1"), "x")
