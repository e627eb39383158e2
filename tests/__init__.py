"""While tests run, `jaxtyping` checks the shapes in annotations, if `beartype` is installed.

Of the calls of a function in one test the first are checked and then every so many: checks of all of them would take a
third of the time of a simulation. Functions within functions count as one, however often they are made; data classes
are checked where they are constructed.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable
from functools import wraps
from importlib.util import find_spec

import jaxtyping

FIRST, EVERY = 3, 20  # calls
calls: Counter[int] = Counter()  # in this test, by the address of the code, whose own hash is slow
made: Counter[int] = Counter()  # functions within functions, in this test
check_all = jaxtyping.jaxtyped


def _is_sampled(count: int) -> bool:
    return count <= FIRST or count % EVERY == 0


def check_some(*, typechecker: Callable) -> Callable:
    """Instead of `jaxtyping.jaxtyped`, which decorates the functions and classes of the modules that are checked."""

    def decorate(function):
        if function.__module__ == "stages.core.scene.error_deferring_file":
            return function  # HDF5 calls it, and loses an interrupt within a wrapper
        if isinstance(function, type):
            if dataclasses.is_dataclass(function) and "__init__" in vars(function):
                function.__init__ = decorate(function.__init__)
            return function
        code = id(function.__code__)
        if "<locals>" in function.__qualname__:
            made[code] += 1
            if not _is_sampled(made[code]):
                return function
        checked = None  # until the first call: most functions are never called

        @wraps(function)
        def call(*args, **options):
            nonlocal checked
            calls[code] += 1
            if not _is_sampled(calls[code]):
                return function(*args, **options)
            checked = checked or check_all(function, typechecker=typechecker)
            return checked(*args, **options)

        return call

    return decorate


if find_spec("beartype"):
    jaxtyping.jaxtyped = check_some
    folders = [f"stages.core.{folder}" for folder in ("geometry", "scene", "physics", "models")]
    jaxtyping.install_import_hook(folders, "beartype.beartype")
