"""Force prompts: forces, pins, initial velocities and lifts, the same for every engine.

Forces are in newtons, torques in newton metres, times in seconds; points, velocities and lifts in scene units. The JSON
format of NGFF, {scene name: [{obj_id, start, end, force?, torque?}]}, numbers objects from 0: its object i is object
i + 1 here, where 0 is the background.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from stages.core.errors import InputError
from stages.core.physics.materials import check_new, find_object
from stages.core.scene.files import read_json_file
from stages.core.scene.prompt_rows import FIELDS, read_prompts
from stages.core.scene.scene import SceneObject
from stages.core.scene.schema import LARGEST, MAX_ROWS, numbers, quote, reason, whole
from stages.core.scene.schema import number as finite

Vector = tuple[float, float, float]
FORCE_SYNTAX = 'write "object=2 force=0,0,8 from=0.1 to=0.3", optionally with torque=x,y,z or at=x,y,z'


@dataclass(frozen=True)
class Force:
    """A constant force and torque on an object from `start` to `end` [s]."""

    object_id: int
    force: Vector = (0.0, 0.0, 0.0)  # [N]
    torque: Vector = (0.0, 0.0, 0.0)  # about the centre of mass [N m]
    start: float = 0.0
    end: float = math.inf
    at: Vector | None = None  # point of application on the object at rest [scene units]; None: the whole object

    def active_fraction(self, start: float, end: float) -> float:
        """Fraction of the interval from `start` to `end` [s] during which the force acts."""
        return max(0.0, min(self.end, end) - max(self.start, start)) / (end - start)


@dataclass(frozen=True)
class Change:
    """A condition that changes during the simulation, at the frame that begins at `start` [s]."""

    what: str  # key of CHANGES in stages/core/scene/prompt_rows.py
    value: float | str | bool
    start: float
    object_id: int | None = None  # None: all objects


@dataclass(frozen=True)
class ForcePrompts:
    """Forces and constraints given by the user, by object id; false if there are none."""

    forces: tuple[Force, ...] = ()
    pinned: frozenset[int] = frozenset()  # objects held from the start
    velocity: dict[int, Vector] = field(default_factory=dict)  # initial velocity [scene units/s]
    lift: dict[int, float] = field(default_factory=dict)  # initial displacement upwards [scene units]
    changes: tuple[Change, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.forces or self.pinned or self.velocity or self.lift or self.changes)

    def during(self, start: float, end: float) -> tuple[tuple[Force, ...], tuple[Change, ...]]:
        """Forces that may act, and changes that take effect, in the frame from `start` to `end` [s].

        Engines call this once per frame, in order, before they compute the frame.
        """
        return self.forces, tuple(c for c in self.changes if start <= c.start < end)

    def as_dicts(self) -> tuple[dict, ...]:
        """One plain dict per prompt for the trajectory file, `kind` first; an infinite end time is None."""
        rows: list[dict] = []
        for f in self.forces:
            row = asdict(f)
            rows.append({"kind": "force", **row, "end": None if math.isinf(f.end) else f.end})
        rows += [{"kind": "pin", "object_id": i} for i in sorted(self.pinned)]
        rows += [{"kind": "velocity", "object_id": i, "velocity": v} for i, v in sorted(self.velocity.items())]
        rows += [{"kind": "lift", "object_id": i, "height": h} for i, h in sorted(self.lift.items())]
        rows += [{"kind": "change", **asdict(c)} for c in self.changes]
        return tuple(rows)

    @classmethod
    def from_dicts(cls, rows: Sequence[dict]) -> ForcePrompts:
        """The inverse of `as_dicts`. Raises ValueError for malformed rows."""
        of: dict[str, list[dict]] = {kind: [] for kind in FIELDS}
        for row in read_prompts(rows):
            of[row.pop("kind")].append(row)
        return cls(
            tuple(Force(**{**f, "end": math.inf if f["end"] is None else f["end"]}) for f in of["force"]),
            frozenset(row["object_id"] for row in of["pin"]),
            {row["object_id"]: row["velocity"] for row in of["velocity"]},
            {row["object_id"]: row["height"] for row in of["lift"]},
            tuple(Change(**row) for row in of["change"]),
        )


def parse(
    objects: Sequence[SceneObject], force: Sequence[str] = (), pin: Sequence[str] = (), velocity: Sequence[str] = (),
    lift: Sequence[str] = (), stored: ForcePrompts = ForcePrompts(),  # noqa: B008 -- frozen
) -> ForcePrompts:  # fmt: skip
    """Parse the prompts of the command line, which give objects by id or name, and merge them with `stored` ones.

    The lift of a named object overrides that of all objects. Raises InputError for malformed prompts, unknown objects,
    and two velocities or lifts of one object.
    """
    return ForcePrompts(
        (*(_force(text, objects) for text in force), *stored.forces),
        stored.pinned | {find_object(p, objects, f"--pin {quote(repr(p))}").id for p in pin},
        stored.velocity | _velocities(velocity, objects),
        stored.lift | _lifts(lift, objects),
        stored.changes,
    )


def _force(text: str, objects: Sequence[SceneObject]) -> Force:
    where = f"--force {quote(repr(text))}"
    pairs = [word.partition("=")[::2] for word in text.split()]
    words = dict(pairs)
    if len(words) < len(pairs):
        raise InputError(f"{where}: gives a value twice; {FORCE_SYNTAX}")
    unknown = words.keys() - {"object", "force", "torque", "from", "to", "at"}
    if unknown:
        raise InputError(f"{where}: {quote(repr(sorted(unknown)[0]))} is not a known key; {FORCE_SYNTAX}")
    if "object" not in words or not {"force", "torque"} & words.keys():
        raise InputError(f"{where}: needs object= and force= or torque=; {FORCE_SYNTAX}")
    at = vector(words["at"], where) if "at" in words else None
    start = number(words.get("from", "0"), where)
    end = number(words["to"], where) if "to" in words else math.inf
    push = vector(words.get("force", "0,0,0"), where)
    torque = vector(words.get("torque", "0,0,0"), where)
    return _checked(Force(find_object(words["object"], objects, where).id, push, torque, start, end, at), where)


def _checked(force: Force, where: str) -> Force:
    if not 0 <= force.start < force.end:
        what = "the end must come after the start" if force.start >= 0 else "the simulation begins at 0 s"
        raise InputError(f"{where}: the force acts from {force.start} s to {force.end} s; {what}")
    return force


def _velocities(texts: Sequence[str], objects: Sequence[SceneObject]) -> dict[int, Vector]:
    given: dict[int, Vector] = {}
    for text in texts:
        where, words = f"--velocity {quote(repr(text))}", text.split()
        if len(words) != 2 or not words[0].startswith("object="):
            raise InputError(f'{where}: is not OBJECT and VELOCITY; write "object=1 0,0,2"')
        o = find_object(words[0].removeprefix("object="), objects, where)
        check_new(o, given, where)
        given[o.id] = vector(words[1], where)
    return given


def _lifts(texts: Sequence[str], objects: Sequence[SceneObject]) -> dict[int, float]:
    of_all: dict[int, float] = {}
    given: dict[int, float] = {}
    for text in texts:
        where = f"--lift {quote(repr(text))}"
        key, equals, height = text.rpartition("=")
        chosen, into = ([find_object(key, objects, where)], given) if equals else (objects, of_all)
        for o in chosen:
            check_new(o, into, where)
        into.update({o.id: number(height, where) for o in chosen})
    return of_all | given


def read_forces(path: Path, scene_name: str, objects: Sequence[SceneObject]) -> list[Force]:
    """Read the forces of one scene from a JSON file in the format of NGFF; a file with a single scene matches any name.

    Raises InputError for malformed files and unknown objects.
    """
    data = read_json_file(path, "a JSON file {scene name: [{obj_id, start, end, force?, torque?}]}", (dict, list))
    if isinstance(data, dict):
        if scene_name not in data and len(data) != 1:
            raise InputError(f"{path}: has no scene {scene_name!r}; it has {quote(', '.join(data)) or 'none'}")
        data = data[scene_name] if scene_name in data else next(iter(data.values()))
    if not isinstance(data, list):
        raise InputError(f"{path}: must be {{scene name: [{{obj_id, start, end, force?, torque?}}]}}")
    if len(data) > MAX_ROWS:
        raise InputError(f"{path}: has {len(data)} entries; at most {MAX_ROWS} are allowed")
    return [_parse_entry(row, objects, f"{path}: entry {i + 1}") for i, row in enumerate(data)]


def _parse_entry(row: object, objects: Sequence[SceneObject], where: str) -> Force:
    try:
        id = whole(row["obj_id"], "obj_id") + 1
        start, end = (finite(row[name], name) for name in ("start", "end"))
        push, torque = (numbers(row.get(name, [0, 0, 0]), 3, name) for name in ("force", "torque"))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RuntimeError, IndexError) as error:
        why = reason(error)
        raise InputError(
            f"{where}: {why}; an entry needs obj_id, start, end, and force or torque of 3 numbers"
        ) from error
    if id not in {o.id for o in objects}:
        raise InputError(f"{where}: obj_id {id - 1} (counted from 0) is object {id}, which this scene does not have")
    force = _checked(Force(id, push, torque, start, end), where)
    if not {"force", "torque"} & row.keys():
        raise InputError(f"{where}: has neither force nor torque; give one of 3 numbers")
    return force


def _floats(values: Sequence[float | int | str]) -> Vector:
    return numbers([float(v) for v in values], 3, "a vector")


def vector(text: str, where: str) -> Vector:
    """Parse three comma-separated numbers; `where` prefixes the InputError for malformed text."""
    try:
        return _floats(text.split(","))
    except ValueError as error:
        raise InputError(f"{where}: {quote(repr(text))} is not three numbers such as 0,0,2") from error


def number(text: str, where: str) -> float:
    """Parse one finite number; `where` prefixes the InputError for malformed text."""
    try:
        value = float(text)
    except ValueError as error:
        raise InputError(f"{where}: {quote(repr(text))} is not a number") from error
    if not abs(value) <= LARGEST:
        raise InputError(f"{where}: {quote(repr(text))} is not finite or exceeds {LARGEST:g}; give a smaller number")
    return value
