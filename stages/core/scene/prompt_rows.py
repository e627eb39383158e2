"""Checks of the prompts of a simulation (forces, pins, velocities, lifts, changes) as JSON objects; see README.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable

from stages.core.scene.schema import flag, number, numbers, quote, text, whole


def _vector(value: object, what: str) -> tuple[float, ...]:
    return numbers(value, 3, what)


def _time(value: object, what: str) -> float:
    return number(value, what, 0)


def _id(value: object, what: str) -> int:
    return whole(value, what, 1)


CHANGES: dict[str, Callable] = {  # quantity that changes during a simulation -> check of its value
    "gravity": number,  # downward acceleration [m/s^2]
    "friction": lambda value, what: number(value, what, 0, 100),  # Coulomb coefficient of all objects
    "material": text,  # name of an object's material
    "pinned": flag,  # whether an object is held at its position
}
FIELDS: dict[str, dict[str, Callable]] = {  # kind of prompt -> field -> check of its value
    "force": {"object_id": _id, "force": _vector, "torque": _vector, "start": _time, "end": _time, "at": _vector},
    "pin": {"object_id": _id},
    "velocity": {"object_id": _id, "velocity": _vector},
    "lift": {"object_id": _id, "height": number},
    "change": {"what": text, "value": lambda value, what: value, "start": _time, "object_id": _id},
}
ABSENT = {"torque": (0.0, 0.0, 0.0), "at": None}  # default values of fields that may be left out
NULLABLE = {("force", "end"), ("force", "at"), ("change", "object_id")}  # fields that may be null


def read_prompts(rows: Iterable[object], ids: Collection[int] | None = None) -> tuple[dict, ...]:
    """The prompts with all fields present, and numbers and vectors as floats.

    Raises ValueError for unknown kinds, missing fields, values of a wrong type or out of range, and, if `ids` are
    given, objects that are not among them.
    """
    return tuple(_read_prompt(row, ids) for row in rows)


def _read_prompt(row: object, ids: Collection[int] | None) -> dict:
    kind = row.get("kind", "force") if isinstance(row, dict) else None
    if not isinstance(kind, str) or kind not in FIELDS:
        raise ValueError(f"a prompt {quote(repr(row), 60)} is of none of the kinds {', '.join(FIELDS)}")
    given, read = {**ABSENT, **row}, {"kind": kind}
    for name, check in FIELDS[kind].items():
        if name not in given:
            raise ValueError(f"a prompt of kind {kind} has no {name}")
        null = given[name] is None and (kind, name) in NULLABLE
        read[name] = None if null else check(given[name], f"{name} of a {kind}")
    if kind == "change":
        if read["what"] not in CHANGES:
            raise ValueError(f"a change of {quote(read['what'], 40)}; only {', '.join(CHANGES)} change")
        read["value"] = CHANGES[read["what"]](read["value"], read["what"])
        if (read["object_id"] is None) != (read["what"] in ("gravity", "friction")):
            raise ValueError(f"a change of {read['what']} that is {'not ' * (read['object_id'] is None)}of one object")
    if kind == "force" and not read["start"] < (math.inf if read["end"] is None else read["end"]):
        raise ValueError(f"a force from {read['start']:g} s to {read['end']:g} s")
    if ids is not None and read["object_id"] not in {*ids, None}:
        raise ValueError(f"a {kind} acts on object {read['object_id']}, which is not among the objects")
    return read
