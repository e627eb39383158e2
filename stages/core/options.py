"""Fields of option classes that are also command-line options, with their default, help and limits in one place.

`with_options` of ngff_cli/options.py turns them into a command line. Fields without `option` are available only from
Python.
"""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Iterable
from dataclasses import Field, field, fields
from numbers import Number
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from stages.core.backends import MAX_SEED
from stages.core.errors import InputError


def option(default: Any, help: str, *flags: str, **limits: Any) -> Any:
    """A field of an option class that is also a command-line option, by default named after the field.

    Fields of type bool are flags, with a --no- form if the default is true; tuples are repeatable options. `flags`
    replace the name; `limits` are further arguments of typer.Option, such as min and max.
    """
    return field(default=default, metadata={"help": help, "flags": flags, **limits})


def seed_option() -> Any:
    """The field `seed`."""
    return option(0, "random seed; the same seed on the same device gives the same result", min=0, max=MAX_SEED)


def device_option() -> Any:
    """The field `device`."""
    return option("auto", "device to compute on: auto | cpu | cuda | cuda:N")


def photos_option(backends: str) -> Any:
    """The field `photos` of a stage in which these backends read photos."""
    return option(None, f"for {backends}: folder of the scene's photos; default: use rendered images of the scene")


def download_option(backends: str) -> Any:
    """The field `download` of a stage in which these backends have published weights."""
    return option(False, f"for {backends}: download missing weights; their size and licence are logged first")


def check_types(options: Any) -> None:
    """Convert the `option` fields of an object to their types, where Python callers give others that mean the same.

    Whole floats and NumPy's numbers become int and float, text a Path, a list or a single value a tuple. For the
    `__post_init__` of an option class. Raises InputError for other types, NaN, and numbers beyond the field's limits.
    """
    hints = get_type_hints(type(options))
    for f in fields(options):
        value, hint = getattr(options, f.name), hints[f.name]
        if "help" in f.metadata and not (value is None and type(None) in get_args(hint)):
            object.__setattr__(options, f.name, _converted(f, hint, value))


def _converted(f: Field, hint: Any, value: Any) -> Any:
    """A value in the type of its field: one of _KINDS, or a tuple of texts."""
    if get_origin(hint) is tuple:
        several = isinstance(value, Iterable) and not isinstance(value, (str, bytes))
        return tuple(_single(f, str, item) for item in (value if several else [value]))
    return _single(f, next((kind for kind in get_args(hint) if kind in _KINDS), hint), value)


def _single(f: Field, kind: type, value: Any) -> Any:
    """One value in a type of _KINDS; numbers become text where text is expected, such as objects and heights."""
    words, convert = _KINDS[kind]
    name = f"--{f.name.replace('_', '-')} {value!r:.60}"
    try:
        made = convert(value)
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise InputError(f"{name}: give {words}") from error
    low, high = f.metadata.get("min"), f.metadata.get("max")
    if (low is not None and made < low) or (high is not None and made > high):
        raise InputError(f"{name}: give {low}{' or more' if high is None else f' to {high}'}")
    return made


def _whole(value: Any) -> int:
    return operator.index(int(value) if isinstance(value, float) and value.is_integer() else value)


def _number(value: Any) -> float:
    if isinstance(value, str) or math.isnan(value):
        raise ValueError
    return float(value)


def _text(value: Any) -> str:
    if not isinstance(value, (str, os.PathLike, Number)) and type(value).__name__ != "device":  # of PyTorch
        raise TypeError
    return str(value)


# type of a field -> what it takes in words, and a conversion, which raises an error for values of other types
_KINDS = {
    bool: ("True or False", lambda value: {True: True, False: False}[value]),
    int: ("a whole number", _whole),
    float: ("a number", _number),
    str: ("text", _text),
    Path: ("a path", Path),
}
