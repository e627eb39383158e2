"""Limits of what counts as an object, and parameters of grouping. Light to import, since command options use them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ObjectLimits:
    """What counts as an object."""

    max_objects: int = 24
    min_size: float = 0.03  # minimum longest side of an object [distance of the cameras from what they look at]


@dataclass(frozen=True)
class GroupingOptions(ObjectLimits):
    """Parameters of geometric grouping."""

    detail: float = 0.41  # largest dissimilarity of two regions of one object; smaller values give more objects
    seed: int = 0
