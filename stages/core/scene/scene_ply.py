"""Scene files (scene.ply): a standard 3D-Gaussian PLY with object ids, and metadata as JSON in header comments.

The format is described in README.md.
"""

from __future__ import annotations

import io
import json
import logging
import re
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError

from stages.core.errors import InputError
from stages.core.scene import cameras as camera_json
from stages.core.scene.files import must_exist, replacing
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.packed_ply import is_packed, unpack
from stages.core.scene.scene import Scene, SceneObject, read_metadata, read_objects
from stages.core.scene.schema import LARGEST, MAX_OBJECT_ID, check_ply_counts, number, parse_json, reason
from stages.core.scene.sequence import read_sequence_json

log = logging.getLogger(__name__)
VERSION = 1
REQUIRED = ["x", "y", "z", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
COLOURS = [f"f_dc_{i}" for i in range(3)]
EXPECTED = "a 3D-Gaussian PLY, such as `ngff reconstruct` writes"


def read_scene(path: Path) -> Scene:
    """Read a 3D-Gaussian PLY of any tool (SH degree 0 to 3, either byte order, packed or not).

    Gaussians with a value that is not finite or beyond LARGEST, or with a zero quaternion, are dropped with a warning.
    Raises InputError for other files, files without Gaussians and newer versions.
    """
    path = Path(path)
    must_exist(path, EXPECTED)
    try:
        ply = PlyData.read(_ascii_header(path))
    except (PlyParseError, ValueError, OverflowError, MemoryError, IndexError) as error:
        why = reason(error)
        raise InputError(f"{path}: is not a readable PLY file ({why}); {EXPECTED} is expected") from error
    if "vertex" not in ply:
        raise InputError(f"{path}: has no element called vertex; {EXPECTED} is expected")
    if not len(ply["vertex"].data):
        raise InputError(f"{path}: contains no Gaussians; {EXPECTED} is expected")
    try:
        raw = unpack(ply) if is_packed(ply) else ply["vertex"].data
        gaussians = _activate(path, raw)
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise InputError(f"{path}: its properties are damaged ({reason(error)}); {EXPECTED} is expected") from error
    if not len(gaussians):
        raise InputError(f"{path}: contains no Gaussians; {EXPECTED} is expected")
    return _with_header(path, gaussians, ply.comments)


def _ascii_header(path: Path) -> str | io.BytesIO:
    """The input for plyfile: the path, or a copy in memory if comments are not ASCII, as from some other tools.

    Raises ValueError if the file is shorter than its header declares.
    """
    header = []
    with path.open("rb") as file:
        while line := file.readline(16 << 20):
            header.append(line.decode(errors="replace"))
            if line.strip() == b"end_header":
                check_ply_counts(header, path.stat().st_size - file.tell())
                text = "".join(header)
                if not text.isascii():  # JSON escapes, because the text may be an object's name in JSON
                    text = re.sub("[^\\x00-\\x7f]", lambda found: json.dumps(found[0])[1:-1], text)
                    return io.BytesIO(text.encode() + file.read())
                break
            if len(header) == 1 and line.strip() != b"ply":
                break  # plyfile reports the error
    return str(path)


def _activate(path: Path, raw: dict[str, np.ndarray] | np.ndarray) -> Gaussians:
    """Gaussians from the stored values (logits, log scales, unnormalised quaternions), in columns or rows."""
    stored = list(raw) if isinstance(raw, dict) else list(raw.dtype.names)
    missing = [name for name in REQUIRED + COLOURS if name not in stored]
    if missing:
        raise InputError(
            f"{path}: has no vertex property {', '.join(missing)}; {EXPECTED} is expected (this may be a plain "
            "point cloud)"
        )
    rest = sorted((n for n in stored if re.fullmatch(r"f_rest_[0-9]{1,3}", n)), key=lambda n: int(n.rsplit("_", 1)[1]))
    if len(rest) not in (0, 9, 24, 45):
        raise InputError(f"{path}: has {len(rest)} f_rest properties; SH of degree 1, 2 or 3 has 9, 24 or 45")
    table = torch.from_numpy(_columns(raw, REQUIRED + COLOURS + rest))
    n, quats = len(table), table[:, 7:11]
    sh = torch.cat([table[:, 11:14, None], table[:, 14:].reshape(n, 3, -1)], 2).mT.contiguous()  # channel-major
    ids = np.asarray(raw["object_id"]) if "object_id" in stored else np.zeros(n)
    if not ((ids >= 0) & (ids <= MAX_OBJECT_ID) & (ids == np.floor(ids))).all():
        raise ValueError(f"an object_id is not a whole number from 0 to {MAX_OBJECT_ID}")
    ids = torch.from_numpy(ids.astype(np.int64))
    keep = (table.abs() <= LARGEST).all(1) & (table[:, 4:7] <= np.log(LARGEST)).all(1) & (quats.norm(dim=1) > 1e-12)
    if not keep.all():
        dropped = int((~keep).sum())
        log.warning("%s: dropped %d Gaussians with values that are not finite, or far too large", path, dropped)
    everything = Gaussians(
        table[:, :3].contiguous(), torch.nn.functional.normalize(quats, dim=1), table[:, 4:7].exp(),
        table[:, 3].sigmoid(), sh, ids,
    )  # fmt: skip
    return everything if keep.all() else everything[keep]


def _columns(raw: dict[str, np.ndarray] | np.ndarray, names: list[str]) -> np.ndarray:
    """The values of the properties `names` as float32 (n, c)."""
    if isinstance(raw, np.ndarray) and raw.flags.c_contiguous:
        kinds = [raw.dtype[name] for name in raw.dtype.names]
        if all(kind == "<f4" or kind == "<i4" for kind in kinds) and all(raw.dtype[name] == "<f4" for name in names):
            rows = raw.view("<f4").reshape(len(raw), -1)  # one pass; a pass per property takes many times as long
            return rows.take([raw.dtype.names.index(name) for name in names], 1).astype(np.float32, copy=False)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([np.asarray(raw[name], np.float32) for name in names], 1)


def _with_header(path: Path, gaussians: Gaussians, comments: list[str]) -> Scene:
    """The scene with the metadata of the header comments `ngff:KEY JSON`; files of other tools have none."""
    metadata: dict[str, list] = {}
    try:
        for comment in comments:
            if comment.startswith("ngff:"):
                key, value = comment[5:].split(" ", 1)
                metadata.setdefault(key, []).append(parse_json(value, finite=key != "provenance"))

        def only(key: str, default: object = None) -> object:
            *more, value = metadata.get(key, [default])
            if more:
                raise ValueError(f"ngff:{key} is there more than once")
            return value

        version = number(only("version", VERSION), "version", 0)
        if version > VERSION:
            raise InputError(f"{path}: format version {version:g} is newer than {VERSION}; upgrade ngff")
        ids = gaussians.object_id.unique().tolist()
        objects = read_objects((o["id"], o["name"], o.get("material", "")) for o in metadata.get("object", []))
        named = {o.id: o for o in objects}
        unnamed = {i: SceneObject(i, f"object_{i}") for i in ids if i > 0 and i not in named}
        return Scene(
            gaussians,
            tuple(o for _, o in sorted((named | unnamed).items())),
            camera_json.from_json(metadata.get("camera", [])),
            **read_metadata(
                only("floor"),
                only("scale", {"metres_per_unit": 1.0, "source": "not stated in the file"}),
                only("provenance", {}),
                only("background"),
            ),
            sequence=read_sequence_json(only("sequence")),
        )
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        why = reason(error)
        raise InputError(f"{path}: a header comment ngff:KEY is damaged ({why}); write the file again") from error


def write_scene(path: Path, scene: Scene) -> None:
    """Write a binary little-endian 3D-Gaussian PLY with the metadata in comments.

    Raises InputError if that fails, or if `read_scene` would reject the metadata, such as a scale out of range.
    """
    try:
        read_metadata(scene.floor, scene.scale, scene.provenance, scene.background)
    except ValueError as error:
        raise InputError(f"{path}: cannot be written, as {reason(error)}") from error
    g = scene.gaussians.to("cpu")
    n, k = g.sh.shape[:2]
    rest = [f"f_rest_{i}" for i in range(3 * (k - 1))]
    names = ["x", "y", "z", "nx", "ny", "nz", *COLOURS, *rest, "opacity", *REQUIRED[4:7], *REQUIRED[7:]]
    opacity = g.opacities.double().clamp(1e-7, 1 - 1e-7).logit().float()[:, None]
    columns = [
        g.means, torch.zeros(n, 3), g.sh[:, 0], g.sh[:, 1:].mT.reshape(n, -1), opacity, g.scales.log(), g.quats
    ]  # fmt: skip
    rows = np.empty((n, len(names) + 1), "<f4")
    rows[:, :-1] = torch.cat(columns, 1).numpy()
    rows.view("<i4")[:, -1] = g.object_id.numpy()
    vertices = rows.view([(name, "<f4") for name in names] + [("object_id", "<i4")])[:, 0]
    ply = PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<", comments=_header(scene))
    with replacing(path) as part:
        ply.write(str(part))


def _header(scene: Scene) -> list[str]:
    metadata = [("version", VERSION), ("up", [0, 0, 1]), ("scale", scene.scale), ("floor", scene.floor)]
    metadata += [("background", scene.background)] if scene.background else []
    metadata += [("sequence", scene.sequence.to_json())] if scene.sequence else []
    metadata += [("object", {"id": o.id, "name": o.name, "material": o.material}) for o in scene.objects]
    metadata += [("camera", row) for row in (camera_json.to_json(scene.cameras) if scene.cameras else [])]
    metadata += [("provenance", scene.provenance)]
    return [f"ngff:{key} {json.dumps(value)}" for key, value in metadata]
