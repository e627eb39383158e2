"""Backends as tables of names: a backend is a function, imported only when it is chosen."""

from collections.abc import Callable, Mapping
from importlib import import_module

from stages.core.errors import InputError


def choose(table: Mapping[str, str], name: str) -> Callable:
    """The function that a table of "module:function" entries lists under `name`; InputError for an unknown name."""
    if name not in table:
        raise InputError(f"no backend called {name!r}; choose from {', '.join(table)}")
    return load(table[name])


def load(entry: str) -> Callable:
    """The function or class that a "module:name" string refers to, imported now."""
    module, name = entry.split(":")
    return getattr(import_module(module), name)


def pick_device(name: str) -> str:
    """The PyTorch device for --device auto, cpu or cuda; InputError for another name or without a GPU."""
    import torch  # takes a second to import, so only when a stage runs

    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {name}: choose from auto, cpu, cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: PyTorch sees no NVIDIA GPU here; use --device cpu (see `ngff-lab doctor`)")
    return "cuda" if name != "cpu" and torch.cuda.is_available() else "cpu"
