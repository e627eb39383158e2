"""Limits in tests: of the sizes of files, which simulates a full disk, and of the values of options."""

import resource
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import pytest

from stages.core.errors import InputError


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """Limit the size of every file to `size` bytes, which a program notices like a full disk.

    Bytecode is not written meanwhile, because Python before 3.12.8 would keep a truncated file that cannot be imported.
    """
    (soft, hard), wrote = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    sys.dont_write_bytecode = True
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        sys.dont_write_bytecode = wrote


def check_limits(options: type, name: str, accepted: Iterable, refused: Iterable) -> None:
    """Check that an option has the values `accepted`, and that errors for values `refused` begin with its name."""
    for value in accepted:
        assert getattr(options(**{name: value}), name) == value
    for value in refused:
        with pytest.raises(InputError, match="^--" + name.replace("_", "-")):
            options(**{name: value})
