"""Small valid files of every format that ngff reads: functions that write them, and values stored in them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import torch
from plyfile import PlyData, PlyElement
from safetensors.torch import save_file

from stages.core.models import checkpoints
from stages.core.models.segmenter.network import Segmenter
from stages.core.models.segmenter.voxels import ScenePoints
from stages.core.scene.cameras import Cameras
from stages.core.scene.field_start import FieldStart, FieldUnits
from stages.core.scene.files import sha256
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.images import VideoWriter, write_labels, write_png
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.sequence import FilmedSequence
from stages.core.scene.trajectory import Binding, Keypoints, SimulationInfo, TrajectoryWriter
from stages.lab.clutter.examples import Example, write_example
from stages.lab.dataset.keypoint_motions import KeypointMotions, write_motions
from stages.lab.dataset.scene_configs import SceneConfig

PROVENANCE = {"command": "simulate", "inputs": [{"name": "scene.ply"}], "options": {
    "dt": 0.02, "engine": "ngff", "gravity": 9.81, "quality": "draft", "material": ["1=rubber"], "floor": None,
    "friction": 0.5, "box": None, "keypoints": 16, "integrator": "step", "seed": 0}}  # fmt: skip
PROMPT_ROWS = (
    {"kind": "force", "object_id": 2, "force": [0, 0, 8.0], "torque": [0, 0, 0], "start": 0.1, "end": None, "at": None},
    {"kind": "pin", "object_id": 1},
    {"kind": "velocity", "object_id": 1, "velocity": [0, 0, 2.0]},
    {"kind": "lift", "object_id": 2, "height": 0.3},
    {"kind": "change", "what": "gravity", "value": 1.6, "start": 0.5, "object_id": None},
    {"kind": "change", "what": "material", "value": "rubber", "start": 0.5, "object_id": 1},
    {"kind": "change", "what": "pinned", "value": True, "start": 0.5, "object_id": 1},
)


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
    return Scene(gaussians, objects, cameras, 0.0, {"metres_per_unit": 1.0, "source": "known"}, PROVENANCE,
                 sequence=FilmedSequence(50.0, 40, {"a.png": 12.5, "b.png": 3.0}))  # fmt: skip


OBJECTS = example_scene().objects


def write_trajectory(path: Path) -> None:
    """A trajectory with three frames of twelve keypoints."""
    scene = example_scene()
    n, rest = len(scene.gaussians), torch.randn(12, 3, generator=torch.Generator().manual_seed(1))
    binding = Binding(torch.arange(n)[:, None] % 12, torch.ones(n, 1))
    info = SimulationInfo(0.02, (0.0, 0.0, -9.81), "test", PROMPT_ROWS)
    with TrajectoryWriter(path, scene, info, Keypoints(rest, torch.arange(12) % 2 + 1), binding) as writer:
        for _ in range(3):
            writer.append(rest, torch.zeros(2, 3), torch.eye(4)[:2])
        one = torch.ones(2)
        units = FieldUnits(2.0, 2.0, 1.4, 0.5, (0.0, 0.0, 0.0), 5.0, 2, "0" * 64)
        writer.store_field(FieldStart(
            rest, torch.full((12,), 1 / 6), one, one, 1e5 * one, one, 0.3 * one, 0.5 * one, torch.zeros(2, 3),
            torch.eye(3).repeat(2, 1, 1), torch.tensor([[-1.0] * 3, [1.0] * 3]).repeat(2, 1, 1), one.long(), one.long(),
            ("rubber", "common"), units,
        ))  # fmt: skip


def write_transforms(path: Path) -> None:
    """A transforms.json with two frames."""
    frames = [{"file_path": f"{name}.png", "transform_matrix": np.eye(4).tolist()} for name in "ab"]
    path.write_text(json.dumps({"fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 12.0, "w": 32, "h": 24, "k1": 0.1,
                                "frames": frames}))  # fmt: skip


def write_packed(path: Path) -> None:
    """Sixty Gaussians in PlayCanvas's compressed PLY layout: 11, 10 and 11 bits between the bounds of a chunk."""
    rng = np.random.default_rng(0)
    words = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    vertices = np.zeros(60, [(name, "<u4") for name in words])
    for name in words:
        vertices[name] = rng.integers(0, 2**32, 60, dtype=np.uint32)
    chunk = np.zeros(1, [(f"{end}_{part}{axis}", "<f4") for part in ("", "scale_") for end in ("min", "max")
                         for axis in "xyz"])  # fmt: skip
    for name in chunk.dtype.names:
        chunk[name] = (-3.0 if "scale" in name else -1.0) if name.startswith("min") else 1.0
    elements = [PlyElement.describe(chunk, "chunk"), PlyElement.describe(vertices, "vertex")]
    PlyData(elements, byte_order="<").write(str(path))


def write_colmap(folder: Path) -> None:
    """A COLMAP model with two images of one camera, as text and as binary files."""
    poses = [(0.8, 0.1, -0.3, 0.5, 1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)]
    camera = (40.0, 41.0, 16.0, 12.0, 0.1, -0.02, 0.001, 0.002)
    lines = [f"{i + 1} {' '.join(map(str, pose))} 1 {'ab'[i]}.png\n1.0 2.0 -1" for i, pose in enumerate(poses)]
    (folder / "images.txt").write_text("# images\n" + "\n".join(lines) + "\n")
    (folder / "cameras.txt").write_text("# cameras\n1 OPENCV 32 24 " + " ".join(map(str, camera)) + "\n")
    pack = np.array  # used with little-endian types
    count, none = pack([2], "<u8").tobytes(), pack([0], "<u8").tobytes()
    rows = [pack([i + 1], "<u4").tobytes() + pack(pose, "<f8").tobytes() + pack([1], "<u4").tobytes()
            + f"{'ab'[i]}.png".encode() + b"\0" + none for i, pose in enumerate(poses)]  # fmt: skip
    (folder / "images.bin").write_bytes(count + b"".join(rows))
    size = pack([1, 4], "<i4").tobytes() + pack([32, 24], "<u8").tobytes()
    (folder / "cameras.bin").write_bytes(pack([1], "<u8").tobytes() + size + pack(camera, "<f8").tobytes())


def write_colmap_text(folder: Path) -> None:
    """The same COLMAP model, as text files only."""
    write_colmap(folder)
    for name in ("images.bin", "cameras.bin"):
        (folder / name).unlink()


def write_weights(folder: Path) -> None:
    """Weights of a small untrained model, with their card."""
    torch.manual_seed(0)
    checkpoints.save(folder / "w.safetensors", "gcn", checkpoints.build("gcn", hidden=4, layers=2))


def repair_card(folder: Path, name: str = "w") -> None:
    """Update the sha256 in the card to that of the changed weights."""
    try:
        card = json.loads((folder / f"{name}.json").read_text())
        card["sha256"] = sha256(folder / f"{name}.safetensors")
        (folder / f"{name}.json").write_text(json.dumps(card))
    except (ValueError, TypeError, RecursionError):
        pass  # the card itself is damaged


def write_segmenter(folder: Path) -> None:
    """Weights of a small untrained segmentation network, with their card."""
    torch.manual_seed(0)
    model = Segmenter((4, 6), 1)
    save_file({name: value.half() for name, value in model.state_dict().items()}, folder / "w.safetensors")
    card = {"model": "segmenter", "config": model.config, "sha256": sha256(folder / "w.safetensors")}
    (folder / "w.json").write_text(json.dumps(card))


def write_clutter(path: Path) -> None:
    """A clutter example with six surfels."""
    points = ScenePoints(*(torch.rand(6, 3)[:, 0] if name == "flatness" else torch.rand(6, 3) for name in
                           ScenePoints.__dataclass_fields__))  # fmt: skip
    write_example(path, Example(points, torch.arange(6) - 1))


def write_masks(folder: Path) -> None:
    """Label images of two photos, and the names of the objects in them."""
    for name in "ab":
        write_labels(folder / f"{name}.png", torch.arange(768).reshape(24, 32) % 3)
    (folder / "names.json").write_text(json.dumps({"1": "duck", "2": {"name": "bowl"}}))


def write_study(folder: Path) -> None:
    """The key of a study with two films, and the answers of one participant."""
    films = {name: {"model": "ngff", "split": split, "file": "a.mp4"} for name, split in (("f1", "a"), ("f2", ""))}
    shown, scales = {"1": ["f1", "f2"], "2": ["f2"]}, ["PhysR", "PhotoR"]
    key = {"study": "abc", "films": films, "participants": shown, "points": 5, "scales": scales}
    (folder / "key.json").write_text(json.dumps(key))
    answers = [{"film": "f1", "PhysR": 3, "PhotoR": 5}, {"film": "f2", "unplayable": True}]
    (folder / "1.json").write_text(json.dumps({"study": "abc", "participant": "1", "answers": answers}))


def write_frame(path: Path) -> None:
    """A frame in the format of the published simulations."""
    with h5py.File(path, "w") as file:
        file["x"], file.attrs["step"] = np.ones((5, 3), "f4"), 0


def write_sums(path: Path) -> None:
    """A list of sha256 digests."""
    path.write_text(f"{'0' * 64}  objects/ball.ply\n{'f' * 64}  scenes/a b.h5\n")


def write_checkpoint(folder: Path) -> None:
    """A checkpoint in the format of the public code."""
    torch.save(checkpoints.build("ngff-paper", hidden=2, layers=1).state_dict(), folder / "w.pt")


def write_recording(path: Path) -> None:
    """A recording with two frames of three particles in two bodies."""
    np.savez(path, positions=np.ones((2, 3, 3), "f4"), n=np.array([1, 2]), volume=np.full(3, 1e-5), E=np.full(2, 1e5),
             rho=np.full(2, 500.0), nu=0.3, dt=1e-4, substeps_per_frame=20, n_grid=20, grid_lim=2.0,
             gravity=np.array([0, 0, -9.8]), rpic_damping=0.1)  # fmt: skip


def example_motions(folder: Path) -> None:
    """Motions of two scenes, with one and two objects of four keypoints each, over three frames."""
    one, generator = torch.ones(2, 2), torch.Generator().manual_seed(0)
    motions = KeypointMotions(
        ("0_1_2", "1_4"), torch.tensor([[1, 2], [4, -1]]), torch.rand(2, 3, 2, 4, 3, generator=generator), 0.1 * one,
        1e5 * one, 0.3 * one, 0.5 * one, 0.02, (0.0, 0.0, -9.8), ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), one,
    )  # fmt: skip
    write_motions(folder / "m.h5", motions, {"seed": 0})


def write_video(folder: Path) -> None:
    """A video with four frames of 32 x 24 pixels."""
    with VideoWriter(folder / "v.mp4", 25.0) as video:
        for frame in torch.rand(4, 24, 32, 3, generator=torch.Generator().manual_seed(0)):
            video.append(frame)


def write_photos(folder: Path) -> None:
    """The same image as a photo in several formats."""
    image = torch.rand(24, 32, 3, generator=torch.Generator().manual_seed(0))
    write_png(folder / "a.png", image)
    import cv2

    for suffix in (".jpg", ".tif", ".webp", ".bmp"):
        (folder / f"b{suffix}").write_bytes(cv2.imencode(suffix, (image.numpy() * 255).astype(np.uint8))[1].tobytes())


def as_json(name: str, value: object) -> Callable[[Path], None]:
    """A function that writes a value to a JSON file NAME in a folder."""
    return lambda folder: (folder / name).write_text(json.dumps(value))


def as_text(value: object) -> Callable[[Path], object]:
    """A function that writes a value to a JSON file at any path."""
    return lambda path: path.write_text(json.dumps(value))


EYE = np.eye(3).tolist()
PATH = [{"rotation": EYE, "position": [0.0, 0, i], "width": 32, "height": 24, "fx": 40.0, "fy": 40.0} for i in range(2)]
VIEWS = [{"viewmat": np.eye(4).tolist(), "K": [[40.0, 0, 16], [0, 40, 12], [0, 0, 1]], "size": [32, 24]}] * 2
FORCES = {"scene": [{"obj_id": 0, "start": 0.0, "end": 0.5, "force": [0, 0, 2.0]},
                    {"obj_id": 1, "start": 0.1, "end": 0.3, "torque": [0.0, 1.0, 0]}]}  # fmt: skip
CUSTOM = {"E": 1e5, "density": 500.0, "nu": 0.3, "friction": 0.4, "loss": 0.1, "model": "von-mises",
          "plastic": [1e4, 0.0, 0.0]}  # fmt: skip
PARTS = [{"below": 0.1, "material": CUSTOM}, {"box": [0, 0, 0.1, 1, 1, 1.0], "material": "steel", "pinned": True},
         {"material": "rubber"}]  # fmt: skip
PULLED = {"kind": "force", "object_id": 1, "force": [0, 0, 2.0], "start": 0.1, "end": 0.12, "at": [0, 0, 1.0]}
RECORDING = {"frames": 4, "options": {"dt": 0.02, "engine": "ngff", "material": ["duck=rubber"], "seed": 1},
             "prompts": [PULLED, {"kind": "change", "what": "pinned", "value": True, "start": 0.1, "object_id": 2},
                         {"kind": "lift", "object_id": 2, "height": 0.1}]}  # fmt: skip
MATERIALS = {"duck": CUSTOM, "2": {"parts": PARTS}}
PROMPTS = {"bbox": [[2, 3, 10, 12], [12.0, 4, 20, 20]], "center_point": [[5, 6], [15.0, 10]], "text": ["duck", "bowl"],
           "size": [32, 24]}  # fmt: skip
LABELS = {"1": {"name": "duck", "core": True}, "2": "bowl"}
MESSAGE = {"do": "push", "object": 1, "point": [0.0, 0.0, 1.0], "direction": [0, 3, 4.0], "strength": 2.0}
OPTIONS = "object=duck force=0,0,2 from=0.1 to=0.3 at=1,2,3\nobject=1 0,0,2\n1=0.3\nbowl\nduck=rubber\n"
CONFIG = {"0_1_2": SceneConfig("0_1_2", (1, 2), ((0.0, 0, 0), (0.1, 0.2, 0.5)), (0.4, 0.3))}
