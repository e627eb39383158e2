"""Traversal of nested tuples and dataclasses of tensors (scenes, states, external forces)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

from torch import Tensor


def leaf_tensors(tree: Any) -> Iterator[Tensor]:
    """Yield all tensors in nested tuples and dataclasses, in order."""
    if isinstance(tree, Tensor):
        yield tree
    elif is_dataclass(tree):
        for f in fields(tree):
            yield from leaf_tensors(getattr(tree, f.name))
    elif isinstance(tree, tuple):
        for x in tree:
            yield from leaf_tensors(x)


def replace_tensors(tree: Any, new: Iterator[Tensor]) -> Any:
    """Return the same structure with its tensors replaced, in the order of `leaf_tensors`."""
    if isinstance(tree, Tensor):
        return next(new)
    if is_dataclass(tree):
        return replace(tree, **{f.name: replace_tensors(getattr(tree, f.name), new) for f in fields(tree)})
    if isinstance(tree, tuple):
        parts = [replace_tensors(x, new) for x in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return tree
