"""While tests run, `jaxtyping` checks the shapes in annotations, if `beartype` is installed.

In each test the first FIRST calls of a function are checked, and then every EVERY-th one: checking all calls would take
a third of the time of a simulation. All instances of a nested function count as one function; data classes are checked
when they are constructed.
"""

import dataclasses
import inspect
from collections import Counter
from collections.abc import Callable
from functools import wraps
from importlib.util import find_spec
from types import FunctionType
from typing import Any, get_type_hints

import jaxtyping

FIRST, EVERY = 3, 20  # number of calls checked at the start, and interval of later checks
calls: Counter[int] = Counter()  # per test, by the address of the code object, whose own hash is slow
made: Counter[int] = Counter()  # number of times that each nested function was created in this test
check_all = jaxtyping.jaxtyped
new_lengths = check_all("context")  # context manager: shape letters inside it are not yet bound to lengths


def hints_of(function: FunctionType) -> dict[str, Any]:
    """The annotations of a function; Any for those with names that cannot be resolved in its module."""

    def holder():
        pass

    def resolved(hints: dict) -> dict[str, Any]:
        holder.__annotations__ = hints
        return get_type_hints(holder, function.__globals__, include_extras=True)

    hints = dict(function.__annotations__)
    try:
        return resolved(hints)
    except Exception:
        for name, hint in hints.items():
            try:
                hints[name] = resolved({name: hint})[name]
            except Exception:
                hints[name] = Any
        return hints


def checked_calls(function: FunctionType, typechecker: Callable) -> Callable:
    """A wrapper that checks arguments and result of every call, like `jaxtyping.jaxtyped` but much faster.

    `jaxtyped` compiles two functions for each function, to check the arguments before the call and again with the
    result.
    """
    if inspect.isgeneratorfunction(function):
        return check_all(function, typechecker=typechecker)
    from beartype import BeartypeConf, beartype

    same = FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    same.__kwdefaults__, same.__annotations__ = function.__kwdefaults__, hints_of(function)
    same.__module__, same.__qualname__ = function.__module__, function.__qualname__
    typed = beartype(same, conf=BeartypeConf(violation_type=jaxtyping.TypeCheckError))

    def call(*args, **options):
        with new_lengths:
            return typed(*args, **options)

    return call


def check_some(*, typechecker: Callable) -> Callable:
    """Replacement for `jaxtyping.jaxtyped`, which decorates functions and classes of the checked modules."""

    def decorate(function):
        if function.__module__ == "stages.core.scene.error_deferring_file":
            return function  # called by HDF5, which would lose an interrupt inside a wrapper
        if isinstance(function, type):
            if dataclasses.is_dataclass(function) and "__init__" in vars(function):
                function.__init__ = decorate(function.__init__)
            return function
        code = id(function.__code__)
        if "<locals>" in function.__qualname__:
            count = made[code] = made[code] + 1
            if count > FIRST and count % EVERY:
                return function
        checked = None  # created on the first call, since most functions are never called

        @wraps(function)
        def call(*args, **options):
            nonlocal checked
            count = calls[code] = calls[code] + 1
            if count > FIRST and count % EVERY:
                return function(*args, **options)
            checked = checked or checked_calls(function, typechecker)
            return checked(*args, **options)

        return call

    return decorate


if find_spec("beartype"):
    jaxtyping.jaxtyped = check_some
    folders = [f"stages.core.{folder}" for folder in ("geometry", "scene", "physics", "models")]
    jaxtyping.install_import_hook(folders, "beartype.beartype")
