"""Which objects a GSCollision scene has and where they start.

Source: the NGFF paper, appendix on GSCollision, and the public sampling code (seed 42): objects are drawn with
replacement, take their scale prior, are never turned, and each is put near one that is there already. There is no
explicit tower or containment: both come from the small horizontal offsets.
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

SEED = 42
HALF_EXTENT = 0.9  # bounding spheres stay within this cube [m]
MIN_GAP = 0.05  # least distance between points of two objects, and between centres [m]
MAX_OFFSET = 0.1  # how far aside of the object it is put near, in scenes of up to 4 [m]
MAX_PLACEMENTS, MAX_DRAWS = (
    500,
    200,
)  # for an object, before the scene is begun again; and of its objects, before it is given up
HELDOUT = "heldout"  # group of scenes of eight other objects, that no model learns from
VARIED, SOLID, ROTATED = "varied", "solid", "turned"  # of objects at random, solid ones, and the ten turned at random
EXTRA_GROUPS = (VARIED, SOLID, ROTATED)  # groups in no published set that may be learned from
MORE_GROUPS = {f"more_{i}": 300 for i in range(10)}  # of three objects, in no published set: to learn more from
SCENE_COUNTS = {
    **{f"3_{i}": 300 for i in range(10)},
    "4": 100,
    "6": 100,
    **MORE_GROUPS,
}  # groups, and how many scenes each has


@dataclass(frozen=True)
class SceneConfig:
    """A scene: object ids in the order of their Gaussians, offsets [m] and scales."""

    name: str
    ids: tuple[int, ...]
    translation: tuple[tuple[float, float, float], ...]
    scale: tuple[float, ...]


@dataclass(frozen=True)
class PlacementExtent:
    """Points of an object at its scale prior, about the centre of its bounding box [m]."""

    points: np.ndarray  # (n, 3)
    scale: float

    @cached_property
    def half(self) -> np.ndarray:
        return np.abs(self.points).max(0)

    @cached_property
    def radius(self) -> float:
        """Half the diagonal of the bounding box."""
        return float(np.linalg.norm(self.half))

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.points)


def sample_group(group: str, extents: Mapping[int, PlacementExtent]) -> dict[str, SceneConfig]:
    """All scenes of a group, the same for ever: each has a seed of its own."""
    count, first = object_count(group), 300 * int(group.split("_")[1]) if "_" in group else 0
    first += 3000 * (group in MORE_GROUPS)
    made = (sample_scene(first + i, count, extents) for i in range(SCENE_COUNTS[group]))
    return {c.name: c for c in made}


def perturbed(configs: Mapping[str, SceneConfig], by: float) -> dict[str, SceneConfig]:
    """The same scenes with every object put aside by `by` [m], each in a direction of its own."""
    out = {}
    for name, c in configs.items():
        rng = np.random.default_rng([SEED, len(c.ids), int(name.partition("_")[0]), 1])
        aside = rng.normal(size=(len(c.ids), 3))
        moved = np.array(c.translation) + by * aside / np.linalg.norm(aside, axis=1, keepdims=True)
        out[name] = replace(c, translation=tuple(tuple(p) for p in moved.tolist()))
    return out


def object_count(group: str) -> int:
    """How many objects the scenes of a group have. Raises InputError for a group that is not there."""
    if group not in SCENE_COUNTS:
        raise InputError(f"--groups {group}: there are {', '.join(SCENE_COUNTS)}")
    return 3 if group in MORE_GROUPS else int(group.split("_")[0])


def parse_groups(text: str, more: tuple[str, ...] = ()) -> list[str]:
    """ "3_0..3_2,4" -> ["3_0", "3_1", "3_2", "4"]; `more` are names of others that may be asked for."""
    out: list[str] = []
    for part in text.split(","):
        span = re.fullmatch(r"(\w+)_(\d)\.\.\1_(\d)", part.strip())
        names = [f"{span[1]}_{i}" for i in range(int(span[2]), int(span[3]) + 1)] if span else [part.strip()]
        for name in names:
            if name not in more:
                object_count(name)
            if name not in out:
                out.append(name)
    return out


def sample_scene(index: int, count: int, extents: Mapping[int, PlacementExtent]) -> SceneConfig:
    """Scene `index` with `count` objects."""
    rng = np.random.default_rng([SEED, count, index])
    ids = sorted(extents)
    for _ in range(MAX_DRAWS):
        chosen = [int(i) for i in rng.choice(ids, count)]
        at = _placed(rng, chosen, extents)
        if at is not None:
            names = "_".join(str(i) for i in chosen)
            places = tuple(tuple(float(v) for v in p) for p in at)
            return SceneConfig(f"{index}_{names}", tuple(chosen), places, tuple(extents[i].scale for i in chosen))
    raise InputError(
        f"of these objects no {count} find room beside each other in {2 * HALF_EXTENT} m; take smaller ones"
    )


def _placed(rng, chosen: list[int], extents: Mapping[int, PlacementExtent]) -> list | None:
    """Offsets of the objects, the first at the origin; None where one found no room."""
    at = [np.zeros(3)]
    for k, i in enumerate(chosen[1:], start=1):
        for _ in range(MAX_PLACEMENTS):
            near = int(rng.integers(k))
            aside = MAX_OFFSET if len(chosen) <= 4 else extents[i].half[:2] + extents[chosen[near]].half[:2]
            p = np.append(at[near][:2] + rng.uniform(-1, 1, 2) * aside, rng.uniform(-HALF_EXTENT, HALF_EXTENT))
            if np.abs(p).max() + extents[i].radius > HALF_EXTENT:
                continue
            if all(_apart(p - q, extents[i], extents[j]) for q, j in zip(at, chosen, strict=False)):
                at.append(p)
                break
        else:
            return None
    return at


def _apart(offset: np.ndarray, mine: PlacementExtent, theirs: PlacementExtent) -> bool:
    """Whether bounding boxes do not overlap, and centres and points keep their distance."""
    if (np.abs(offset) < mine.half + theirs.half).all() or np.linalg.norm(offset) < MIN_GAP:
        return False
    near = (np.abs(mine.points + offset) < theirs.half + MIN_GAP).all(1)
    if not near.any():
        return True
    distance, _ = theirs.tree.query(mine.points[near] + offset, distance_upper_bound=MIN_GAP)
    return not np.isfinite(distance).any()


def write_scene_configs(path: Path, configs: Mapping[str, SceneConfig]) -> None:
    """As the public code reads them."""
    rows = {c.name: {"scene_object_idxs": c.ids, "translation": c.translation, "scale": c.scale}
            for c in configs.values()}  # fmt: skip
    with replacing(path) as part:
        part.write_text(json.dumps(rows, indent=1) + "\n")


def read_scene_configs(path: Path) -> dict[str, SceneConfig]:
    """Raises InputError for what is no such file."""
    must_exist(path, "scene configurations (.json)")
    try:
        rows = json.loads(Path(path).read_text())
        return {
            name: SceneConfig(name, tuple(int(i) for i in row["scene_object_idxs"]),
                         tuple(tuple(float(v) for v in p) for p in row["translation"]),
                         tuple(float(s) for s in row["scale"]))
            for name, row in rows.items()
        }  # fmt: skip
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is not a file of scene configurations ({error!r})") from error
