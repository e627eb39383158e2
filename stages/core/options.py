"""Fields of option classes that are also command-line options, with their default, help and limits in one place.

`with_options` of ngff_cli/options.py turns them into a command line. Fields without `option` are available only from
Python.
"""

from __future__ import annotations

from dataclasses import field
from typing import Any

from stages.core.backends import MAX_SEED


def option(default: Any, help: str, *flags: str, **limits: Any) -> Any:
    """A field of an option class that is also a command-line option, by default named after the field.

    Fields of type bool are flags, with a --no- form if the default is true; tuples are repeatable options. `flags`
    replace the name; `limits` are further arguments of typer.Option, such as min and max.
    """
    return field(default=default, metadata={"help": help, "flags": flags, **limits})


def seed_option() -> Any:
    """The field `seed`."""
    return option(0, "random seed; the same seed and device give the same result", min=0, max=MAX_SEED)


def device_option() -> Any:
    """The field `device`."""
    return option("auto", "auto | cpu | cuda | cuda:N")


def photos_option(backends: str) -> Any:
    """The field `photos` of a stage in which these backends read photos."""
    return option(None, f"for {backends}: folder of the scene's photos; default: rendered images")


def download_option(backends: str) -> Any:
    """The field `download` of a stage in which these backends have published weights."""
    return option(False, f"for {backends}: download missing weights, after logging size and licence")
