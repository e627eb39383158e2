"""Fields of option classes that are options of a command line too: their default, help and limits stand here only.

`with_options` of ngff_cli/options.py makes the command line of them. Fields without `option` are for Python alone.
"""

from __future__ import annotations

from dataclasses import field
from typing import Any

from stages.core.backends import MAX_SEED


def option(default: Any, help: str, *flags: str, **limits: Any) -> Any:
    """A field of an option class that is an option of a command line, by default named after the field.

    Fields of type bool are flags, with a --no- form where the default is true; tuples are repeatable. `flags` replace
    the name; `limits` are further arguments of typer.Option, such as min and max.
    """
    return field(default=default, metadata={"help": help, "flags": flags, **limits})


def seed_option() -> Any:
    """The field `seed`."""
    return option(0, "random seed; the same seed and device give the same result", min=0, max=MAX_SEED)


def device_option() -> Any:
    """The field `device`."""
    return option("auto", "auto | cpu | cuda | cuda:N")


def photos_option(backends: str) -> Any:
    """The field `photos` of a stage of which these backends read photos."""
    return option(None, f"for {backends}: folder of the scene's photos; default: rendered images")


def download_option(backends: str) -> Any:
    """The field `download` of a stage of which these backends have published weights."""
    return option(False, f"for {backends}: download missing weights, after logging size and licence")
