"""Sampling of GSCollision scenes: which objects they have, and where these start.

Objects are drawn with replacement, have their scale prior and are not rotated; each is placed near an earlier one.
Towers and containment are not constructed explicitly; both arise from the small horizontal offsets.
Source: the NGFF paper, appendix on GSCollision, and the public sampling code (seed 42).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from stages.core.errors import InputError
from stages.core.scene.files import must_exist, replacing
from stages.core.scene.schema import number, numbers, quote, read_json, reason, rows, whole
from stages.lab.dataset.selection import MORE_GROUPS, SCENE_COUNTS, object_count

SEED = 42  # seed of the published sampling code
HALF_EXTENT = 0.9  # half side of the cube that contains all bounding spheres [m]
MIN_GAP = 0.05  # smallest distance between points of two objects, and between their centres [m]
MAX_OFFSET = 0.1  # largest horizontal offset from an earlier object, per axis, in scenes of up to 4 objects [m]
MAX_PLACEMENTS = 500  # attempts to place an object before the objects of the scene are drawn again
MAX_DRAWS = 200  # largest number of times that the objects of a scene are drawn
SCENE_NAME = re.compile(r"[\w-][\w.-]{0,199}")  # no separators, not hidden, not ".."


@dataclass(frozen=True)
class SceneConfig:
    """A scene: object ids in the order of their Gaussians, start positions [m] and scales."""

    name: str
    ids: tuple[int, ...]
    translation: tuple[tuple[float, float, float], ...]
    scale: tuple[float, ...]


@dataclass(frozen=True)
class PlacementExtent:
    """Points of an object at its scale prior, relative to the centre of its bounding box [m]."""

    points: np.ndarray  # (n, 3)
    scale: float

    @cached_property
    def half(self) -> np.ndarray:
        """Half the sides of the bounding box (3,) [m]."""
        return np.abs(self.points).max(0)

    @cached_property
    def radius(self) -> float:
        """Half the diagonal of the bounding box [m]."""
        return float(np.linalg.norm(self.half))

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree over the points."""
        return cKDTree(self.points)


def sample_group(group: str, extents: Mapping[int, PlacementExtent]) -> dict[str, SceneConfig]:
    """All scenes of a group by name; deterministic, since each scene has its own seed."""
    count, first = object_count(group), 300 * int(group.split("_")[1]) if "_" in group else 0
    first += 3000 * (group in MORE_GROUPS)
    made = (sample_scene(first + i, count, extents) for i in range(SCENE_COUNTS[group]))
    return {c.name: c for c in made}


def perturbed(configs: Mapping[str, SceneConfig], distance: float) -> dict[str, SceneConfig]:
    """The same scenes with every object moved by `distance` [m], each in its own random direction."""
    out = {}
    for name, c in configs.items():
        rng = np.random.default_rng([SEED, len(c.ids), int(name.partition("_")[0]), 1])
        offset = rng.normal(size=(len(c.ids), 3))
        moved = np.array(c.translation) + distance * offset / np.linalg.norm(offset, axis=1, keepdims=True)
        out[name] = replace(c, translation=tuple(tuple(p) for p in moved.tolist()))
    return out


def sample_scene(index: int, count: int, extents: Mapping[int, PlacementExtent]) -> SceneConfig:
    """Scene `index` with `count` objects. Raises InputError if the objects are too large to be placed."""
    rng = np.random.default_rng([SEED, count, index])
    ids = sorted(extents)
    for _ in range(MAX_DRAWS):
        chosen = [int(i) for i in rng.choice(ids, count)]
        positions = _place_objects(rng, chosen, extents)
        if positions is not None:
            names = "_".join(str(i) for i in chosen)
            translation = tuple(tuple(float(v) for v in p) for p in positions)
            return SceneConfig(f"{index}_{names}", tuple(chosen), translation, tuple(extents[i].scale for i in chosen))
    raise InputError(
        f"{count} objects of this size could not be placed in a cube of {2 * HALF_EXTENT} m; give smaller objects"
    )


def _place_objects(
    rng: np.random.Generator, chosen: list[int], extents: Mapping[int, PlacementExtent]
) -> list[np.ndarray] | None:
    """Positions of the objects, the first at the origin; None if an object could not be placed."""
    positions = [np.zeros(3)]
    for k, i in enumerate(chosen[1:], start=1):
        for _ in range(MAX_PLACEMENTS):
            near = int(rng.integers(k))
            max_offset = MAX_OFFSET if len(chosen) <= 4 else extents[i].half[:2] + extents[chosen[near]].half[:2]
            p = np.append(
                positions[near][:2] + rng.uniform(-1, 1, 2) * max_offset, rng.uniform(-HALF_EXTENT, HALF_EXTENT)
            )
            if np.abs(p).max() + extents[i].radius > HALF_EXTENT:
                continue
            if all(_separated(p - q, extents[i], extents[j]) for q, j in zip(positions, chosen, strict=False)):
                positions.append(p)
                break
        else:
            return None
    return positions


def _separated(offset: np.ndarray, a: PlacementExtent, b: PlacementExtent) -> bool:
    """Whether object a at `offset` from b has a disjoint bounding box and keeps MIN_GAP from b's centre and points."""
    if (np.abs(offset) < a.half + b.half).all() or np.linalg.norm(offset) < MIN_GAP:
        return False
    near = (np.abs(a.points + offset) < b.half + MIN_GAP).all(1)
    if not near.any():
        return True
    distance, _ = b.tree.query(a.points[near] + offset, distance_upper_bound=MIN_GAP)
    return not np.isfinite(distance).any()


def write_scene_configs(path: Path, configs: Mapping[str, SceneConfig]) -> None:
    """Write scene configurations (.json) in the published format."""
    rows = {c.name: {"scene_object_idxs": c.ids, "translation": c.translation, "scale": c.scale}
            for c in configs.values()}  # fmt: skip
    with replacing(path) as part:
        part.write_text(json.dumps(rows, indent=1) + "\n")


def read_scene_configs(path: Path) -> dict[str, SceneConfig]:
    """Scene configurations by name from a JSON file.

    Raises InputError if it has another format, or a scene name that is not a plain file name, since names become
    files and folders of the data set.
    """
    must_exist(path, "scene configurations (.json)")
    try:
        table = read_json(path)
        configs = {name: _parse_row(name, row) for name, row in table.items()}
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RuntimeError, IndexError) as error:
        raise InputError(f"{path}: is not a file of scene configurations ({reason(error)})") from error
    if not configs:
        raise InputError(f"{path}: contains no scene configurations; give another file")
    wrong = next((name for name in configs if not SCENE_NAME.fullmatch(name)), None)
    if wrong is not None:
        raise InputError(f"{path}: the scene name {quote(repr(wrong))} cannot be a file name; use letters, digits, "
                         "'_', '-' and '.', such as 2700_0_7_11")  # fmt: skip
    return configs


def _parse_row(name: str, row: dict) -> SceneConfig:
    ids = tuple(whole(i, "scene_object_idxs") for i in rows(row["scene_object_idxs"], "scene_object_idxs"))
    if not len(ids) == len(rows(row["translation"], "translation")) == len(rows(row["scale"], "scale")) > 0:
        raise ValueError(f"{quote(name)} has {len(ids)} objects, and other numbers of translations or scales")
    translation = tuple(numbers(p, 3, "translation", -1e4, 1e4) for p in row["translation"])
    return SceneConfig(name, ids, translation, tuple(number(s, "scale", 1e-6, 1e6) for s in row["scale"]))
