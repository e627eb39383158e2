"""Messages that the page may send to a live session; all others are rejected."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

from stages.core.physics.materials import ELASTIC

MAX_BYTES = 2048  # largest size of a message
MAX_LENGTH = 1e4  # largest absolute coordinate [scene units]


class BadMessage(ValueError):
    """A message that MESSAGES does not allow."""


def _number(low: float, high: float) -> Callable[[Any], float]:
    def check(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
            raise BadMessage(f"a number from {low} to {high} is expected")
        return float(value)

    return check


def _vector(value: Any) -> tuple[float, float, float]:
    if not isinstance(value, list) or len(value) != 3:
        raise BadMessage("three numbers are expected")
    x, y, z = (_number(-MAX_LENGTH, MAX_LENGTH)(v) for v in value)
    return x, y, z


def _direction(value: Any) -> tuple[float, float, float]:
    x, y, z = _vector(value)
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-6:
        raise BadMessage("a direction is expected")
    return x / length, y / length, z / length


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise BadMessage("true or false is expected")
    return value


def _object(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value < 2**31:
        raise BadMessage("the number of an object is expected")
    return value


def _material(value: Any) -> str:
    if not isinstance(value, str) or value not in ELASTIC:
        raise BadMessage("the name of an elastic material is expected")
    return value


MESSAGES: dict[str, dict[str, Callable[[Any], Any]]] = {  # name -> its fields with their checks
    "grab": {"object": _object, "point": _vector, "target": _vector},  # pull a point of an object to the target
    "move": {"target": _vector},  # move the target of the grabbed point
    "release": {},
    "push": {"object": _object, "point": _vector, "direction": _direction, "strength": _number(0, 100)},  # [units/s]
    "lift": {"object": _object, "height": _number(-100, 100)},  # raise and hold it [scene units]
    "drop": {"object": _object},
    "pin": {"object": _object, "value": _flag},
    "gravity": {"value": _number(-100, 100)},  # downwards [m/s^2]
    "friction": {"value": _number(0, 10)},
    "material": {"object": _object, "name": _material},
    "pause": {"value": _flag},
    "step": {},  # advance by one frame while paused
    "speed": {"value": _number(0.01, 4)},  # of simulated time, relative to real time
    "reset": {},  # restart with a new recording
    "save": {},
    "drawn": {},  # the last frame has been drawn; the next may be sent
}


def parse_message(text: str | bytes) -> dict[str, Any]:
    """Parse a message to {"do": name, ...fields}. Raises BadMessage."""
    if not isinstance(text, str) or len(text) > MAX_BYTES:
        raise BadMessage("a short text is expected")
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadMessage("JSON is expected") from error
    if not isinstance(data, dict) or not isinstance(data.get("do"), str) or data["do"] not in MESSAGES:
        raise BadMessage("there is no such message")
    fields = MESSAGES[data["do"]]
    if data.keys() != {"do", *fields}:
        raise BadMessage(f"{data['do']} has the fields {', '.join(fields) or 'none'}")
    return {"do": data["do"], **{name: check(data[name]) for name, check in fields.items()}}
