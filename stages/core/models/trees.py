"""Tensors held in named tuples and dataclasses: scenes, states, pushes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

from torch import Tensor


def tensors(tree: Any) -> Iterator[Tensor]:
    """All tensors in tuples and dataclasses, in order."""
    if isinstance(tree, Tensor):
        yield tree
    elif is_dataclass(tree):
        for f in fields(tree):
            yield from tensors(getattr(tree, f.name))
    elif isinstance(tree, tuple):
        for x in tree:
            yield from tensors(x)


def rebuilt(tree: Any, new: Iterator[Tensor]) -> Any:
    """The same with other tensors."""
    if isinstance(tree, Tensor):
        return next(new)
    if is_dataclass(tree):
        return replace(tree, **{f.name: rebuilt(getattr(tree, f.name), new) for f in fields(tree)})
    if isinstance(tree, tuple):
        parts = [rebuilt(x, new) for x in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return tree
