"""Random changes to files: to bytes, words, JSON values, and values and types in binary formats."""

from __future__ import annotations

import json
import random
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

# replacement values for numbers, for any JSON value, and for words in text
NUMBERS = [0, 1, 2, 0.5, -1, 1e-40, 1e20, 1e300, 10**12, 2**31 - 1, 2**31, 2**64, float("nan"), float("inf"),
           -float("inf")]  # fmt: skip
VALUES = [*NUMBERS, None, True, "abc", "", "\x1b[31m\n", "<script>", "../x", "x" * 5000, [], {}, [[]], [1, 2], {"a": 1}]
WORDS = [b"nan", b"inf", b"1000000000000", b"18446744073709551616", b"-1", b"list uchar int", b"double", b"ascii",
         b"\xff\xfe", b"f_rest_x", b"[" * 5000, b'"abc"', b"{}", b"0", b"end_header\n"]  # fmt: skip


def change_bytes(path: Path, rng: random.Random) -> None:
    """Change, delete, insert, repeat or truncate bytes, mostly among the first 2000, which contain headers."""
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
    """Replace a word of the text (in a PLY: of its header), or change a few bytes."""
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
    """Change a value of a PLY's properties, a value of the JSON in its comments, or its text."""
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().split("\n")
    comments = [i for i, line in enumerate(lines) if line.startswith("comment ngff:")]
    if rng.random() < 0.5:
        return change_words(path, rng)
    if comments and rng.random() < 0.6:
        i = rng.choice(comments)
        key, _, value = lines[i].partition(" ")[2].partition(" ")
        changed = f"comment {key} {_other_json(value, rng)}"
        lines[i : i + 1] = [lines[i], changed] if rng.random() < 0.2 else [changed]
        path.write_bytes("\n".join(lines).encode() + mark + body)
    else:
        path.write_bytes(head + mark + _other_floats(body, rng))


def change_json(path: Path, rng: random.Random) -> None:
    """Replace, remove or wrap a random value in a JSON file, or change its bytes."""
    if rng.random() < 0.3:
        return change_words(path, rng)
    path.write_text(_other_json(path.read_text(), rng))


def _other_json(text: str, rng: random.Random) -> str:
    """A JSON text with a random value removed, wrapped, or replaced by another of its values or by one of VALUES."""
    data = [json.loads(text)]
    places = list(_places(data))
    parent, key = rng.choice(places[1:] or places)
    if rng.random() < 0.15 and parent is not data:
        del parent[key]
    else:
        other, place = rng.choice(places)
        parent[key] = json.loads(json.dumps(rng.choice([*VALUES, [parent[key]], str(parent[key]), other[place]])))
    return json.dumps(data[0])


def _places(data: object) -> Iterator[tuple]:
    keys = data.keys() if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
    for key in list(keys):
        yield data, key
        yield from _places(data[key])


def change_datasets(path: Path, rng: random.Random) -> None:
    """Change value, type, shape or kind of an attribute or object of an HDF5 file, or its bytes."""
    if rng.random() < 0.15:
        return change_bytes(path, rng)
    with h5py.File(path, "a") as file:
        names: list[str] = []
        file.visit(names.append)
        if rng.random() < 0.25:
            key = rng.choice(list(file.attrs))
            if key in ("scale", "provenance") and rng.random() < 0.7:
                file.attrs[key] = _other_json(file.attrs[key], rng)
                return
            value = rng.choice([*NUMBERS, "abc", "", "[" * 5000, "{}", [0.0, float("nan"), 1], [1.0], "\x1b[1m"])
            file.attrs[key] = np.uint64(2**63) if isinstance(value, int) and value >= 2**63 else value
            return
        name = rng.choice(names)
        old = file[name][()] if isinstance(file[name], h5py.Dataset) else None
        if name == "forces/json" and rng.random() < 0.7:
            rows = file[name].asstr()[()]
            i = rng.randrange(len(rows))
            file[name][i] = _other_json(rows[i], rng)
            return
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


def change_doubles(path: Path, rng: random.Random) -> None:
    """Overwrite a 32- or 64-bit number at a random position, or change bytes."""
    data = bytearray(path.read_bytes())
    if rng.random() < 0.4 or len(data) < 16:
        return change_bytes(path, rng)
    for _ in range(rng.choice([1, 1, 3])):
        at = rng.randrange(len(data) - 8) // rng.choice([1, 4]) * rng.choice([1, 4]) % (len(data) - 8)
        value = rng.choice(NUMBERS)
        if isinstance(value, int):
            new = struct.pack(rng.choice(["<q", "<Q"]), value) if 0 <= value < 2**63 else b"\xff" * rng.choice([4, 8])
        else:
            with np.errstate(over="ignore"):
                new = np.array([value]).astype(rng.choice(["<f4", "<f8"])).tobytes()
        data[at : at + len(new)] = new
    path.write_bytes(bytes(data))


def change_tensors(path: Path, rng: random.Random) -> None:
    """Change the header or the values of a .safetensors file, or its bytes."""
    if rng.random() < 0.3:
        return change_bytes(path, rng)
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    if rng.random() < 0.4:
        return path.write_bytes(data[: 8 + size] + _other_floats(data[8 + size :], rng)) and None
    header = json.loads(data[8 : 8 + size])
    parent, key = rng.choice(list(_places(header)))
    parent[key] = rng.choice([*VALUES, "F16", "F64", "I8", "F8_E4M3", [2, 2], [10**12]])
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])


def change_arrays(path: Path, rng: random.Random) -> None:
    """Change a value, type or shape of an array in an NPZ file, or its bytes."""
    if rng.random() < 0.3:
        return change_bytes(path, rng)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    name = rng.choice(list(arrays))
    old, how = arrays[name], rng.randrange(6)
    if how == 0:
        del arrays[name]
    elif how == 1:
        arrays[name] = old[None] if rng.random() < 0.5 or not old.ndim else old[:-1]
    elif how == 2 and old.dtype.kind != "U":
        with np.errstate(all="ignore"):
            arrays[name] = old.astype(rng.choice(["f2", "f8", ">f4", "i1", "u8", "S3", "?", "c16", "U5"]))
    elif how == 3:
        arrays[name] = rng.choice([np.zeros(0), np.array(np.nan), np.array("abc"), np.zeros((2, 2, 2, 2))])
    elif old.size and old.dtype.kind in "fiu":
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            changed = old.astype("f8").reshape(-1)
            changed[rng.randrange(old.size) :: rng.choice([1, old.size])] = float(rng.choice(NUMBERS))
            arrays[name] = changed.astype(old.dtype).reshape(old.shape)
    with path.open("wb") as file:
        (np.savez if rng.random() < 0.7 else np.savez_compressed)(file, **arrays)


def _other_floats(body: bytes, rng: random.Random) -> bytes:
    """The bytes of 32-bit floats with one value, every seventh, or all replaced, from a random position on."""
    values = np.frombuffer(body[: len(body) // 4 * 4], "<f4").copy()
    with np.errstate(over="ignore"):
        values[rng.randrange(len(values)) :: rng.choice([1, 7, len(values)])] = np.float32(rng.choice(NUMBERS))
    return values.tobytes() + body[len(body) // 4 * 4 :]
