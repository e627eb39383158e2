"""Damaged and hostile files: random changes of small valid ones, given to the reader of their format.

The result of a case is `right` (read, and the values satisfy their types), `clear error` (an InputError of one short
line), `nonsense` (read, but the values do not), or `traceback` (any other exception).
"""

from __future__ import annotations

import json
import logging
import random
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import h5py
import numpy as np
import torch

from stages.core.errors import InputError
from stages.core.scene.cameras import Cameras, check_cameras, read_cameras
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.trajectory import (
    Binding,
    Keypoints,
    SimulationInfo,
    Trajectory,
    TrajectoryWriter,
    read_trajectory,
)

MAX_MESSAGE = 600  # characters of an error, without the path
NUMBERS = [0, -1, 1e-40, 1e20, 1e300, 10**12, 2**31 - 1, 2**31, 2**64, float("nan"), float("inf"), -float("inf")]
VALUES = [*NUMBERS, None, True, "abc", "", "\x1b[31m\n", "<script>", "../x", "x" * 5000, [], {}, [[]], [1, 2], {"a": 1}]
WORDS = [b"nan", b"inf", b"1000000000000", b"18446744073709551616", b"-1", b"list uchar int", b"double", b"ascii",
         b"\xff\xfe", b"f_rest_x", b"[" * 5000, b'"abc"', b"{}", b"0", b"end_header\n"]  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """A file format under test: a small valid file, how to change it, and its reader with a check of the result."""

    name: str
    write: Callable[[Path], None]
    change: Callable[[Path, random.Random], None]
    read: Callable[[Path], None]  # AssertionError for nonsense


def example_scene() -> Scene:
    """Sixty Gaussians, two objects, two cameras."""
    generator = torch.Generator().manual_seed(0)
    n = 60
    gaussians = Gaussians(
        torch.randn(n, 3, generator=generator),
        torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=1),
        torch.rand(n, 3, generator=generator) * 0.1 + 0.01, torch.rand(n, generator=generator) * 0.8 + 0.1,
        torch.randn(n, 4, 3, generator=generator), torch.arange(n) % 3,
    )  # fmt: skip
    K = torch.tensor([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]])
    cameras = Cameras(torch.eye(4).repeat(2, 1, 1), K.repeat(2, 1, 1), torch.tensor([[32, 24]] * 2), ("a.png", "b.png"))
    objects = (SceneObject(1, "duck", "rubber"), SceneObject(2, "bowl"))
    return Scene(gaussians, objects, cameras, 0.0, {"metres_per_unit": 1.0, "source": "known"}, {"seed": 1})


def write_trajectory(path: Path) -> None:
    """Three frames of twelve keypoints."""
    scene = example_scene()
    n, rest = len(scene.gaussians), torch.randn(12, 3, generator=torch.Generator().manual_seed(1))
    binding = Binding(torch.arange(n)[:, None] % 12, torch.ones(n, 1))
    info = SimulationInfo(0.02, (0.0, 0.0, -9.81), "test", ({"kind": "pin", "object_id": 1},))
    with TrajectoryWriter(path, scene, info, Keypoints(rest, torch.arange(12) % 2 + 1), binding) as writer:
        for _ in range(3):
            writer.append(rest, torch.zeros(2, 3), torch.eye(4)[:2])


def write_transforms(path: Path) -> None:
    """A transforms.json of two frames."""
    frames = [{"file_path": f"{name}.png", "transform_matrix": np.eye(4).tolist()} for name in "ab"]
    path.write_text(json.dumps({"fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 12.0, "w": 32, "h": 24, "k1": 0.1,
                                "frames": frames}))  # fmt: skip


def check_scene(scene: Scene) -> None:
    """AssertionError unless the values of a scene satisfy their types."""
    g = scene.gaussians
    assert len(g) and all(len(getattr(g, f.name)) == len(g) for f in fields(g)), "lengths differ"
    assert all(getattr(g, f.name).isfinite().all() for f in fields(g)), "not finite"
    assert g.means.dtype == g.scales.dtype == g.sh.dtype == torch.float32 and g.object_id.dtype == torch.int64, "types"
    assert g.sh.shape[1] in (1, 4, 9, 16) and (g.scales >= 0).all() and (g.quats.norm(dim=1) > 0).all(), "Gaussians"
    assert g.object_id.min() >= 0 and g.object_id.max() < 1 << 16 and g.means.abs().max() < 1e10, "ranges"
    assert scene.floor is None or isinstance(scene.floor, float) and abs(scene.floor) < 1e10, "floor"
    assert 0 < scene.metres_per_unit < 1e10 and all(o.name.isprintable() for o in scene.objects), "header"
    if scene.cameras is not None:
        check_cameras_of(scene.cameras)


def check_cameras_of(cameras: Cameras) -> None:
    """AssertionError unless cameras are rigid and finite."""
    try:
        check_cameras(cameras)
    except ValueError as error:
        raise AssertionError(str(error)) from error


def check_trajectory(t: Trajectory) -> None:
    """AssertionError unless the values of a trajectory satisfy their types."""
    check_scene(t.scene)
    assert len(t) and t.positions.shape == (len(t), len(t.keypoints.rest), 3), "positions"
    assert all(x.isfinite().all() for x in (t.positions, t.com, t.rotation, t.binding.weight, t.keypoints.rest)), "nan"
    assert t.binding.index.shape == t.binding.weight.shape and int(t.binding.index.max()) < t.positions.shape[1], "bind"
    assert 0 < t.info.dt < 1e5 and all(abs(x) < 1e10 for x in t.info.gravity), "info"


def change_bytes(path: Path, rng: random.Random) -> None:
    """Flip, cut, insert or repeat bytes, most often in the first two thousand, where headers are."""
    data = bytearray(path.read_bytes())
    for _ in range(rng.choice([1, 1, 2, 5])):
        if not data:
            break
        at = rng.randrange(min(len(data), 2000) if rng.random() < 0.7 else len(data))
        length = rng.choice([1, 4, 30])
        how = rng.randrange(5)
        if how == 0:
            data[at] = rng.randrange(256)
        elif how == 1:
            del data[at : at + length]
        elif how == 2:
            data[at : at + rng.choice([0, length])] = rng.choice(WORDS)
        elif how == 3:
            data[at:at] = data[at : at + length]
        else:
            del data[rng.randrange(len(data)) :]
    path.write_bytes(data)


def change_words(path: Path, rng: random.Random) -> None:
    """Replace a word of the text (of a PLY: of its header), or a few bytes."""
    if rng.random() < 0.4:
        return change_bytes(path, rng)
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    lines = head.split(b"\n")
    i = rng.randrange(len(lines))
    words = lines[i].split(b" ")
    words[rng.randrange(len(words))] = rng.choice(WORDS)
    changed = [b" ".join(words)]
    lines[i : i + 1] = rng.choice([changed, changed, changed, [], [lines[i]] * 2])
    path.write_bytes(b"\n".join(lines) + mark + body)


def change_vertices(path: Path, rng: random.Random) -> None:
    """A value of the properties of a PLY, or its text."""
    if rng.random() < 0.7:
        return change_words(path, rng)
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    values = np.frombuffer(body, "<f4").copy()
    with np.errstate(over="ignore"):
        values[rng.randrange(len(values)) :: rng.choice([1, 7, len(values)])] = np.float32(rng.choice(NUMBERS))
    path.write_bytes(head + mark + values.tobytes())


def change_json(path: Path, rng: random.Random) -> None:
    """Replace, remove or wrap a value somewhere in a JSON file, or change its bytes."""
    if rng.random() < 0.3:
        return change_words(path, rng)
    data = json.loads(path.read_text())
    places = list(_places(data))
    parent, key = rng.choice(places)
    if rng.random() < 0.15:
        del parent[key]
    else:
        parent[key] = rng.choice([*VALUES, [parent[key]], str(parent[key])])
    path.write_text(json.dumps(data))


def _places(data: object) -> Iterator[tuple]:
    keys = data.keys() if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
    for key in list(keys):
        yield data, key
        yield from _places(data[key])


def change_datasets(path: Path, rng: random.Random) -> None:
    """Another value, type, shape or kind of an attribute or object of an HDF5 file, or its bytes."""
    if rng.random() < 0.15:
        return change_bytes(path, rng)
    with h5py.File(path, "a") as file:
        names: list[str] = []
        file.visit(names.append)
        if rng.random() < 0.25:
            key = rng.choice(list(file.attrs))
            value = rng.choice([*NUMBERS, "abc", "", "[" * 5000, "{}", [0.0, float("nan"), 1], [1.0], "\x1b[1m"])
            file.attrs[key] = np.uint64(2**63) if isinstance(value, int) and value >= 2**63 else value
            return
        name = rng.choice(names)
        old = file[name][()] if isinstance(file[name], h5py.Dataset) else None
        del file[name]
        how = rng.randrange(10)
        if how == 0:
            return
        if how == 1:
            file.create_group(name)
        elif how == 2:
            file[name] = h5py.SoftLink(f"/{name}" if rng.random() < 0.5 else "/gaussians/means")
        elif how == 3:
            file[name] = h5py.ExternalLink("/etc/hostname", "/x")
        elif how == 4:
            file.create_dataset(name, (10**12, 3), chunks=(1000, 3), dtype=rng.choice(["f4", "f8", "i8"]))
        elif how == 5:
            file[name] = rng.choice([1.0, "text", np.zeros(0), np.zeros((2, 2), complex), h5py.Empty("f4")])
        elif old is None or not isinstance(old, np.ndarray) or not old.size or old.dtype == object:
            file[name] = np.zeros(3)
        elif how == 6:
            file[name] = old.astype(rng.choice(["f2", "f8", ">f4", "i1", ">i8", "u8", "S3", "?"]))
        elif how == 7:
            file[name] = rng.choice([old[:-1], old[..., :-1], old[None], old.reshape(-1), np.concatenate([old, old])])
        else:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                changed = old.astype("f8")
                changed.flat[rng.randrange(old.size) :: rng.choice([1, old.size])] = float(rng.choice(NUMBERS))
                file[name] = changed if rng.random() < 0.3 else changed.astype(old.dtype)


KINDS = (
    Kind("scene.ply", lambda path: write_scene(path, example_scene()), change_vertices,
         lambda path: check_scene(read_scene(path))),
    Kind("traj.h5", write_trajectory, change_datasets, lambda path: check_trajectory(read_trajectory(path))),
    Kind("transforms.json", write_transforms, change_json, lambda path: check_cameras_of(read_cameras(path)[0])),
)  # fmt: skip


def result_of(kind: Kind, path: Path) -> tuple[str, str]:
    """The result of reading a file, and what explains it."""
    try:
        kind.read(path)
    except InputError as error:
        text = str(error).replace(str(path), "")
        wrong = "\n" in text or len(text) > MAX_MESSAGE
        return ("nonsense", f"an error of {len(text)} characters: {text[:80]!r}") if wrong else ("clear error", text)
    except AssertionError as error:
        return "nonsense", str(error)
    except Exception:
        return "traceback", traceback.format_exc(limit=-3)
    return "right", ""


def run(folder: Path, count: int, seed: int = 0) -> tuple[Counter, list[str]]:
    """`count` cases in turn over all formats, in `folder`: how many of each format and result, and the failures."""
    counts, failures = Counter(), []
    valid = {}
    for kind in KINDS:
        kind.write(folder / kind.name)
        valid[kind.name] = (folder / kind.name).read_bytes()
    logging.getLogger("stages.core.scene").setLevel(logging.ERROR)  # dropped Gaussians
    try:
        for i in range(count):
            kind, path = KINDS[i % len(KINDS)], folder / KINDS[i % len(KINDS)].name
            path.write_bytes(valid[kind.name])
            kind.change(path, random.Random(f"{seed} {i}"))
            result, why = result_of(kind, path)
            counts[kind.name, result] += 1
            if result in ("nonsense", "traceback"):
                failures.append(f"{kind.name}, case {i} of seed {seed}: {result}: {why}")
    finally:
        logging.getLogger("stages.core.scene").setLevel(logging.NOTSET)
    return counts, failures
