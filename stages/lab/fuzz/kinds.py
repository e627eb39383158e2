"""The formats that ngff reads, each with a small valid file, the changes applied to it, and its reader."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from stages.core.errors import InputError
from stages.core.models import checkpoints
from stages.core.models.segmenter.segment import load_segmenter
from stages.core.physics.forces import parse
from stages.core.physics.materials import choose_materials
from stages.core.physics.recording import read_prompts_file
from stages.core.scene.cameras import read_cameras
from stages.core.scene.images import read_image, read_labels, read_video, write_labels
from stages.core.scene.npz import read_npz
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.trajectory import read_trajectory
from stages.evaluate.labels import read_label_names
from stages.lab.bench.replay import read_recording
from stages.lab.clutter.examples import read_example
from stages.lab.dataset.importer import read_frame
from stages.lab.dataset.keypoint_motions import read_motions
from stages.lab.dataset.manifest import read_checksums
from stages.lab.dataset.scene_configs import read_scene_configs, write_scene_configs
from stages.lab.fuzz import checks
from stages.lab.fuzz.examples import (
    CONFIG,
    FORCES,
    LABELS,
    MATERIALS,
    MESSAGE,
    OBJECTS,
    OPTIONS,
    PATH,
    PROMPTS,
    RECORDING,
    VIEWS,
    as_json,
    as_text,
    example_motions,
    example_scene,
    repair_card,
    write_checkpoint,
    write_clutter,
    write_colmap,
    write_colmap_text,
    write_frame,
    write_masks,
    write_packed,
    write_photos,
    write_recording,
    write_segmenter,
    write_study,
    write_sums,
    write_trajectory,
    write_transforms,
    write_video,
    write_weights,
)
from stages.lab.fuzz.mutations import (
    change_arrays,
    change_bytes,
    change_datasets,
    change_doubles,
    change_json,
    change_tensors,
    change_vertices,
    change_words,
)
from stages.lab.questionnaire.answers import read_answers
from stages.reconstruct.photo_reader import read_photos
from stages.render.path_file import read_camera_path
from stages.segment.masks import read_names
from stages.segment.masks import segment as segment_masks
from stages.segment.options import SegmentOptions
from stages.segment.prompts import read_prompts
from stages.simulate.live.messages import BadMessage, parse_message
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import with_recorded

Change = Callable[[Path, random.Random], None]


@dataclass(frozen=True)
class Kind:
    """A format under test: how to write a small valid example, which files are changed and how, and the reader."""

    name: str
    write: Callable[[Path], object]  # writes the example to a folder
    changes: Mapping[str, Change]  # changes by file name; one of the files is changed per case
    read: Callable[[Path], object]  # reads from the folder; raises AssertionError for invalid values
    share: int = 1  # relative frequency of its cases
    repair: Callable[[Path], object] | None = None  # corrects checksums, in 70 % of the cases


def read_message(path: Path) -> None:
    """Read a message of a live page; a rejected message is not an error of the server."""
    try:
        checks.check_message(parse_message(path.read_text(errors="replace")))
    except BadMessage as error:
        raise InputError(str(error)) from error


def read_masks(folder: Path) -> None:
    """Read the label images of a folder, as the first step of `segment --masks` does."""
    checks.check_labelled(segment_masks(example_scene(), SegmentOptions(masks=folder)))


def read_options(folder: Path) -> None:
    """Read the options --force --velocity --lift --pin --material of `ngff simulate`, one per line."""
    lines = [*(folder / "options").read_text(errors="replace").split("\n"), *[""] * 5]
    force, velocity, lift, pin, material = ([line] if line else [] for line in lines[:5])
    checks.check_force_prompts(parse(OBJECTS, force=force, velocity=velocity, lift=lift, pin=pin))
    checks.check_materials(choose_materials(OBJECTS, material))


def check_trajectory_and_prompts(folder: Path) -> None:
    """Read and check a trajectory, and the prompts and options that --forces would take from it."""
    found = read_trajectory(folder / "traj.h5")
    checks.check_trajectory(found)
    check_recording(folder / "traj.h5")


def check_recording(path: Path) -> None:
    """Read and check the prompts and options that --forces takes from a file."""
    checks.check_force_prompts(read_prompts_file(path, "scene", OBJECTS))
    checks.check_simulate_options(with_recorded(SimulateOptions(forces=path)))


def check_video(folder: Path) -> None:
    """Read and check the frames of a video, as images and as photos."""
    checks.check_images(read_video(folder / "v.mp4"))
    checks.check_images(image for image in read_photos(folder / "v.mp4").images)


def single(read: Callable, name: str, check: Callable) -> Callable[[Path], None]:
    """A function that reads one file of a folder and checks what the reader returns."""
    return lambda folder: check(read(folder / name))


def file_kind(name: str, write: Callable, change: Change, read: Callable, check: Callable, share: int = 1) -> Kind:
    """A kind with a single file."""
    return Kind(name, lambda folder: write(folder / name), {name: change}, single(read, name, check), share)


def json_kind(name: str, value: object, read: Callable, check: Callable) -> Kind:
    """A kind with a single JSON file, whose reader receives the path."""
    return Kind(name, as_json(name, value), {name: change_json}, single(read, name, check))


KINDS = (
    file_kind("scene.ply", lambda path: write_scene(path, example_scene()), change_vertices, read_scene,
              checks.check_scene, 4),
    file_kind("packed.ply", write_packed, change_vertices, read_scene, checks.check_scene, 2),
    Kind("traj.h5", lambda folder: write_trajectory(folder / "traj.h5"), {"traj.h5": change_datasets},
         check_trajectory_and_prompts, 4),
    file_kind("transforms.json", write_transforms, change_json, read_cameras, checks.check_lenses, 2),
    Kind("colmap.bin", write_colmap, {"images.bin": change_doubles, "cameras.bin": change_doubles},
         lambda folder: checks.check_lenses(read_cameras(folder)), 2),
    Kind("colmap.txt", write_colmap_text, {"images.txt": change_words, "cameras.txt": change_words},
         lambda folder: checks.check_lenses(read_cameras(folder))),
    json_kind("path.json", PATH, read_camera_path, checks.check_cameras_of),
    json_kind("views.json", VIEWS, read_camera_path, checks.check_cameras_of),
    *(Kind(f"{name}.json", as_json(f"{name}.json", value), {f"{name}.json": change_json},
           lambda folder, name=name: check_recording(folder / f"{name}.json"))
      for name, value in {"forces": FORCES, "recording": RECORDING}.items()),
    json_kind("materials.json", MATERIALS, lambda path: choose_materials(OBJECTS, file=path), checks.check_materials),
    json_kind("prompts.json", PROMPTS, lambda path: read_prompts(path, example_scene().cameras), checks.check_prompts),
    json_kind("names.json", {"1": "duck", "2": "bowl"}, lambda path: read_names(path.parent), checks.check_names),
    Kind("labels.json", as_json("names.json", LABELS), {"names.json": change_json},
         lambda folder: checks.check_names(read_label_names(folder))),
    Kind("scene_configs.json", lambda folder: write_scene_configs(folder / "c.json", CONFIG), {"c.json": change_json},
         single(read_scene_configs, "c.json", checks.check_configs)),
    Kind("options", lambda folder: (folder / "options").write_text(OPTIONS), {"options": change_words}, read_options),
    Kind("weights", write_weights, {"w.safetensors": change_tensors, "w.json": change_json},
         lambda folder: checks.check_parameters(checkpoints.load(folder / "w.safetensors")[0]), 2, repair_card),
    Kind("segmenter", write_segmenter, {"w.safetensors": change_tensors, "w.json": change_json},
         lambda folder: checks.check_parameters(load_segmenter(folder / "w.safetensors")), 2, repair_card),
    file_kind("clutter.safetensors", write_clutter, change_tensors, read_example, checks.check_example),
    Kind("masks", write_masks, {"a.png": change_bytes, "names.json": change_json}, read_masks),
    Kind("study", write_study, {"key.json": change_json, "1.json": change_json},
         lambda folder: checks.check_answers(read_answers(folder, [folder / "1.json"]))),
    file_kind("frame.h5", write_frame, change_datasets, lambda path: read_frame(path, "x", (3,)),
              checks.check_points),
    file_kind("list.sha256", write_sums, change_words, read_checksums, checks.check_sums),
    file_kind("message", as_text(MESSAGE), change_json, read_message, lambda _: None),
    Kind("checkpoint.pt", write_checkpoint, {"w.pt": change_doubles},
         lambda folder: checks.check_parameters(checkpoints.load(folder / "w.pt")[0])),
    file_kind("recording.npz", write_recording, change_arrays, read_recording, lambda arrays: None),
    file_kind("arrays.npz", write_recording, change_bytes, lambda path: read_npz(path, "arrays"), lambda arrays: None),
    Kind("motions.h5", example_motions, {"m.h5": change_datasets}, single(read_motions, "m.h5", checks.check_motions),
         2),
    Kind("video.mp4", write_video, {"v.mp4": change_bytes}, check_video),
    file_kind("label.png", lambda path: write_labels(path, torch.arange(300).reshape(15, 20)), change_bytes,
              read_labels, lambda image: checks.check_images([image])),
    *(Kind(f"photo{name[1:]}", write_photos, {name: change_bytes},
           single(read_image, name, lambda image: checks.check_images([image])))
      for name in ("a.png", "b.jpg", "b.tif", "b.webp", "b.bmp")),
)  # fmt: skip
