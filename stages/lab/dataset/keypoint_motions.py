"""Keypoint trajectories for training: the keypoints of many scenes in every frame, and the objects' materials.

A file NAME.h5 holds one group of scenes:

    attributes    format = "ngff-motions", version, dt [s], gravity [m/s^2], box (2,3) [m], provenance (JSON)
    names (s)     objects (s,o) ids of GSCollision, -1: no object
    points        (s,t,o,n,3) int16, in units of `step` [m] (an attribute of the dataset)
    mass E nu friction solidity (s,o)     [kg] [Pa] - - -; without solidity, all bodies are hollow or thin
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path

import h5py
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.models.initial_conditions import InitialConditions
from stages.core.scene.files import must_exist, replacing
from stages.core.scene.h5_schema import Dataset, open_h5
from stages.core.scene.h5_text import check_attributes
from stages.core.scene.schema import MAX_OBJECT_ID, number, numbers, parse_json, quote, reason

FORMAT, VERSION = "ngff-motions", 1
POSITION_STEP = 1e-4  # quantisation of the stored positions [m]: int16 spans 3.2 m around the origin
COMPRESSION_LEVEL = 1  # zlib level
MAX_THREADS = 8  # maximum number of compression threads
FILE_KIND = "keypoint trajectories (.h5), such as `ngff-lab dataset` writes"


@dataclass(frozen=True)
class KeypointMotions:
    """Keypoint trajectories of s scenes with up to o objects of n keypoints each, over t frames."""

    names: tuple[str, ...]
    objects: Int[Tensor, "s o"]  # GSCollision ids; -1: no object
    points: Float[Tensor, "s t o n 3"]  # [m]; 0 where there is no object
    mass: Float[Tensor, "s o"]  # mass of each object [kg]
    E: Float[Tensor, "s o"]  # Young's modulus of each object [Pa]
    nu: Float[Tensor, "s o"]  # Poisson's ratio
    friction: Float[Tensor, "s o"]  # Coulomb coefficient
    dt: float  # between frames [s]
    gravity: tuple[float, float, float]  # acceleration of gravity [m/s^2]
    box: tuple[tuple[float, float, float], tuple[float, float, float]]  # lower and upper corner of the walls [m]
    solidity: Float[Tensor, "s o"]  # stiffness relative to a hollow or thin body of the same material

    def __len__(self) -> int:
        return len(self.names)

    @property
    def present(self) -> Bool[Tensor, "s o"]:
        """Mask of the objects that exist."""
        return self.objects >= 0

    def __getitem__(self, rows: Int[Tensor, "r"] | slice) -> KeypointMotions:
        index = torch.arange(len(self))[rows].tolist()
        tensors = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name in TENSORS}
        return replace(self, names=tuple(self.names[i] for i in index), **tensors)

    def to(self, device: torch.device | str) -> KeypointMotions:
        """The same motions with all tensors on a device."""
        return replace(self, **{name: getattr(self, name).to(device) for name in TENSORS})

    def initial_conditions(self, keypoints: int | None = None) -> InitialConditions:
        """First frame of the scenes, with the first `keypoints` of each object (they are in farthest-point order)."""
        rest = self.points[:, 0, :, :keypoints]
        valid = self.present[..., None].expand(rest.shape[:-1])
        return InitialConditions.of(
            rest, valid, mass=self.mass, E=self.E, nu=self.nu, friction=self.friction, solidity=self.solidity,
            gravity=torch.tensor(self.gravity), box=torch.tensor(self.box),
        )  # fmt: skip


DATASETS = {  # schema of the file; s scenes, t frames, o objects, n keypoints
    "names": Dataset("s", "text"),
    "objects": Dataset("s o", "int", -1, MAX_OBJECT_ID),
    "points": Dataset("s t o n 3", "int"),
    "mass": Dataset("s o", low=0),
    "E": Dataset("s o", low=0, high=1e13),
    "nu": Dataset("s o", low=-1, high=0.5),
    "friction": Dataset("s o", low=0),
    "solidity": Dataset("s o", low=0),
}
TENSORS = ("objects", "points", "mass", "E", "nu", "friction", "solidity")


def concatenate_motions(parts: Sequence[KeypointMotions]) -> KeypointMotions:
    """All scenes of several groups; scenes with fewer objects than the maximum are padded."""
    max_objects = max(p.objects.shape[1] for p in parts)

    def padded(p: KeypointMotions, name: str) -> Tensor:
        x, axis = getattr(p, name), 2 if name == "points" else 1
        shape = list(x.shape)
        shape[axis] = max_objects - shape[axis]
        fill = -1 if name == "objects" else 0 if name == "points" else 1
        return torch.cat([x, x.new_full(shape, fill)], axis)

    tensors = {name: torch.cat([padded(p, name) for p in parts]) for name in TENSORS}
    return replace(parts[0], names=tuple(n for p in parts for n in p.names), **tensors)


class KeypointMotionsWriter:
    """Writes the scenes of a group batch by batch; the file appears only on success.

    Threads compress the scenes while the next batch is simulated. All scenes must have the same shape. Leaving the
    context raises InputError if no scene was appended.
    """

    def __init__(self, path: Path, provenance: dict):
        self.path, self._provenance = Path(path), provenance
        self._parts: list[KeypointMotions] = []
        self._compressed: list[Future[bytes]] = []
        self._pool = ThreadPoolExecutor(min(MAX_THREADS, os.cpu_count() or 1))

    def __enter__(self) -> KeypointMotionsWriter:
        return self

    def append(self, part: KeypointMotions) -> None:
        """Add the scenes of one batch."""
        steps = (part.points / POSITION_STEP).round().clamp(-32767, 32767).to(torch.int16).cpu().numpy()
        self._compressed += [self._pool.submit(_compress, scene) for scene in steps]
        self._parts.append(replace(part, points=torch.empty(*part.points.shape[:-1], 0)))  # keeps only the shape

    def __exit__(self, kind, error, trace) -> None:
        with self._pool as pool:
            if kind is not None:
                pool.shutdown(wait=True, cancel_futures=True)
            else:
                self._write()

    def _write(self) -> None:
        count = sum(len(p) for p in self._parts)
        if not count:
            raise InputError(
                f"{self.path}: the simulation of every scene failed; choose a shorter --substep or the published --dx"
            )
        first = self._parts[0]
        with replacing(self.path) as part, h5py.File(part, "w") as file:
            file.attrs.update(format=FORMAT, version=VERSION, dt=first.dt, gravity=first.gravity, box=first.box,
                              provenance=json.dumps(self._provenance))  # fmt: skip
            file.create_dataset("names", data=[n for p in self._parts for n in p.names], dtype=h5py.string_dtype())
            shape = (*first.points.shape[1:4], 3)
            data = file.create_dataset("points", (count, *shape), "<i2", chunks=(1, *shape), compression="gzip",
                                       compression_opts=COMPRESSION_LEVEL, shuffle=True)  # fmt: skip
            for row, chunk in enumerate(self._compressed):
                data.id.write_direct_chunk((row, 0, 0, 0, 0), chunk.result())
            data.attrs["step"] = POSITION_STEP
            for name in TENSORS:
                if name != "points":
                    file[name] = torch.cat([getattr(p, name) for p in self._parts]).cpu().numpy()


def _compress(steps: np.ndarray) -> bytes:
    """A chunk in the form of HDF5's shuffle and gzip filters: all low bytes, then all high bytes, compressed."""
    shuffled = np.ascontiguousarray(steps, "<i2").view(np.uint8).reshape(-1, 2).T
    return zlib.compress(shuffled.tobytes(), COMPRESSION_LEVEL)


def write_motions(path: Path, motions: KeypointMotions, provenance: dict) -> None:
    """Write a group in a single batch."""
    with KeypointMotionsWriter(path, provenance) as file:
        file.append(motions)


def read_provenance(path: Path) -> dict:
    """The provenance stored in a file of keypoint trajectories. Raises InputError if the file cannot be read."""
    must_exist(path, FILE_KIND)
    try:
        with open_h5(path) as file:
            found = parse_json(str(file.attrs.get("provenance", "{}")), finite=False)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}); {FILE_KIND} is expected") from error
    return found if isinstance(found, dict) else {}


def read_motions(path: Path) -> KeypointMotions:
    """Read a file of keypoint trajectories. Raises InputError if it is missing or has another format."""
    must_exist(path, FILE_KIND)
    try:
        with open_h5(path) as file:
            if file.attrs.get("format") != FORMAT:
                raise InputError(f"{path}: its format attribute is {quote(repr(file.attrs.get('format')))}, not "
                                 f"{FORMAT!r}; {FILE_KIND} is expected")  # fmt: skip
            lengths: dict[str, int] = {}
            rows = {name: table.read(file, name, lengths) for name, table in DATASETS.items()
                    if name != "points" and (name in file or name != "solidity")}  # fmt: skip
            steps = DATASETS["points"].open(file, "points", lengths)
            if steps.dtype.itemsize != 2:
                raise ValueError(f"points has values of type {steps.dtype}, not int16")
            if not all(lengths.values()):
                raise ValueError("it holds no scene, frame, object or keypoint")
            check_attributes(file["points"])
            step = number(file["points"].attrs["step"], "the step of points", 1e-9, 1)
            tensors = {name: torch.from_numpy(rows[name]) for name in rows if name != "names"}
            tensors.setdefault("solidity", torch.ones(lengths["s"], lengths["o"]))
            return KeypointMotions(
                names=tuple(quote(name, 200) for name in rows["names"]), dt=number(file.attrs["dt"], "dt", 1e-6, 1e4),
                gravity=numbers(file.attrs["gravity"], 3, "gravity"),
                box=tuple(numbers(corner, 3, "box") for corner in np.asarray(file.attrs["box"]).reshape(2, -1)),
                points=torch.from_numpy(steps[()].astype(np.float32)) * step, **tensors,
            )  # fmt: skip
    except (KeyError, OSError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}); {FILE_KIND} is expected") from error


def motions_folder(folder: Path) -> Path:
    """The folder of a data set's motions: its subfolder `motions` if it exists, otherwise the folder itself."""
    inner = Path(folder) / "motions"
    return inner if inner.is_dir() else Path(folder)


def read_groups(folder: Path, names: Sequence[str], keypoints: int) -> KeypointMotions:
    """Read the scenes of NAME.h5 in a folder, with the first `keypoints` of each object.

    Raises InputError for missing files, too few keypoints, and groups with different numbers of frames.
    """
    folder = motions_folder(folder)
    missing = [f"{name}.h5" for name in names if not (folder / f"{name}.h5").is_file()]
    if missing:
        raise InputError(f"{folder}: there is no {', '.join(missing)}; generate the groups with `ngff-lab dataset`, or "
                         "name existing groups")  # fmt: skip
    parts = []
    for name in names:
        part = read_motions(folder / f"{name}.h5")
        if part.points.shape[3] < keypoints:
            raise InputError(f"{folder / name}.h5: has {part.points.shape[3]} keypoints per object; give at "
                             f"most as many, not {keypoints}")  # fmt: skip
        parts.append(replace(part, points=part.points[:, :, :, :keypoints].clone()))
    odd = next((n for n, p in zip(names, parts, strict=True) if p.points.shape[1] != parts[0].points.shape[1]), None)
    if odd:
        raise InputError(
            f"{folder / odd}.h5: has a different number of frames than {names[0]}.h5; use groups "
            "with the same number of frames"
        )
    return concatenate_motions(parts)
