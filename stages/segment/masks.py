"""The masks backend: label images of the photos, from any tool, voted over all views."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Int
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.perception.voting import apply_votes, collect_votes
from stages.core.scene.images import IGNORE_LABEL, read_labels
from stages.core.scene.lens import Undistortion
from stages.core.scene.scene import Scene
from stages.core.scene.schema import numbered, read_json, reason, texts
from stages.segment.options import SegmentOptions
from stages.segment.view_images import match_files

MAX_LABELS = 1000  # most different labels in all label images


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """Label Gaussians by the images in the folder `options.masks`: visible Gaussians get votes from all views.

    If names.json names objects but not 255, pixels with the value 255 do not vote; `ngff evaluate` ignores them too.
    Raises InputError for a scene without cameras, a folder without matching images, and wrong aspect ratios.
    """
    if scene.cameras is None:
        raise InputError("--masks: the scene has no cameras; give a scene written by `ngff reconstruct`")
    files, names = match_files(options.masks, scene.cameras.names, "label image", "--masks"), read_names(options.masks)
    bar, columns = tqdm(files.items(), unit="mask"), {0: 0}
    votes = collect_votes(scene, ((view, _columns(_labels(scene, view, file, options), columns)) for view, file in bar))
    ignored = {IGNORE_LABEL} if names and IGNORE_LABEL not in names else set()
    order = sorted(columns.keys() - ignored)
    votes = votes[:, [columns[number] for number in order]]
    return apply_votes(scene, votes, names, str(options.masks), options.seed, order)


def _columns(labels: Int[Tensor, "h w"], columns: dict[int, int]) -> Int[Tensor, "h w"]:
    """Map labels to columns of the table of votes; new labels are added to `columns`."""
    numbers, index = labels.unique(return_inverse=True)
    for number in numbers.tolist():
        columns.setdefault(number, len(columns))
    if len(columns) > MAX_LABELS:
        raise InputError(
            f"--masks: the label images have more than {MAX_LABELS} different numbers; give one number per object"
        )
    return torch.tensor([columns[number] for number in numbers.tolist()])[index]


def _labels(scene: Scene, view: int, file: Path, options: SegmentOptions) -> Int[Tensor, "h w"]:
    """Read a label image of any size and undistort it. Raises InputError unless it has the photo's aspect ratio."""
    labels = read_labels(file)
    try:
        lens = Undistortion.of(scene.cameras, view, (labels.shape[1], labels.shape[0]), options.undistorted)
    except InputError as error:
        raise InputError(f"--masks: the label image of {error}") from error
    return lens.labels(labels)


def read_names(folder: Path) -> dict[int, str]:
    """Names by label from names.json: {"1": "duck"}, {"1": {"name": "duck"}} or ["duck", ...]; empty if absent."""
    path = Path(folder) / "names.json"
    if not path.exists():
        return {}
    try:
        data = read_json(path)
        named = dict(enumerate(data, start=1)) if isinstance(data, list) else numbered(data, "a label")
        names = [row.get("name") if isinstance(row, dict) else row for row in named.values()]
        return dict(zip(named, texts(names, "the names"), strict=True))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RuntimeError, IndexError) as error:
        raise InputError(f'{path}: is not readable ({reason(error)}); write {{"1": "duck", "2": "bowl"}}') from error
