"""Training examples of the segmentation network: labelled surfels of a reconstruction, and their files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Int
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from stages.core.errors import InputError
from stages.core.models.segmenter.surfels import scene_surfels
from stages.core.models.segmenter.voxels import ScenePoints
from stages.core.scene.files import must_exist, replacing
from stages.core.scene.scene import Scene
from stages.core.scene.schema import reason
from stages.lab.clutter.reconstruction import true_labels


@dataclass(frozen=True)
class Example:
    """Surfels of a reconstruction and the true object of each: 0 surface, 1... objects, -1 floaters."""

    surfels: ScenePoints
    labels: Int[Tensor, "n"]


def labelled(made: Scene, truth: Scene) -> Example:
    """Surfels of the reconstruction `made`, labelled from the true scene."""
    surfels, index, _ = scene_surfels(made)
    return Example(surfels, true_labels(made, truth)[index])


def write_example(path: Path, example: Example) -> None:
    """Write an example to a .safetensors file, in half precision."""
    table = {name: getattr(example.surfels, name).half().contiguous() for name in ScenePoints.__dataclass_fields__}
    with replacing(path) as part:
        save_file({**table, "labels": example.labels.short()}, part)


def read_example(path: Path) -> Example:
    """Read an example from a file, in single precision. Raises InputError for an invalid file."""
    must_exist(path, "an example (.safetensors) such as `ngff-lab clutter` writes")
    try:
        table = load_file(path)
        labels = table.pop("labels")
        points = {name: table[name].float() for name in ScenePoints.__dataclass_fields__}
        shapes = {name: tuple(x.shape) for name, x in points.items()}
        n = len(labels)
        if labels.ndim != 1 or shapes != {name: (n,) if name == "flatness" else (n, 3) for name in points}:
            raise ValueError(f"its arrays have the shapes {shapes}")
        if labels.is_floating_point() or not all(x.isfinite().all() for x in points.values()):
            raise ValueError("its labels are not whole numbers, or a value is not finite")
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise InputError(f"{path}: is not an example of clutter ({reason(error)}); generate it again") from error
    return Example(ScenePoints(**points), labels.to(torch.int64))
