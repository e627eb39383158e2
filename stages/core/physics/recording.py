"""Read the prompts and options that repeat a simulation, from a trajectory or a file that a playable page saved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.core.backends import MAX_SEED
from stages.core.errors import InputError
from stages.core.physics.forces import ForcePrompts, read_forces
from stages.core.scene.files import read_json_file
from stages.core.scene.formats import FORMATS, suffixes
from stages.core.scene.scene import SceneObject
from stages.core.scene.schema import flag, number, reason, rows, table, text, texts, whole

# Options of `ngff simulate` that --forces repeats, and checks of their values; without options that name other files.
OPTIONS: dict[str, Callable] = {
    "dt": number, "engine": text, "gravity": number, "quality": text, "material": texts, "floor": number,
    "friction": number, "box": text, "keypoints": whole, "integrator": text, "contact": text, "rest": flag,
    "seed": lambda value, what: whole(value, what, 0, MAX_SEED),
}  # fmt: skip


@dataclass(frozen=True)
class Recording:
    """The prompts of a simulation, its options and its number of frames."""

    prompts: ForcePrompts
    options: dict[str, Any]  # some of OPTIONS
    frames: int


def read_recording(path: Path) -> Recording | None:
    """Read the recording of a trajectory or a JSON file {options, frames, prompts}; None for JSON in NGFF's format.

    Raises InputError for damaged files.
    """
    if Path(path).suffix.lower() in suffixes("trajectory"):
        t = FORMATS[Path(path).suffix.lower()].read(Path(path))
        return Recording(
            ForcePrompts.from_dicts(t.info.forces), _options(path, t.scene.provenance.get("options", {})), len(t)
        )
    what = "a JSON file {scene name: [{obj_id, start, end, force?, torque?}]}, or one that a playable page saved"
    data = read_json_file(path, what, (dict, list))
    if not isinstance(data, dict) or data.keys() != {"options", "frames", "prompts"}:
        return None
    try:
        prompts = ForcePrompts.from_dicts([table(row, "a prompt") for row in rows(data["prompts"], "prompts")])
        frames = whole(data["frames"], "frames", 1)
    except ValueError as error:
        raise InputError(f"{path}: {reason(error)}; save it from the page again") from error
    return Recording(prompts, _options(path, data["options"]), frames)


def read_prompts_file(path: Path, scene_name: str, objects: Sequence[SceneObject]) -> ForcePrompts:
    """Read the prompts of a recording, or of JSON in the format of NGFF (`read_forces`).

    Raises InputError for damaged files, and for objects that are not in this scene.
    """
    recording = read_recording(path)
    if recording is None:
        return ForcePrompts(tuple(read_forces(path, scene_name, objects)))
    prompts = recording.prompts
    acted_on = {f.object_id for f in prompts.forces} | {c.object_id for c in prompts.changes} - {None}
    missing = (acted_on | prompts.pinned | set(prompts.velocity) | set(prompts.lift)) - {o.id for o in objects}
    if missing:
        raise InputError(
            f"{path}: acts on object {min(missing)}, which this scene does not have; give the scene that it was "
            "recorded with"
        )
    return prompts


def _options(path: Path, values: object) -> dict[str, Any]:
    try:
        if not isinstance(values, dict):
            raise ValueError("they are no table")
        return {name: check(values[name], name) for name, check in OPTIONS.items() if values.get(name) is not None}
    except ValueError as error:
        raise InputError(
            f"{path}: its options of `ngff simulate` are damaged ({reason(error)}); save it from the page again"
        ) from error
