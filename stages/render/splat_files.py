"""Output formats of other tools: GLB (KHR_gaussian_splatting) with animated objects, and SPZ (version 3).

Both have y up, as in glTF, so the world is rotated by -90 degrees about x.
Sources: github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting; github.com/nianticlabs/spz.
"""

from __future__ import annotations

import gzip
import json
import logging
import struct
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.harmonics import C0, degree_of
from stages.core.geometry.rotations import quaternion
from stages.core.geometry.similarity import Similarity
from stages.core.physics.skinning import fit_rotations
from stages.core.scene.files import replacing
from stages.core.scene.gaussians import Gaussians, transformed
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.trajectory import Trajectory
from stages.render.renderer import Clip, Renderer

log = logging.getLogger(__name__)
Y_UP = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # rotation of world coordinates to y up
MAX_RIGID_ERROR = 0.02  # largest error of keypoints that move as a rigid body [radius of their object]
LARGE = 100e6  # file size above which there is a warning [bytes]
GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
FLOAT, POINTS, STEP = 5126, 0, "STEP"
PREFIX = "KHR_gaussian_splatting"
SPZ_MAGIC, SPZ_VERSION, FRACTION_BITS = 0x5053474E, 3, 12
MAX_SPZ_POSITION = 2**23 / 2**FRACTION_BITS  # [scene units]


def write_spz(out: Path, renderer: Renderer) -> dict:
    """Write one frame as SPZ. Raises InputError for a motion, and for scenes too large for its 24-bit positions."""
    clip = only_clip(out, renderer)
    if clip.animation.is_moving:
        raise InputError(f"{out}: an SPZ file holds one frame; choose it with --frame, or write a .glb or .html")
    g = _y_up(clip.gaussians(0.0).to("cpu"))
    if len(g) and float(g.means.abs().max()) >= MAX_SPZ_POSITION:
        raise InputError(
            f"{out}: SPZ stores positions up to {MAX_SPZ_POSITION:.0f} units, but this scene is "
            "larger; write another format"
        )
    with replacing(out) as part:
        part.write_bytes(gzip.compress(_spz(g), mtime=0))
    return {"gaussians": len(g), "bytes": out.stat().st_size}


def _spz(g: Gaussians) -> bytes:
    """The uncompressed contents: header, positions, alphas, colours, scales, rotations, harmonics."""
    degree = degree_of(g.sh.shape[1])
    fixed = (g.means.double() * 2**FRACTION_BITS).round().long()
    positions = torch.stack([fixed >> shift & 255 for shift in (0, 8, 16)], -1)
    scales = ((g.scales.log() + 10) * 16).round()
    colours = (g.sh[:, 0] * 0.15 + 0.5) * 255
    parts = [positions, (g.opacities * 255).round(), colours.round(), scales]
    parts = [part.clamp(0, 255).to(torch.uint8).numpy().tobytes() for part in parts]
    header = struct.pack("<IIIBBBB", SPZ_MAGIC, SPZ_VERSION, len(g), degree, FRACTION_BITS, 0, 0)
    rest = g.sh[:, 1:].flatten(1)
    step = torch.where(torch.arange(rest.shape[1]) < 9, 2.0**3, 2.0**4)  # 5 bits for degree 1, 4 above, for compression
    harmonics = ((rest * 128 / step).round() * step + 128).clamp(0, 255)
    return b"".join([header, *parts, _smallest_three(g.quats), harmonics.to(torch.uint8).numpy().tobytes()])


def _smallest_three(quats: Float[Tensor, "n 4"]) -> bytes:
    """Quaternions in 32 bits: index of the largest of x y z w, then sign and 9 bits of each other component."""
    q = torch.nn.functional.normalize(quats[:, [1, 2, 3, 0]], dim=1)
    largest = q.abs().argmax(1)
    q = q * torch.where(q.gather(1, largest[:, None]) < 0, -1.0, 1.0)
    packed = largest.clone()
    for i in range(4):
        magnitude = (q[:, i].abs() * 511 * 2**0.5).round().long().clamp(max=511)
        component = (q[:, i] < 0).long() << 9 | magnitude
        packed = torch.where(largest == i, packed, packed << 10 | component)
    return packed.numpy().astype("<u4").tobytes()


def write_glb(out: Path, renderer: Renderer) -> dict:
    """Write the scene as GLB: a node for the background and one for each object, moved by an animation.

    Objects that deform have a node for each frame, and only one of these is shown at a time. Raises InputError for
    trajectories that store every Gaussian.
    """
    clip = only_clip(out, renderer)
    animation, trajectory = clip.animation, clip.animation.trajectory
    if animation.is_moving and trajectory.dense:
        raise InputError(f"{trajectory.path}: stores every Gaussian of every frame; write one frame with --frame")
    glb, scene = _Glb(), animation.scene
    g = clip.gaussians(0.0).to("cpu") if not animation.is_moving else clip.background.compose(scene.gaussians.to("cpu"))
    baked = []
    moving = {o.id for o in scene.objects} if animation.is_moving else set()
    still = ~torch.isin(g.object_id, torch.tensor(sorted(moving), dtype=torch.int64))
    if bool(still.any()):
        glb.add_node("background" if moving else "scene", _y_up(g[still]))
    for o in scene.objects if animation.is_moving else ():
        mine = g[g.object_id == o.id]
        if not len(mine):
            continue
        pose = rigid_motion(trajectory, o)
        if pose is None:
            baked.append(o.name)
            _add_frames(glb, clip, scene, o)
        else:
            _add_rigid(glb, o, mine, pose, trajectory.info.dt)
    glb.write(out)
    size = out.stat().st_size
    if baked:
        log.warning("%s: %s deform, so each frame is stored: %.0f MB", out, ", ".join(baked), size / 1e6)
    elif size > LARGE:
        log.warning("%s: %.0f MB; an .html page of the same scene is about ten times smaller", out, size / 1e6)
    return {"gaussians": len(g), "rigid": len(moving) - len(baked), "baked": len(baked), "bytes": size}


def only_clip(out: Path, renderer: Renderer) -> Clip:
    """The clip for a format that contains one scene. Raises InputError for options that the format does not support."""
    options = renderer.options
    if len(renderer.clips) > 1 or options.view == "all" or options.depth:
        raise InputError(f"{out}: such a file holds one scene; omit --side-by-side, --view all and --depth")
    if options.show_forces:
        raise InputError(
            f"{out}: such a file cannot hold arrows; omit --show-forces, or write an image, a video or a page (.html)"
        )
    return renderer.clips[0]


def _y_up(g: Gaussians) -> Gaussians:
    return transformed(g, Similarity(1.0, Y_UP, torch.zeros(3)))


def rigid_motion(t: Trajectory, o: SceneObject) -> tuple[Tensor, Tensor, Tensor] | None:
    """Centre at rest (3,), rotations (t, 3, 3) and centres (t, 3) of an object's keypoints; None if it deforms."""
    own = t.keypoints.object_id == o.id
    rest, positions = t.keypoints.rest[own], t.positions[:, own]
    if not len(rest):
        return None
    body = torch.zeros(len(rest), dtype=torch.int64)
    rotations = torch.stack([fit_rotations(rest, frame, body)[0] for frame in positions])
    arm = rest - rest.mean(0)
    error = (positions - positions.mean(1, keepdim=True) - arm @ rotations.mT).norm(dim=2).max()
    radius = arm.norm(dim=1).max().clamp_min(1e-9)
    return (rest.mean(0), rotations, positions.mean(1)) if float(error / radius) < MAX_RIGID_ERROR else None


def _add_rigid(glb: _Glb, o: SceneObject, g: Gaussians, pose: tuple[Tensor, Tensor, Tensor], dt: float) -> None:
    """Add a node with the Gaussians relative to their centre, animated by translations and rotations."""
    centre, rotations, centres = pose
    node = glb.add_node(o.name, _y_up(transformed(g, Similarity(1.0, torch.eye(3), -centre))), Y_UP @ centre)
    times = dt * torch.arange(len(centres))
    turns = quaternion(Y_UP @ rotations @ Y_UP.T)
    flips = torch.where((turns[1:] * turns[:-1]).sum(1) < 0, -1.0, 1.0).cumprod(0)  # take the shorter arc
    turns = turns * torch.cat([torch.ones(1), flips])[:, None]
    glb.animate(node, "translation", times, centres @ Y_UP.T)
    glb.animate(node, "rotation", times, turns[:, [1, 2, 3, 0]])


def _add_frames(glb: _Glb, clip: Clip, scene: Scene, o: SceneObject) -> None:
    """Add a node for each frame; at any time all but one have scale 0."""
    dt, count = clip.animation.trajectory.info.dt, len(clip.animation.trajectory)
    for frame in range(count):
        moved = clip.animation.gaussians(frame * dt).to("cpu")
        node = glb.add_node(f"{o.name} {frame}", _y_up(moved[moved.object_id == o.id]))
        times = torch.tensor([0.0, frame * dt, (frame + 1) * dt])[1 if not frame else 0 : 3 if frame < count - 1 else 2]
        shown = torch.tensor([0.0, 1.0, 0.0])[1 if not frame else 0 : 3 if frame < count - 1 else 2]
        glb.animate(node, "scale", times, shown[:, None].expand(-1, 3), STEP)


class _Glb:
    """A glTF document and its binary buffer."""

    def __init__(self):
        self.buffer = bytearray()
        self.json: dict = {
            "asset": {"version": "2.0", "generator": "ngff"}, "extensionsUsed": [PREFIX], "scene": 0,
            "scenes": [{"nodes": []}], "nodes": [], "meshes": [], "accessors": [], "bufferViews": [], "animations": [],
        }  # fmt: skip

    def accessor(self, values: Tensor, bounds: bool = False) -> int:
        """Add float32 rows to the buffer; returns the index of their accessor."""
        rows = values.detach().float().contiguous().numpy()
        kind = "SCALAR" if rows.ndim == 1 else f"VEC{rows.shape[1]}"
        view = {"buffer": 0, "byteOffset": len(self.buffer), "byteLength": rows.nbytes}
        self.buffer += rows.astype("<f4").tobytes()
        row = {"bufferView": len(self.json["bufferViews"]), "componentType": FLOAT, "count": len(rows), "type": kind}
        if bounds:
            low, high = (np.atleast_1d(f(rows, axis=0)).tolist() for f in (np.min, np.max))
            row |= {"min": low, "max": high}
        self.json["bufferViews"].append(view)
        self.json["accessors"].append(row)
        return len(self.json["accessors"]) - 1

    def add_node(self, name: str, g: Gaussians, translation: Tensor | None = None) -> int:
        """Add a node with a mesh of these Gaussians; returns its index."""
        attributes = {
            "POSITION": self.accessor(g.means, bounds=True),
            "COLOR_0": self.accessor(torch.cat([(g.sh[:, 0] * C0 + 0.5).clamp(0, 1), g.opacities[:, None]], 1)),
            f"{PREFIX}:ROTATION": self.accessor(torch.nn.functional.normalize(g.quats, dim=1)[:, [1, 2, 3, 0]]),
            f"{PREFIX}:SCALE": self.accessor(g.scales),
            f"{PREFIX}:OPACITY": self.accessor(g.opacities.clamp(0, 1)),
        }
        for l in range(degree_of(g.sh.shape[1]) + 1):
            for m in range(2 * l + 1):
                attributes[f"{PREFIX}:SH_DEGREE_{l}_COEF_{m}"] = self.accessor(g.sh[:, l * l + m])
        kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        primitive = {"attributes": attributes, "mode": POINTS, "extensions": {PREFIX: kernel}}
        node = {"name": name, "mesh": len(self.json["meshes"])}
        if translation is not None:
            node["translation"] = translation.tolist()
        self.json["meshes"].append({"name": name, "primitives": [primitive]})
        self.json["nodes"].append(node)
        self.json["scenes"][0]["nodes"].append(len(self.json["nodes"]) - 1)
        return len(self.json["nodes"]) - 1

    def animate(self, node: int, path: str, times: Tensor, values: Tensor, interpolation: str = "LINEAR") -> None:
        """Add a channel to the animation of the file."""
        if not self.json["animations"]:
            self.json["animations"].append({"name": "motion", "channels": [], "samplers": []})
        animation = self.json["animations"][0]
        sampler = {"input": self.accessor(times, bounds=True), "output": self.accessor(values),
                   "interpolation": interpolation}  # fmt: skip
        animation["channels"].append({"sampler": len(animation["samplers"]), "target": {"node": node, "path": path}})
        animation["samplers"].append(sampler)

    def write(self, out: Path) -> None:
        """Write the file; chunks are padded to 4 bytes."""
        document = {k: v for k, v in self.json.items() if v != []}
        document["buffers"] = [{"byteLength": len(self.buffer)}]
        text = json.dumps(document, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), JSON_CHUNK) + text
        with replacing(out) as part, part.open("wb") as file:
            size = 12 + len(chunks) + 8 + len(self.buffer)
            file.write(struct.pack("<III", GLB_MAGIC, 2, size) + chunks)
            file.write(struct.pack("<II", len(self.buffer), BINARY_CHUNK))
            file.write(self.buffer)
