"""Results that depend on a scene alone, computed once for each scene object."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps


class Results(dict):
    """Results by function and arguments; a copy in another process starts without them."""

    def __reduce__(self) -> tuple:
        return Results, ()


def cached_in_scene(function: Callable) -> Callable:
    """A deterministic function of a scene, or its keypoints, and of hashable arguments that computes each result once.

    The scene object holds the results, so that they live as long as it does; a scene made by `replace` has none. Do not
    change the scene or the results in place.
    """

    @wraps(function)
    def call(scene, *args, **options):
        held = scene.__dict__.setdefault("_cached", Results())  # apart from the fields, which are frozen
        key = (function, args, tuple(sorted(options.items())))
        if key not in held:
            held[key] = function(scene, *args, **options)
        return held[key]

    return call
