"""Checks of single values: accepted values, limits, and errors that name the wrong value."""

import math
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from stages.core.errors import InputError
from stages.core.scene import schema
from stages.core.scene.files import read_json_file, replacing
from stages.core.scene.scene import Scene, SceneObject, read_metadata, read_objects
from stages.core.scene.schema import (
    LARGEST,
    MAX_OBJECT_ID,
    check_ply_counts,
    flag,
    number,
    numbered,
    numbers,
    parse_json,
    quote,
    read_json,
    rows,
    table,
    text,
    texts,
    whole,
)
from stages.core.scene.sequence import MAX_FRAMES, FilmedSequence, read_sequence_json

VALUES = [  # check, value, and its result, or None if the value is refused
    (number, 3, 3.0), (number, -LARGEST, -LARGEST), (number, LARGEST, LARGEST), (number, 1.01 * LARGEST, None),
    (number, np.float32(0.5), 0.5), (number, np.int64(7), 7.0), (number, True, None), (number, "3", None),
    (number, math.nan, None), (number, None, None), (number, -1.01 * LARGEST, None),
    (whole, 0, 0), (whole, 3.0, 3), (whole, 3.5, None), (whole, -1, None), (whole, MAX_OBJECT_ID, MAX_OBJECT_ID),
    (whole, MAX_OBJECT_ID + 1, None), (whole, "3", None),
    (text, "duck", "duck"), (text, "", ""), (text, 3, None), (text, None, None), (text, "a\nb", "a?b"),
    (texts, ["a", "b"], ("a", "b")), (texts, ("a",), ("a",)), (texts, [], ()), (texts, ["a", 1], None),
    (texts, "ab", None), (texts, {"a": 1}, None),
    (flag, True, True), (flag, False, False), (flag, 1, None), (flag, "true", None),
    (rows, [], []), (rows, [1], [1]), (rows, (1,), None), (rows, {}, None),
    (table, {"a": 1}, {"a": 1}), (table, [], None), (table, None, None),
    (numbered, {"1": "a", "20": "b"}, {1: "a", 20: "b"}), (numbered, {"1": 0, "01": 0}, None),
    (numbered, {"x": 0}, None), (numbered, {"-1": 0}, None), (numbered, {"٣": 0}, None), (numbered, {"1.0": 0}, None),
    (numbered, {"9999999999": 0}, None), (number, np.float64(1.01 * LARGEST), None), (number, np.bool_(True), None),
]  # fmt: skip


@pytest.mark.parametrize(("check", "value", "result"), VALUES, ids=lambda x: getattr(x, "__name__", None))
def test_values_of_the_right_type_and_range_are_accepted(check, value, result):
    with nullcontext() if result is not None else pytest.raises(ValueError, match="^the thing is "):
        found = check(value, "the thing")
        assert found == result and type(found) is type(result)


def test_bounds_belong_to_the_range():
    assert [number(x, "x", 0, 1) for x in (0, 1)] == [0.0, 1.0] and [whole(x, "x", 1, 2) for x in (1, 2)] == [1, 2]
    for check, value in ((number, -0.001), (number, 1.001), (whole, 2), (whole, -1)):
        with pytest.raises(ValueError, match="x is"):
            check(value, "x", 0, 1)


@pytest.mark.parametrize("values", [[1, 2], [1, 2, 3, 4], "123", b"123", {1: 0, 2: 0, 3: 0}, 3, [1, 2, "3"]])
def test_vectors_are_lists_of_that_many_numbers(values):
    assert numbers([1, 2, 3], 3, "v") == numbers(np.array([1.0, 2, 3]), 3, "v") == (1.0, 2.0, 3.0)
    with pytest.raises(ValueError, match="^v is "):
        numbers(values, 3, "v")


def test_lists_of_users_are_bounded(monkeypatch):
    monkeypatch.setattr(schema, "MAX_ROWS", 2)
    assert rows([1, 2], "r") == [1, 2]
    with pytest.raises(ValueError, match="not a list of at most 2 values"):
        rows([1, 2, 3], "r")


def test_no_list_has_more_than_a_million_values_and_no_json_file_more_than_256_mib(tmp_path):
    assert len(rows([0] * 10**6, "r")) == 10**6
    with pytest.raises(ValueError, match="not a list of at most 1000000 values"):
        rows([0] * (10**6 + 1), "r")
    with open(tmp_path / "a.json", "wb") as file:
        file.truncate((256 << 20) + 1)
    with pytest.raises(ValueError, match="it has 256 MB; at most 256 are read"):
        read_json(tmp_path / "a.json")


def test_quoted_text_is_cut_at_its_limit():
    assert quote("a" * 80) == "a" * 80 and quote("a" * 81) == "a" * 77 + "..."
    assert quote("abcdef", 5) == "ab..." and quote("abcde", 5) == "abcde"


def test_json_files_are_bounded_files(tmp_path, monkeypatch):
    (tmp_path / "a.json").write_text('{"ü": [1]}', encoding="utf-8")
    assert read_json(tmp_path / "a.json") == {"ü": [1]}
    with pytest.raises(ValueError, match="not a file"):
        read_json(tmp_path)
    monkeypatch.setattr(schema, "MAX_JSON_BYTES", 11)
    assert read_json(tmp_path / "a.json")  # the file has 11 bytes
    monkeypatch.setattr(schema, "MAX_JSON_BYTES", 10)
    with pytest.raises(ValueError, match="at most 0 are read"):
        read_json(tmp_path / "a.json")


def test_json_files_may_begin_with_the_mark_of_windows(tmp_path):
    (tmp_path / "a.json").write_text('{"ü": 1}', encoding="utf-8-sig")
    assert read_json(tmp_path / "a.json") == {"ü": 1}


def test_json_objects_have_one_value_of_each_key():
    for data in ('{"1": "duck", "2": "cup", "1": "bowl"}', '[{"a": {"1": 0, "1": 0}}]'):
        with pytest.raises(ValueError, match="^'1' occurs twice$"):
            parse_json(data)
    assert parse_json('{"a": {"1": 0}, "b": {"1": 0}}') == {"a": {"1": 0}, "b": {"1": 0}}


def test_messages_show_plain_values():
    with pytest.raises(ValueError, match="^dt is -1.0, not a number"):
        number(np.float64(-1), "dt", 0)
    for value in (None, ["a"]):
        with pytest.raises(ValueError, match="^it is .*, not a JSON object$"):
            numbered(value, "a label")


def test_json_files_hold_what_is_expected(tmp_path):
    path = tmp_path / "a.json"
    for content, message in (("[1]", "is not a list of toys"), ("[", "is not JSON"), ("", "is empty; a list of toys")):
        path.write_text(content)
        with pytest.raises(InputError, match=message):
            read_json_file(path, "a list of toys")
    path.write_text("[1]")
    assert read_json_file(path, "a list of toys", list) == [1]


@pytest.mark.parametrize("finite", [True, False])
def test_numbers_of_json_that_are_not_finite(finite):
    for digits in ("1e999", "-Infinity", "NaN", str(10**20)):
        with pytest.raises(ValueError, match="not finite|too large") if finite else nullcontext():
            parse_json(f"[{digits}]", finite)
    assert parse_json("[1.5, -2, 9223372036854775807]") == [1.5, -2, 2**63 - 1]


HEADER = ["ply", "format binary_little_endian 1.0", "element vertex 10", "property float x", "property uchar r",
          "property double y"]  # fmt: skip


@pytest.mark.parametrize(("size", "right"), [(130, True), (129, True), (128, False)])
def test_counts_of_a_ply_fit_into_its_bytes(size, right):
    """10 rows of 4 + 1 + 8 bytes; one byte less is allowed, because the last line may lack its end."""
    with nullcontext() if right else pytest.raises(ValueError, match="declares 130 bytes or more; it has 128"):
        check_ply_counts(HEADER, size)
    text = ["ply", "format ascii 1.0", *HEADER[2:]]  # at least a digit and a space for each value
    check_ply_counts(text, 60)
    with pytest.raises(ValueError, match="declares 60 bytes"):
        check_ply_counts(text, 58)


@pytest.mark.parametrize("line", ["element face", "element face -1", "element face 1e3", "element face " + "1" * 16,
                                  "property list uchar int ids"])  # fmt: skip
def test_lines_of_a_ply_header_that_are_refused(line):
    check_ply_counts([*HEADER, "element face 0"], 130)
    with pytest.raises(ValueError, match="has the line 'element|has the line element|lists"):
        check_ply_counts([*HEADER, line], 10**9)


def test_objects_have_ids_from_1_and_names():
    assert read_objects([(2, "duck", "rubber"), (1.0, "ball", "")]) == (
        SceneObject(2, "duck", "rubber"), SceneObject(1, "ball"),
    )  # fmt: skip
    for row, message in (((0, "x", ""), "object's id"), ((1.5, "x", ""), "id"), ((3, None, ""), "name of object 3"),
                         ((3, "x", 1), "material of object 3"), ((MAX_OBJECT_ID + 1, "x", ""), "id")):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            read_objects([row])
    with pytest.raises(ValueError, match="object 4 occurs twice"):
        read_objects([(4, "a", ""), (5, "b", ""), (4, "c", "")])


METADATA = {"floor": 0.5, "scale": {"metres_per_unit": 0.1}, "provenance": {"options": {}, "inputs": [{"name": "a"}]},
            "background": (0.0, 0.5, 1.0)}  # fmt: skip


@pytest.mark.parametrize(("name", "value"), [
    ("floor", "0"), ("floor", math.inf), ("scale", [1]), ("scale", {"metres_per_unit": 0}),
    ("scale", {"metres_per_unit": 9.9e-7}), ("scale", {"metres_per_unit": 1.01e6}),
    ("provenance", None), ("provenance", {"options": []}),
    ("provenance", {"inputs": {}}), ("provenance", {"inputs": [{"name": 3}]}), ("provenance", {"inputs": ["a"]}),
    ("background", [0, 0]), ("background", [0, 0, "1"]),
])  # fmt: skip
def test_metadata_of_other_types_are_refused(name, value):
    assert read_metadata(**METADATA) == METADATA
    with pytest.raises(ValueError, match="."):
        read_metadata(**{**METADATA, name: value})


def test_scales_of_micrometres_to_thousands_of_kilometres_are_read():
    for unit in (1e-6, 1e6):
        assert read_metadata(None, {"metres_per_unit": unit}, {}, None)["scale"] == {"metres_per_unit": unit}


def test_metadata_that_may_be_absent():
    found = read_metadata(None, {}, {}, [-1, 0.25, 7])
    assert found == {"floor": None, "scale": {}, "provenance": {}, "background": (0.0, 0.25, 1.0)}
    assert read_metadata(None, {}, {}, None)["background"] is None


@pytest.mark.parametrize(
    ("source", "known"), [("not stated", False), ("assumed 1", False), ("given", True), (None, False)]
)
def test_masses_hold_for_a_unit_of_1_m_where_the_scale_is_not_known(source, known, two_balls):
    scale = {"metres_per_unit": 2.0} | ({"source": source} if source else {})
    scene = Scene(two_balls.gaussians, two_balls.objects, scale=scale)
    assert scene.has_known_scale is known and scene.metres_per_unit == 2.0
    assert scene.mass_text(1.5) == ("1.5 kg" if known else "1.5 kg if one unit is 1 m")
    assert (scene.name_of(1), scene.name_of(9)) == ("red ball", "object_9")
    assert Scene(two_balls.gaussians, scale={}).metres_per_unit == 1.0
    assert not Scene(two_balls.gaussians).has_known_scale


SEQUENCE = {"fps": 30.0, "frames": 2, "starts": {"a": -0.5, "b": 7.25}}


@pytest.mark.parametrize("wrong", [
    {"fps": 9.9e-4}, {"fps": 1.01e6}, {"frames": 0}, {"frames": 1.5}, {"frames": MAX_FRAMES + 1}, {"starts": None},
    {"starts": {"a": "x"}}, {"starts": {"a": -MAX_FRAMES - 1}}, {"starts": {"a": MAX_FRAMES + 1}}, {"starts": [1]},
], ids=str)  # fmt: skip
def test_sequences_are_read_back_and_others_refused(wrong):
    assert read_sequence_json(SEQUENCE) == FilmedSequence(**SEQUENCE) and read_sequence_json(None) is None
    assert read_sequence_json(SEQUENCE).to_json() == SEQUENCE
    bounds = {"fps": 1e-3, "frames": MAX_FRAMES, "starts": {"a": -float(MAX_FRAMES), "b": float(MAX_FRAMES)}}
    assert read_sequence_json(bounds) == FilmedSequence(**bounds)
    with pytest.raises(ValueError, match="sequence|start"):
        read_sequence_json({**SEQUENCE, **wrong})


def test_sequences_are_json_objects():
    with pytest.raises(ValueError, match="not a JSON object with starts"):
        read_sequence_json([SEQUENCE])


def test_a_file_is_not_written_over_a_folder_nor_into_none(tmp_path):
    for path, message in (
        (tmp_path, "is a folder; give the name of the file"),
        (tmp_path / "a" / "b", "there is no folder"),
    ):
        with pytest.raises(InputError, match=message), replacing(path) as part:
            Path(part).write_text("x")
