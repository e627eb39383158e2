"""Simulated motion for training: the keypoints of many scenes in every frame, with what the objects are made of.

A file NAME.h5 holds one group of scenes:

    attributes    format = "ngff-motions", version, dt [s], gravity [m/s^2], box (2,3) [m], provenance (JSON)
    names (s)     objects (s,o) ids of GSCollision, -1 where there is none
    points        (s,t,o,n,3) int16, in steps of `step` [m] (an attribute of the dataset)
    mass E nu friction (s,o)     [kg] [Pa] - -
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import h5py
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.errors import InputError
from stages.models.world import World
from stages.scene.files import must_exist, replacing

FORMAT, VERSION = "ngff-motions", 1
STEP = 1e-4  # of the stored positions [m]: they reach 3.2 m from the origin
WHAT = "simulated motion (.h5), such as `ngff-lab dataset` writes"


@dataclass(frozen=True)
class Motions:
    """Scenes of up to o objects with n keypoints each."""

    names: tuple[str, ...]
    objects: Int[Tensor, "s o"]  # -1: none
    points: Float[Tensor, "s t o n 3"]  # [m]; 0 where there is no object
    mass: Float[Tensor, "s o"]  # [kg]
    E: Float[Tensor, "s o"]  # [Pa]
    nu: Float[Tensor, "s o"]
    friction: Float[Tensor, "s o"]
    dt: float  # between frames [s]
    gravity: tuple[float, float, float]  # [m/s^2]
    box: tuple[tuple[float, float, float], tuple[float, float, float]]  # of the room [m]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def present(self) -> Bool[Tensor, "s o"]:
        return self.objects >= 0

    def __getitem__(self, rows: Int[Tensor, "r"] | slice) -> Motions:
        index = torch.arange(len(self))[rows].tolist()
        tensors = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name in TENSORS}
        return replace(self, names=tuple(self.names[i] for i in index), **tensors)

    def to(self, device: torch.device | str) -> Motions:
        return replace(self, **{name: getattr(self, name).to(device) for name in TENSORS})

    def world(self, keypoints: int | None = None) -> World:
        """The scenes at rest, with the first so many keypoints (they come farthest first)."""
        rest = self.points[:, 0, :, :keypoints]
        valid = self.present[..., None].expand(rest.shape[:-1])
        return World.of(
            rest, valid, mass=self.mass, E=self.E, nu=self.nu, friction=self.friction,
            gravity=torch.tensor(self.gravity), box=torch.tensor(self.box),
        )  # fmt: skip


TENSORS = ("objects", "points", "mass", "E", "nu", "friction")


def joined(parts: Sequence[Motions]) -> Motions:
    """All scenes of several groups; fewer objects than the most are padded."""
    most = max(p.objects.shape[1] for p in parts)

    def padded(p: Motions, name: str) -> Tensor:
        x, axis = getattr(p, name), 2 if name == "points" else 1
        shape = list(x.shape)
        shape[axis] = most - shape[axis]
        fill = -1 if name == "objects" else 0 if name == "points" else 1
        return torch.cat([x, x.new_full(shape, fill)], axis)

    tensors = {name: torch.cat([padded(p, name) for p in parts]) for name in TENSORS}
    return replace(parts[0], names=tuple(n for p in parts for n in p.names), **tensors)


def write_motions(path: Path, motions: Motions, provenance: dict) -> None:
    """Atomically, compressed, positions in steps of 0.1 mm."""
    with replacing(path) as part, h5py.File(part, "w") as file:
        file.attrs.update(format=FORMAT, version=VERSION, dt=motions.dt, gravity=motions.gravity, box=motions.box,
                          provenance=json.dumps(provenance))  # fmt: skip
        file.create_dataset("names", data=list(motions.names), dtype=h5py.string_dtype())
        steps = (motions.points / STEP).round().clamp(-32767, 32767).cpu().numpy().astype(np.int16)
        chunk = (1, *steps.shape[1:])
        packed = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
        data = file.create_dataset("points", data=steps, chunks=chunk, **packed)
        data.attrs["step"] = STEP
        for name in TENSORS:
            if name != "points":
                file[name] = getattr(motions, name).cpu().numpy()


def read_motions(path: Path) -> Motions:
    """Raises InputError for what is no such file."""
    must_exist(path, WHAT)
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise InputError(f"{path}: its format attribute is {file.attrs.get('format')!r}, not {FORMAT!r}; {WHAT}"
                                 " is expected")  # fmt: skip
            points = torch.from_numpy(file["points"][:]).float() * float(file["points"].attrs["step"])
            rest = {name: torch.from_numpy(file[name][:]) for name in TENSORS if name != "points"}
            box = tuple(tuple(float(v) for v in corner) for corner in file.attrs["box"])
            gravity = tuple(float(v) for v in file.attrs["gravity"])
            return Motions(tuple(file["names"].asstr()[:]), points=points, dt=float(file.attrs["dt"]), gravity=gravity,
                           box=box, **rest)  # fmt: skip
    except (KeyError, OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); {WHAT} is expected") from error
