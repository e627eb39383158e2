"""Functions that torch.compile treats as opaque operators."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps

import torch


def operator(name: str, shapes: Callable) -> Callable[[Callable], Callable]:
    """Decorate a function as the custom operator ngff::`name` while torch.compile traces; otherwise it runs directly.

    `shapes` takes the same arguments and returns uninitialised results, from which the compiler reads shapes and types.
    The function has no gradient. Direct calls avoid the overhead of a custom operator, which exceeds the time of these
    kernels, and the import of torch._dynamo on its first call, which takes over a second.
    """

    def decorate(function: Callable) -> Callable:
        traced = torch.library.custom_op(f"ngff::{name}", function, mutates_args=())
        traced.register_fake(shapes)

        @wraps(function)
        def call(*args):
            return traced(*args) if torch.compiler.is_compiling() else function(*args)

        return call

    return decorate
