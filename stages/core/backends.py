"""Tables of backends by name: a backend is a function, imported only when it is chosen."""

import gc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module

from stages.core.errors import InputError

MAX_SEED = 2**31 - 1  # largest seed that every library accepts


@dataclass(frozen=True)
class Backend:
    """Row of a backend table; help, error messages and `ngff-lab doctor` are derived from it."""

    entry: str  # "module:function"
    help: str  # one line
    find_weights: str = ""  # for a network: "module:function" that returns the path of its published weights
    network: str = ""  # for a promptable network: "module:function" that loads it, see stages/segment/prompted.py
    package: str = ""  # optional package that the backend needs
    extra: str = ""  # extra of this project that installs the package


def choose(table: Mapping[str, str | Backend], option: str, name: str) -> Callable:
    """Load the function that a table of "module:function" entries or `Backend` rows lists under `name`.

    Raises InputError if the table lacks the name; `option`, as typed on the command line, is for its message.
    """
    if name not in table:
        raise InputError(f"{option} {name}: choose from {', '.join(table)}")
    row = table[name]
    return load(row if isinstance(row, str) else row.entry)


def with_weights(table: Mapping[str, Backend]) -> str:
    """Names of the backends that run a published network, as "a or b"."""
    return " or ".join(name for name, row in table.items() if row.find_weights)


def describe(table: Mapping[str, Backend]) -> str:
    """Names and one-line help of all backends, for --help."""
    return "; ".join(f"{name}: {row.help}" for name, row in table.items())


def load(entry: str) -> Callable:
    """Import the function or class that a "module:name" string refers to.

    The garbage collector is paused: an import creates many objects but no garbage, and traversing them repeatedly takes
    a third of the time to import Warp.
    """
    module, name = entry.split(":")
    enabled = gc.isenabled()
    gc.disable()
    try:
        return getattr(import_module(module), name)
    finally:
        if enabled:
            gc.enable()


def pick_device(name: str) -> str:
    """The PyTorch device, "cpu" or "cuda", for --device auto, cpu, cuda or cuda:N, which makes GPU N the current one.

    Raises InputError for another name and for a missing GPU.
    """
    import torch  # takes a second to import, so only when a stage runs

    kind, _, number = name.partition(":")
    if kind not in ("auto", "cpu", "cuda") or (":" in name and (kind != "cuda" or not number.isdecimal())):
        raise InputError(f"--device {name}: choose from auto, cpu, cuda, or cuda:1 for the second GPU, and so on")
    if kind == "cuda" and not torch.cuda.is_available():
        raise InputError(f"--device {name}: PyTorch sees no NVIDIA GPU here; use --device cpu (see `ngff-lab doctor`)")
    if number and int(number) >= torch.cuda.device_count():
        raise InputError(f"--device {name}: PyTorch sees {torch.cuda.device_count()} GPUs here, numbered from 0")
    if number:
        torch.cuda.set_device(int(number))
    return "cuda" if kind != "cpu" and torch.cuda.is_available() else "cpu"
