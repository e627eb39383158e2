"""Trajectory files (traj.h5): the motion of a scene and everything needed to render it; format in README.md."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import h5py
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.scene.cameras import MAX_SIDE, Cameras, check_cameras
from stages.core.scene.error_deferring_file import ErrorDeferringFile
from stages.core.scene.field_start import FieldStart, read_field_start, write_field_start
from stages.core.scene.files import must_exist, replacing
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.h5_chunks import COMPRESSED, append_rows, read_compressed, write_compressed
from stages.core.scene.h5_schema import Dataset, attribute, find_link, open_h5
from stages.core.scene.prompt_rows import read_prompts
from stages.core.scene.scene import Scene, read_metadata, read_objects
from stages.core.scene.schema import MAX_OBJECT_ID, number, numbers, parse_json, quote, reason

log = logging.getLogger(__name__)
FORMAT, VERSION = "ngff-trajectory", 1
EXPECTED = "a trajectory (.h5), such as `ngff simulate` writes"
DATASETS = {  # n Gaussians, k coefficients, o objects, p keypoints, t frames, c cameras, j keypoints of a Gaussian
    "gaussians/means": Dataset("n 3"),
    "gaussians/quats": Dataset("n 4"),
    "gaussians/scales": Dataset("n 3", low=0),
    "gaussians/opacities": Dataset("n", low=-1e-3, high=1.001),  # as rounded by 16-bit floats
    "gaussians/sh": Dataset("n k 3"),
    "gaussians/object_id": Dataset("n", "int", 0, MAX_OBJECT_ID),
    "objects/id": Dataset("o", "int", 1, MAX_OBJECT_ID),
    "objects/name": Dataset("o", "text"),
    "objects/material": Dataset("o", "text"),
    "objects/com": Dataset("t o 3"),
    "objects/rotation": Dataset("t o 4"),
    "objects/confidence": Dataset("t o", low=0, high=1),
    "keypoints/rest": Dataset("p 3"),
    "keypoints/object_id": Dataset("p", "int", 0, MAX_OBJECT_ID),
    "keypoints/positions": Dataset("t p 3"),
    "binding/index": Dataset("b j", "int", -1),  # b equals n unless there are dense frames
    "binding/weight": Dataset("b j", low=-1e-3, high=1.001),
    "cameras/viewmats": Dataset("c 4 4"),
    "cameras/Ks": Dataset("c 3 3"),
    "cameras/sizes": Dataset("c 2", "int", 1, MAX_SIDE),
    "cameras/names": Dataset("c", "text"),
    "forces/json": Dataset("f", "text"),
    "frames/means": Dataset("t n 3"),
    "frames/quats": Dataset("t n 4"),
    "frames/scales": Dataset("t n 3", low=0),
}
SERIES = ("keypoints/positions", "objects/com", "objects/rotation")  # datasets with one row per frame
BUFFERED = 32  # frames that are compressed and written together
ROUNDING = 1e-2  # tolerance of weight sums and quaternion norms, which are stored in 16-bit floats


@dataclass(frozen=True)
class Keypoints:
    """Points of the objects whose motion is simulated; the Gaussians follow them."""

    rest: Float[Tensor, "p 3"]  # positions in the rest frame [m]
    object_id: Int[Tensor, "p"]


@dataclass(frozen=True)
class Binding:
    """The keypoints that each Gaussian follows: weights sum to 1; unused entries have index -1 and weight 0."""

    index: Int[Tensor, "n j"]
    weight: Float[Tensor, "n j"]


@dataclass(frozen=True)
class SimulationInfo:
    """Settings of the simulation that made a trajectory."""

    dt: float  # time between frames [s]
    gravity: tuple[float, float, float]  # [scene units / s^2]
    engine: str
    forces: tuple[dict, ...] = ()  # applied prompts, as JSON-serialisable dicts


@dataclass(frozen=True)
class Trajectory:
    """A trajectory in memory. Dense frames stay in the file and are read one at a time."""

    scene: Scene
    info: SimulationInfo
    keypoints: Keypoints
    binding: Binding
    positions: Float[Tensor, "t p 3"]  # of the keypoints [scene units]
    com: Float[Tensor, "t o 3"]  # centres of mass [scene units]
    rotation: Float[Tensor, "t o 4"]  # w x y z, relative to the rest frame
    path: Path
    dense: bool = False  # whether the file stores every Gaussian in every frame
    field: FieldStart | None = None  # initial conditions of the learned engine, if it simulated the motion
    confidence: Float[Tensor, "t o"] | None = None  # of a tracked motion; 0: object lost. None: all certain
    plausibility: dict | None = None  # measures of the simulation: {"objects": {id: {name: x}}, name: x}

    def __len__(self) -> int:
        return len(self.positions)

    def frame(self, t: int) -> Gaussians:
        """Read all Gaussians of frame t from the file; requires `dense`. Raises InputError if the frame is damaged."""
        with h5py.File(self.path, "r") as file:
            names = [f"frames/{name}" for name in ("means", "quats", "scales")]
            try:
                values = (DATASETS[name].checked(read_compressed(file[name], t), name) for name in names)
                rows = [torch.from_numpy(v) for v in values]
                _check_unit(rows[1], names[1])
            except (OSError, ValueError) as error:
                raise InputError(f"{self.path}: frame {t} is damaged ({reason(error)})") from error
        g = self.scene.gaussians
        return Gaussians(*rows, opacities=g.opacities, sh=g.sh, object_id=g.object_id)


class TrajectoryWriter:
    """Context manager that writes a trajectory frame by frame; the file appears only on success.

    If an InputError ends the run, the frames before it are kept as NAME.partial.h5. Raises InputError if the file
    cannot be written.
    """

    def __init__(self, path: Path, scene: Scene, info: SimulationInfo, keypoints: Keypoints, binding: Binding):
        self.path, self.frames = Path(path), 0
        self._buffer: list[tuple[np.ndarray, ...]] = []  # frames not yet in the file
        self._contents = scene, info, keypoints, binding

    def __enter__(self) -> TrajectoryWriter:
        self._replacing = replacing(self.path)
        self._part = self._replacing.__enter__()
        try:
            self._raw = ErrorDeferringFile(self._part, "w+b")
            self._file = h5py.File(self._raw, "w")
            _write_gaussians(self._file, self._contents[0].gaussians)
            _write_rest(self._file, *self._contents)
            self._raw.check()
        except BaseException as error:
            if hasattr(self, "_file"):
                self._close()
            self._replacing.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def append(
        self, positions: Float[Tensor, "p 3"], com: Float[Tensor, "o 3"], rotation: Float[Tensor, "o 4"]
    ) -> None:
        """Write one frame: keypoint positions, and centre of mass and rotation (w x y z) of each object."""
        self._buffer.append(tuple(row.detach().cpu().numpy().copy() for row in (positions, com, rotation)))
        self.frames += 1
        if len(self._buffer) == BUFFERED:
            self._write_buffer()
        self._raw.check()

    def _write_buffer(self) -> None:
        if self._buffer:
            for name, rows in zip(SERIES, zip(*self._buffer, strict=True), strict=True):
                append_rows(self._file[name], np.stack(rows))
        self._buffer.clear()

    @property
    def part(self) -> Path:
        """The file while it is being written, readable after `store_prompts`."""
        return self._part

    def restart(self) -> None:
        """Drop all frames and all prompts added since the start."""
        self.frames = 0
        self._buffer.clear()
        for name in SERIES:
            self._file[name].resize(0, axis=0)
        self._file["forces/json"].resize(len(self._contents[1].forces), axis=0)

    def store_prompts(self, prompts: Sequence[dict]) -> None:
        """Append the prompts that are not stored yet, and flush the file; `prompts` begins with the stored ones."""
        self._write_buffer()
        self._raw.check()
        data = self._file["forces/json"]
        stored = data.shape[0]
        data.resize(len(prompts), axis=0)
        if len(prompts) > stored:
            data[stored:] = [json.dumps(f) for f in prompts[stored:]]
        self._file.flush()
        self._raw.check()

    def store_provenance(self, facts: dict) -> None:
        """Replace the provenance, to add facts that are known only at the end of the run."""
        self._file.attrs["provenance"] = json.dumps(facts)
        self._raw.check()

    def store_field(self, start: FieldStart | None) -> None:
        """Write the initial conditions of the learned engine; None: another engine was used."""
        if start is not None:
            write_field_start(self._file, start)
            self._raw.check()

    def store_confidence(self, confidence: Float[Tensor, "t o"]) -> None:
        """Store the confidence of a tracked motion, see Trajectory.confidence."""
        write_compressed(self._file, "objects/confidence", confidence.cpu().numpy())
        self._raw.check()

    def store_plausibility(self, measures: dict) -> None:
        """Store the plausibility measures of a simulation, see Trajectory.plausibility."""
        self._raw.check()
        self._file.attrs["plausibility"] = json.dumps(measures)
        self._raw.check()

    def _close(self) -> None:
        self._file.close()
        self._raw.close()

    def __exit__(self, kind, error, trace) -> None:
        if self._raw.error is None:
            self._write_buffer()
        self._close()
        if kind is None and self._raw.error is not None:
            kind, error = OSError, self._raw.error
        if kind is not None and issubclass(kind, InputError) and self.frames:
            kept = self.path.with_name(f"{self.path.stem}.partial.h5")
            self._part.replace(kept)
            log.warning("%s: contains the %d frames simulated before the error", kept, self.frames)
        self._replacing.__exit__(kind, error, trace)


def _write_gaussians(file: h5py.File, gaussians: Gaussians) -> None:
    for field in fields(Gaussians):
        write_compressed(file, f"gaussians/{field.name}", getattr(gaussians, field.name).cpu().numpy())


def _write_rest(file: h5py.File, scene: Scene, info: SimulationInfo, keypoints: Keypoints, binding: Binding) -> None:
    file.attrs.update(
        format=FORMAT, version=VERSION, fps=1 / info.dt, dt=info.dt, gravity=info.gravity, up="z",
        units="scene units, seconds", engine=info.engine, scale=json.dumps(scene.scale),
        provenance=json.dumps(scene.provenance), **({} if scene.floor is None else {"floor": scene.floor}),
        **({} if scene.background is None else {"background": scene.background}),
    )  # fmt: skip
    file["objects/id"] = np.array([o.id for o in scene.objects], np.int64)
    text = h5py.string_dtype()
    file.create_dataset("objects/name", data=[o.name for o in scene.objects], dtype=text)
    file.create_dataset("objects/material", data=[o.material for o in scene.objects], dtype=text)
    write_compressed(file, "keypoints/rest", keypoints.rest.cpu().numpy())
    write_compressed(file, "keypoints/object_id", keypoints.object_id.cpu().numpy())
    write_compressed(file, "binding/index", binding.index.cpu().numpy().astype(np.int32))
    write_compressed(file, "binding/weight", binding.weight.cpu().numpy())
    p, o = len(keypoints.rest), len(scene.objects)
    for name, shape in zip(SERIES, ((p, 3), (o, 3), (o, 4)), strict=True):
        chunk = (1, *(max(s, 1) for s in shape))
        file.create_dataset(name, (0, *shape), maxshape=(None, *shape), chunks=chunk, dtype="f4", **COMPRESSED)
    if scene.cameras is not None:
        for name in ("viewmats", "Ks", "sizes"):
            file[f"cameras/{name}"] = getattr(scene.cameras, name).cpu().numpy()
        file.create_dataset("cameras/names", data=list(scene.cameras.names), dtype=text)
    prompts = [json.dumps(f) for f in info.forces]
    file.create_dataset("forces/json", data=prompts, dtype=text, shape=(len(prompts),), maxshape=(None,), chunks=(64,))


def _check_unit(quats: Float[Tensor, "*n 4"], name: str) -> None:
    if not ((quats.norm(dim=-1) - 1).abs() < ROUNDING).all():
        raise ValueError(f"{name} has a quaternion that is not of length 1")


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory without its dense frames. Raises InputError for other, damaged and newer files."""
    path = Path(path)
    must_exist(path, EXPECTED)
    try:
        with open_h5(path) as file:
            kind = attribute(file, "format", "")
            if kind != FORMAT:
                kind = quote(repr(kind))
                raise InputError(f"{path}: its format attribute is {kind}, not {FORMAT!r}; {EXPECTED} is expected")
            version = number(attribute(file, "version"), "version", 0)
            if version > VERSION:
                raise InputError(f"{path}: version {version:g} is newer than {VERSION}; upgrade ngff")
            return _read(path, file)
    except KeyError as error:
        raise InputError(f"{path}: a part of the trajectory is missing ({quote(error.args[0])}); for the format see "
                         "stages/core/scene/README.md") from error  # fmt: skip
    except (OSError, ValueError, TypeError, RuntimeError, MemoryError) as error:  # h5py raises any of these
        why = reason(error)
        raise InputError(f"{path}: is not a readable HDF5 file ({why}); {EXPECTED} is expected") from error


def _read(path: Path, file: h5py.File) -> Trajectory:
    lengths: dict[str, int] = {}

    def values(name: str) -> Tensor | list[str]:
        found = DATASETS[name].read(file, name, lengths)
        return found if isinstance(found, list) else torch.from_numpy(found)

    def has(name: str) -> bool:
        return find_link(file, name) is not None

    keypoints = Keypoints(values("keypoints/rest"), values("keypoints/object_id"))
    motion = (values("keypoints/positions"), values("objects/com"), values("objects/rotation"))
    gaussians = Gaussians(**{f.name: values(f"gaussians/{f.name}") for f in fields(Gaussians)})
    if not len(motion[0]) or not len(gaussians):
        raise InputError(f"{path}: has no {'Gaussians' if len(motion[0]) else 'frames'}; simulate again")
    if lengths["k"] not in (1, 4, 9, 16):
        raise ValueError(f"gaussians/sh has {lengths['k']} coefficients, not 1, 4, 9 or 16")
    _check_unit(gaussians.quats, "gaussians/quats")
    _check_unit(motion[2], "objects/rotation")
    dense = has("frames/means")
    if dense:
        for name in ("means", "quats", "scales"):
            DATASETS[f"frames/{name}"].open(file, f"frames/{name}", lengths)
    binding = Binding(values("binding/index"), values("binding/weight"))
    if not dense and (len(binding.index) != lengths["n"] or bool((binding.index >= lengths["p"]).any())):
        raise InputError(f"{path}: the binding does not fit the {lengths['n']} Gaussians and {lengths['p']} keypoints")
    bound = binding.index >= 0
    if not (bound | (binding.weight.abs() < ROUNDING)).all():
        raise ValueError("binding/weight has a weight without a keypoint")
    if not (((binding.weight.sum(1) - 1).abs() < ROUNDING) | ~bound.any(1)).all():
        raise ValueError("binding/weight has a row that does not sum to 1")
    ids = values("objects/id").tolist()
    materials = values("objects/material") if has("objects/material") else [""] * len(ids)
    objects = read_objects(zip(ids, values("objects/name"), materials, strict=True))
    cameras = None
    if has("cameras/viewmats"):
        *matrices, names = (values(f"cameras/{n}") for n in ("viewmats", "Ks", "sizes", "names"))
        cameras = check_cameras(Cameras(*matrices, tuple(quote(name, 255) for name in names)))
    scale = parse_json(str(attribute(file, "scale", '{"metres_per_unit": 1.0, "source": "not stated"}')))
    made_by = parse_json(str(attribute(file, "provenance", "{}")), finite=False)
    metadata = read_metadata(attribute(file, "floor", None), scale, made_by, attribute(file, "background", None))
    scene = Scene(gaussians, objects, cameras, **metadata)
    texts = values("forces/json") if has("forces/json") else []
    forces = read_prompts(map(parse_json, texts), ids)
    dt, gravity = number(attribute(file, "dt"), "dt", 1e-6, 1e4), numbers(attribute(file, "gravity"), 3, "gravity")
    info = SimulationInfo(dt, gravity, quote(attribute(file, "engine")), forces)
    measures = _read_plausibility(parse_json(str(attribute(file, "plausibility", "{}"))))
    confidence = values("objects/confidence") if has("objects/confidence") else None
    return Trajectory(
        scene, info, keypoints, binding, *motion, path, dense, read_field_start(file, lengths), confidence, measures
    )


def _read_plausibility(measures: object) -> dict | None:
    """The plausibility measures of a file, or None if there are none. Raises ValueError unless all are numbers >= 0."""
    if not isinstance(measures, dict) or not isinstance(measures.get("objects", {}), dict):
        raise ValueError("plausibility is not a JSON object with objects")
    groups = {**measures.get("objects", {}), "": {k: v for k, v in measures.items() if k != "objects"}}
    if not all(isinstance(group, dict) for group in groups.values()):
        raise ValueError("plausibility has an object whose measures are not a JSON object")
    read = {id: {quote(name, 40): number(value, "plausibility", 0) for name, value in group.items()}
            for id, group in groups.items()}  # fmt: skip
    overall = read.pop("")
    return {"objects": read, **overall} if measures else None
