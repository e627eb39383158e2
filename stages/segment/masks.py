"""The masks backend: label images of the photos, from any tool, voted over all views."""

from __future__ import annotations

from pathlib import Path

from jaxtyping import Int
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.scene.images import read_labels
from stages.core.scene.lens import Undistortion
from stages.core.scene.scene import Scene
from stages.core.scene.schema import read_json, reason, texts, whole
from stages.segment.options import SegmentOptions
from stages.segment.view_images import match_files
from stages.segment.voting import apply_votes, collect_votes


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """Labels of the images in the folder `options.masks`, projected with visibility and voted over all views.

    Raises InputError for a scene without cameras, a folder without matching images, and wrong aspect ratios.
    """
    if scene.cameras is None:
        raise InputError("--masks: the scene has no cameras; use one that `ngff reconstruct` wrote")
    files = match_files(options.masks, scene.cameras.names, "label image", "--masks")
    bar = tqdm(files.items(), unit="mask")
    votes = collect_votes(scene, ((view, _labels(scene, view, file, options)) for view, file in bar))
    return apply_votes(scene, votes, read_names(options.masks), str(options.masks), options.seed)


def _labels(scene: Scene, view: int, file: Path, options: SegmentOptions) -> Int[Tensor, "h w"]:
    """A label image of any size, undistorted; raises InputError unless it has the photo's aspect ratio."""
    labels = read_labels(file)
    try:
        lens = Undistortion.of(scene.cameras, view, (labels.shape[1], labels.shape[0]), options.undistorted)
    except InputError as error:
        raise InputError(f"--masks: the label image of {error}") from error
    return lens.labels(labels)


def read_names(folder: Path) -> dict[int, str]:
    """Names by label, from names.json ({"1": "duck"} or ["duck", ...]); empty without that file."""
    path = Path(folder) / "names.json"
    if not path.exists():
        return {}
    try:
        data = read_json(path)
        labels = range(1, len(data) + 1) if isinstance(data, list) else data.keys()
        names = texts(list(data) if isinstance(data, list) else list(data.values()), "the names")
        return {whole(int(label), "a label"): name for label, name in zip(labels, names, strict=True)}
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RuntimeError, IndexError) as error:
        raise InputError(f'{path}: is not readable ({reason(error)}); write {{"1": "duck", "2": "bowl"}}') from error
