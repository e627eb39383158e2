"""Conversion of textured meshes to Gaussians: points on the faces, coloured by texture, vertices or faces."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from stages.core.errors import InputError, MissingPackage
from stages.core.scene.files import must_exist
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.schema import parse_json, reason
from stages.lab.assets.field_sampling import diffuse_light, normalise_size
from stages.lab.assets.mesh_files import MESH_SUFFIXES
from stages.lab.assets.shapes import Surface, single_threaded, to_gaussians
from stages.lab.assets.winding import winding_signs

log = logging.getLogger(__name__)
UP_ROTATIONS = {"x": [[0, 1, 0], [0, 0, 1], [1, 0, 0]], "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
           "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}  # fmt: skip
COMPRESSIONS = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"}
MAX_VERTICES = 10**7  # largest count of a glTF accessor without data, which is read as zeros
MIN_AREA = 1e-9  # smallest total area of all faces [longest sides^2]; smaller values are rounding errors


def read_mesh(files: Path | Sequence[Path], count: int, up: str = "auto", light: bool = True) -> Gaussians:
    """About `count` flat Gaussians on the faces of an object, z up, centred, with longest side 1 and object_id 1.

    The object consists of all meshes in the files, in their common coordinates. `up` is the axis that points up
    (auto: y for glTF, as its standard defines, otherwise z). `light` bakes the soft light of the generated objects into
    the colours of the file. Raises MissingPackage without trimesh, and InputError if a file cannot be read or has no
    faces, or an argument is invalid.
    """
    files = [Path(path) for path in ([files] if isinstance(files, str | Path) else files)]
    path = files[0]
    wrong = next((p for p in files if p.suffix.lower() not in MESH_SUFFIXES), None)
    if wrong is not None:
        raise InputError(f"{wrong}: is not a readable mesh file; supported suffixes: {' '.join(MESH_SUFFIXES)}")
    if up not in (*UP_ROTATIONS, "auto"):
        raise InputError(f"--up {up}: choose from auto, x, y, z")
    if count < 100:
        raise InputError(f"--count {count}: give at least 100 Gaussians")
    up = ("y" if path.suffix.lower() in (".glb", ".gltf") else "z") if up == "auto" else up
    meshes = [mesh for path in files for mesh in _load(path)]
    with single_threaded():
        points, normals, rgb = _sample_faces(files, meshes, 5 * count)
        keep = _poisson_disk_subset(points, normals, count)
        R = torch.tensor(UP_ROTATIONS[up], dtype=torch.float32)
        surface = Surface(points[keep] @ R.mT, normals[keep] @ R.mT)
        colours = rgb[keep] * diffuse_light(surface)[:, None] if light else rgb[keep]
        return normalise_size(to_gaussians(surface, colours, 1, width=0.62))


def _load(path: Path) -> list:
    """The triangle meshes of a file, transformed by its scene graph."""
    must_exist(path, "a mesh")
    try:
        import trimesh  # an optional extra
    except ImportError as error:
        raise MissingPackage(f"{path}: reading meshes needs trimesh: `pip install 'ngff[mesh]'`") from error
    if path.suffix.lower() in (".glb", ".gltf"):
        _check_gltf(path)
    try:
        scene = trimesh.load_scene(path, process=False)  # processing would merge vertices closer than 1e-8
        meshes = [m for m in scene.dump() if isinstance(m, trimesh.Trimesh) and len(m.faces)]
    except Exception as error:  # trimesh's readers raise many types of exceptions
        raise InputError(f"{path}: cannot be read as a mesh ({error}); export it again") from error
    if not meshes:
        raise InputError(f"{path}: contains no triangles; give a mesh with faces (this may be a point cloud)")
    if any(m.vertices.shape[1] != 3 for m in meshes):
        raise InputError(f"{path}: has vertices without three coordinates; export it again as a 3D mesh")
    if not all(np.isfinite(m.triangles).all() for m in meshes):
        raise InputError(f"{path}: has vertices that are not finite; repair the mesh or export it again")
    if any(m.visual.kind == "texture" and m.visual.uv is not None and _texture(m) is None for m in meshes):
        log.info("%s: has no texture that can be read for some faces; they have the colour of their material", path)
    return meshes


def _check_gltf(path: Path) -> None:
    """InputError for compressed glTF, which would be read as empty, and for more vertices than the file can hold."""
    data = path.read_bytes()
    if data[:4] == b"glTF":  # binary: a header of 12 bytes, then the length and kind of the first chunk, which is JSON
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    try:
        gltf = parse_json(data.decode("utf-8-sig"), finite=False)
        packed = COMPRESSIONS & {*gltf.get("extensionsRequired", [])}
        zeros = max((a["count"] for a in gltf.get("accessors", []) if "bufferView" not in a), default=0)
        if zeros > MAX_VERTICES:
            raise ValueError(f"it declares {zeros} vertices without data")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: cannot be read as a mesh ({reason(error)}); export it again") from error
    if packed:
        raise InputError(f"{path}: is compressed ({', '.join(sorted(packed))}); export it without compression")


def _sample_faces(files: Sequence[Path], meshes: list, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (n, 3), unit normals (n, 3) and colours (n, 3) of about n points, uniform over the faces.

    The bounding box is centred, with longest side 1. Raises InputError naming the first of `files` if there is no area.
    """
    triangles = np.concatenate([np.asarray(mesh.triangles, np.float64) for mesh in meshes])
    low, high = triangles.min((0, 1)), triangles.max((0, 1))
    triangles = (triangles - (low + high) / 2) / max((high - low).max(), np.finfo(float).tiny)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    if not np.linalg.norm(cross, axis=1).sum() > MIN_AREA:
        raise InputError(f"{files[0]}: its triangles have no area, as all vertices are on a line; export it again as a "
                         "surface")  # fmt: skip
    cross *= winding_signs(triangles)[:, None]
    sizes = [len(mesh.faces) for mesh in meshes]
    parts = list(zip(meshes, *(torch.from_numpy(t).split(sizes) for t in (triangles, cross)), strict=True))
    area = torch.stack([cross.norm(dim=1).sum() for _, _, cross in parts])
    counts = (n * area / area.sum()).ceil().long().tolist()
    generator, rows = torch.Generator().manual_seed(n), []
    for (mesh, corners, cross), m in zip(parts, counts, strict=True):
        if not m:
            continue
        edges = cross.norm(dim=1).cumsum(0)
        # stratified: one sample in each of m equal parts of the total area
        level = (torch.arange(m, dtype=torch.float64) + torch.rand(m, generator=generator).double()) / m * edges[-1]
        face = torch.searchsorted(edges, level).clamp_max(len(edges) - 1)
        a, b = torch.rand(m, 2, generator=generator).unbind(1)
        weight = torch.stack([1 - a.sqrt(), a.sqrt() * (1 - b), a.sqrt() * b], 1)  # Osada et al. 2002, eq. 1
        points = (corners[face].float() * weight[..., None]).sum(1)
        normals = (cross[face] / cross[face].norm(dim=1, keepdim=True).clamp_min(np.finfo(float).tiny)).float()
        rows.append((points, normals, _colours(mesh, face, weight)))
    return tuple(torch.cat(column) for column in zip(*rows, strict=True))


def _colours(mesh, face: Int[Tensor, "m"], weight: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    """RGB 0..1 at barycentric points on faces, from face colours, vertex colours, texture or the material."""
    visual, corner = mesh.visual, torch.from_numpy(np.array(mesh.faces, np.int64))[face]
    if visual.kind == "face":
        return torch.from_numpy(np.array(visual.face_colors[:, :3], np.float32))[face] / 255
    if visual.kind == "vertex":
        vertex = torch.from_numpy(np.array(visual.vertex_colors[:, :3], np.float32)) / 255
        return (vertex[corner] * weight[..., None]).sum(1)
    material = getattr(visual, "material", None)
    image = _texture(mesh)
    if image is None or getattr(visual, "uv", None) is None:
        return _material_colour(material).expand(len(face), 3)
    uv = np.pad(np.array(visual.uv, np.float32), ((0, 0), (0, 1)))[:, :2]  # OBJ allows u without v
    uv = torch.from_numpy(np.where(np.abs(uv) < 1e6, uv, 0))  # also replaces NaN, which exporters write for empty faces
    texels = torch.from_numpy(np.array(image.convert("RGB")))
    tint = _material_colour(material) if getattr(material, "baseColorFactor", None) is not None else torch.ones(3)
    return _bilinear_lookup(texels, (uv[corner] * weight[..., None]).sum(1)) / 255 * tint


def _texture(mesh):
    """The image of a mesh with texture coordinates, or None."""
    material = getattr(mesh.visual, "material", None)
    images = (getattr(material, key, None) for key in ("baseColorTexture", "image"))  # of glTF, of OBJ
    return next((image for image in images if image is not None), None)


def _material_colour(material) -> Float[Tensor, "3"]:
    """Base or diffuse colour; mid grey if the file has none."""
    for key in ("baseColorFactor", "diffuse"):
        value = getattr(material, key, None)
        if value is not None:
            value = np.asarray(value)
            return torch.tensor(value[:3] / (255.0 if value.dtype.kind in "ui" else 1.0), dtype=torch.float32)
    return torch.full((3,), 0.6)


def _bilinear_lookup(texels: UInt8[Tensor, "h w 3"], uv: Float[Tensor, "m 2"]) -> Float[Tensor, "m 3"]:
    """Bilinear texture lookup with u to the right and v up, repeating outside 0..1; values 0..255."""
    h, w = texels.shape[:2]
    x, y = uv[:, 0] * w - 0.5, (1 - uv[:, 1]) * h - 0.5
    i, j = x.floor(), y.floor()
    fx, fy = (x - i)[:, None], (y - j)[:, None]
    left, right, top, low = (i % w).long(), ((i + 1) % w).long(), (j % h).long(), ((j + 1) % h).long()
    above = texels[top, left] * (1 - fx) + texels[top, right] * fx
    below = texels[low, left] * (1 - fx) + texels[low, right] * fx
    return above * (1 - fy) + below * fy


def _poisson_disk_subset(points: Float[Tensor, "m 3"], normals: Float[Tensor, "m 3"], count: int) -> Int[Tensor, "n"]:
    """Indices of a Poisson-disk subset of about `count` points: no two on the same side are closer than a radius.

    Parallel dart throwing: in each round, every point with the lowest random rank among its remaining neighbours is
    accepted and its neighbours are rejected, until none are left. In the limit, discs of that diameter cover 0.547 of
    the area; with five candidates per accepted point they cover about 0.4 (measured), which determines the radius.
    """
    p, n = points.double().numpy(), normals.numpy()
    tree = cKDTree(p)
    eighth = np.median(tree.query(p[:: max(1, len(p) // 2000)], k=9)[0][:, 8])  # a disc of this radius has 8 neighbours
    radius = eighth * np.sqrt(0.4 * 4 / 8 * len(p) / count)
    pairs = tree.query_pairs(radius, output_type="ndarray")
    pairs = pairs[(n[pairs[:, 0]] * n[pairs[:, 1]]).sum(1) > 0]
    rank = torch.randperm(len(p), generator=torch.Generator().manual_seed(len(p))).numpy()
    remaining, accepted = np.ones(len(p), bool), np.zeros(len(p), bool)
    while remaining.any():
        first = np.full(len(p), len(p))
        np.minimum.at(first, pairs[:, 0], rank[pairs[:, 1]])
        np.minimum.at(first, pairs[:, 1], rank[pairs[:, 0]])
        chosen = remaining & (rank < first)
        accepted |= chosen
        remaining &= ~chosen
        rejected = np.concatenate([pairs[chosen[pairs[:, 0]], 1], pairs[chosen[pairs[:, 1]], 0]])
        remaining[rejected] = False
        pairs = pairs[remaining[pairs].all(1)]
    return torch.from_numpy(np.flatnonzero(accepted))
