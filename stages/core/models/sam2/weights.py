"""Find, download on request and load the published weights of SAM 2.1; transformers is imported only for loading."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from stages.core.errors import InputError, MissingPackage
from stages.core.models.hub import HubSource, fetch, find_or_download, folders
from stages.core.models.pi3.weights import read_state
from stages.core.scene.files import must_exist

if TYPE_CHECKING:
    from transformers import Sam2VideoModel

    from stages.core.models.promptable import PromptableSegmenter

SOURCE = HubSource("facebook/sam2.1-hiera-large", "0.9 GB", "Apache-2.0")
SMALLEST = "facebook/sam2.1-hiera-tiny"  # 0.16 GB and several times faster; every size of SAM 2.1 works
FILES = ("config.json", "model.safetensors")


def find(given: Path | None = None) -> Path:
    """Find the weights: the file `given`, or model.safetensors in the folder `given`, with config.json next to it.

    Without `given`, the folder sam2/ is searched in $NGFF_WEIGHTS and in the user's cache. Raises InputError, which
    names the download, if files are missing.
    """
    if given is not None and not Path(given).is_dir():
        must_exist(given, "the weights of SAM 2.1 (model.safetensors)")
        must_exist(Path(given).with_name("config.json"), f"the config.json published with {Path(given).name}")
        return Path(given)
    places = [Path(given)] if given is not None else [folder / "sam2" for folder in folders()]
    for place in places:
        if all((place / file).is_file() for file in FILES):
            return place / FILES[1]
    raise InputError(
        f"sam2: no {' with '.join(FILES)} in {' or '.join(str(p) for p in places)}; download both from "
        f"https://huggingface.co/{SOURCE.repository} ({SOURCE.size}, licence {SOURCE.licence}; {SMALLEST} is faster "
        f"on a CPU) into {places[0]}, name their folder with --weights, or add --download"
    )


def load_segmenter(given: Path | None, download_missing: bool, device: str) -> PromptableSegmenter:
    """Load the network with the weights that `find` finds; with `download_missing`, missing weights are downloaded.

    Memory: the weights, about 1 GB of activations, one photo, and 20 MB per object, for any number of photos.
    """
    return _loaded(find_or_download(find, download, given, download_missing), device)


@lru_cache(maxsize=1)
def _loaded(path: Path, device: str) -> PromptableSegmenter:
    model = load(path, device)  # first, since it raises a clear error if transformers, imported below, is missing
    from stages.core.models.sam2.segmenter import Sam2Segmenter

    return Sam2Segmenter(model)


def download() -> Path:
    """Download config and weights of the large network into sam2/ of the first search folder.

    Returns the path of the weights.
    """
    folder = folders()[0] / "sam2"
    return fetch(SOURCE, folder, _choose, f"put {' and '.join(FILES)} in {folder}")[1]


def _choose(files: list) -> list:
    named = {file.rfilename: file for file in files}
    if missing := [name for name in FILES if name not in named]:
        raise ValueError(f"it holds no {' and no '.join(missing)}")
    return [named[name] for name in FILES]


def load(path: Path, device: str = "cpu") -> Sam2VideoModel:
    """Load a network with the weights of a file and the architecture of the config.json next to it; float32, eval mode.

    Raises MissingPackage if transformers is missing or too old for SAM 2, and InputError for files that are damaged,
    incomplete or of another network.
    """
    try:
        from transformers import Sam2VideoConfig, Sam2VideoModel
        from transformers.utils import logging as reports
    except ImportError as error:
        raise MissingPackage("sam2: needs transformers 4.56 or newer: `pip install -U 'ngff[sam2]'`") from error
    config = _config(Sam2VideoConfig, Path(path).with_name("config.json"))
    reports.disable_progress_bar()
    level = reports.get_verbosity()
    reports.set_verbosity_error()  # mismatches are reported below, in one sentence
    try:
        model, found = Sam2VideoModel.from_pretrained(
            None, config=config, state_dict=read_state(path), output_loading_info=True
        )
    except RuntimeError as error:
        raise _unfit(path, "its tensors have other shapes") from error
    finally:
        reports.set_verbosity(level)
    if missing := sorted(found["missing_keys"]):
        raise _unfit(path, f"{len(missing)} tensors missing: {', '.join(missing[:3])}")
    return model.float().requires_grad_(False).eval().to(device)


def _config(kind: type, file: Path):
    must_exist(file, "the config.json published with the weights")
    try:
        data, _ = kind.get_config_dict(str(file))
        if data.get("model_type") != kind.model_type:
            raise ValueError(f"model_type {data.get('model_type')!r} instead of {kind.model_type!r}")
        # transformers 5.17 reads the settings of the decoder as those of the prompt encoder
        from transformers.models.sam2_video.configuration_sam2_video import Sam2VideoMaskDecoderConfig

        decoder = Sam2VideoMaskDecoderConfig(**(data.get("mask_decoder_config") or {}))
        return kind.from_dict({**data, "mask_decoder_config": decoder})
    except Exception as error:  # the exception type depends on the release of transformers
        raise InputError(f"{file}: does not describe SAM 2.1 ({' '.join(str(error).split())[:120]}); use the one "
                         f"published with the weights, as in {SOURCE.repository}") from error  # fmt: skip


def _unfit(path: Path, what: str) -> InputError:
    return InputError(f"{path}: does not fit the config.json next to it: {what}; download both from one "
                      "repository, such "
                      f"as {SOURCE.repository}")  # fmt: skip
