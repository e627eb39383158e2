"""Parsing of names that select parts of the data set: groups of scenes, parts, views and backgrounds."""

import re

from stages.core.errors import InputError

HELDOUT = "heldout"  # group of scenes with eight other objects that are never trained on
# groups of random hollow shapes, random solid shapes, rotated objects, and objects made from meshes
VARIED, SOLID, ROTATED, MESHES = "varied", "solid", "turned", "meshes"
EXTRA_GROUPS = (VARIED, SOLID, ROTATED, MESHES)  # unpublished groups that may be trained on; also varied_1, ...
MORE_GROUPS = {f"more_{i}": 300 for i in range(10)}  # unpublished groups of scenes with three objects, for training
SCENE_COUNTS = {**{f"3_{i}": 300 for i in range(10)}, "4": 100, "6": 100, **MORE_GROUPS}  # number of scenes per group
PARTS = ("scene_configs", "motions", "objects", "backgrounds", "scenes", "mpm", "initial", "dynamic")
ORBIT_VIEWS = 100  # number of cameras around a scene, each of which is a frame of an initial video
VIDEO_VIEWS = tuple(range(0, ORBIT_VIEWS, 4))  # cameras of the dynamic videos


def object_count(group: str) -> int:
    """Number of objects in each scene of a group. Raises InputError for an unknown group."""
    if group not in SCENE_COUNTS:
        raise InputError(f"--groups {group}: choose from {', '.join(SCENE_COUNTS)}")
    return 3 if group in MORE_GROUPS else int(group.split("_")[0])


def parse_groups(text: str, more: tuple[str, ...] = ()) -> list[str]:
    """Parse --groups: "3_0..3_2,4" -> ["3_0", "3_1", "3_2", "4"].

    `more` are further allowed names, which may have a number appended. Raises InputError for an unknown group.
    """
    out: list[str] = []
    for part in text.split(","):
        span = re.fullmatch(r"(\w+)_(\d)\.\.\1_(\d)", part.strip())
        names = [f"{span[1]}_{i}" for i in range(int(span[2]), int(span[3]) + 1)] if span else [part.strip()]
        for name in names:
            if re.sub(r"_\d+$", "", name) not in more:
                object_count(name)
            if name not in out:
                out.append(name)
    return out


def parse_parts(text: str) -> tuple[str, ...]:
    """Parse --parts: "mpm, scenes" -> ("scenes", "mpm"), in order of generation. Raises InputError if unknown."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = next((name for name in names if name not in PARTS), None)
    if unknown is not None or not names:
        raise InputError(f"--parts {unknown or text!r}: choose from {', '.join(PARTS)}")
    return tuple(p for p in PARTS if p in names)


def parse_views(text: str) -> tuple[int, ...]:
    """Parse --views: "0,16" -> (0, 16); "all" gives the 25 published views. Raises InputError for other cameras."""
    if text == "all":
        return VIDEO_VIEWS
    names = [name.strip() for name in text.split(",")]
    if not all(name.isdigit() and int(name) in VIDEO_VIEWS for name in names):
        raise InputError(f"--views {text}: multiples of 4 from 0 to {VIDEO_VIEWS[-1]}, separated by commas, or all")
    return tuple(sorted({int(name) for name in names}))


def parse_backgrounds(text: str) -> tuple[str, ...]:
    """Parse --backgrounds: "table0,table3" -> ("table0", "table3"); "all" gives all. Raises InputError if unknown."""
    from stages.lab.assets.backgrounds import BACKGROUNDS  # imports PyTorch, which would slow down --help

    names = tuple(BACKGROUNDS) if text == "all" else tuple(name.strip() for name in text.split(","))
    unknown = next((name for name in names if name not in BACKGROUNDS), None)
    if unknown is not None:
        raise InputError(f"--backgrounds {unknown}: choose from {', '.join(BACKGROUNDS)}, or all")
    return tuple(dict.fromkeys(names))
