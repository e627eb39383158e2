"""Cache results that depend only on a scene in the scene object itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps


class Results(dict):
    """Results by function and arguments. Pickling leaves them out, so a copy in another process starts without them."""

    def __reduce__(self) -> tuple:
        return Results, ()


def cached_in_scene(function: Callable) -> Callable:
    """Decorate a deterministic function of a scene (or keypoints) and hashable arguments to compute each result once.

    The scene object holds the results, so they live as long as it does; a scene made by `replace` starts without them.
    Do not change the scene or the results in place.
    """

    @wraps(function)
    def call(scene, *args, **options):
        held = scene.__dict__.setdefault("_cached", Results())  # bypasses the frozen dataclass
        key = (function, args, tuple(sorted(options.items())))
        if key not in held:
            held[key] = function(scene, *args, **options)
        return held[key]

    return call
