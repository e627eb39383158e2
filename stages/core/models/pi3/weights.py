"""Locate, check and load the published weights of π³ and Pi3-splat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from stages.core.errors import InputError
from stages.core.models.hub import HubSource, folders
from stages.core.models.pi3.config import Pi3Config
from stages.core.models.pi3.network import Pi3
from stages.core.models.pi3.splat import Pi3Splat
from stages.core.models.torch_files import dense_tensors, read_checkpoint
from stages.core.scene.files import must_exist
from stages.core.scene.schema import reason

MAX_DEPTH = 1000  # largest number of blocks in a part of the network; building each takes time
SUFFIXES = (".safetensors", ".pth", ".pt", ".ckpt", ".bin")


@dataclass(frozen=True)
class Pi3Source(HubSource):
    """A network and the publication of its weights."""

    network: type[nn.Module]
    prefix: str  # prefix of the parameter names of π³


PUBLISHED = {
    "pi3": Pi3Source("yyfz233/Pi3", "3.8 GB", "CC BY-NC 4.0", Pi3, ""),
    "pi3-splat": Pi3Source("lishiqianhugh/Pi3_splat", "4.2 GB", "that of π³, CC BY-NC 4.0", Pi3Splat, "encoder."),
}


def find(name: str, given: Path | None = None) -> Path:
    """Find the file with the weights of `name`: NAME.safetensors, NAME.pth, or a file in the folder NAME/.

    `given` may be the file itself, or a folder to search; without it $NGFF_WEIGHTS and the user's cache are searched.
    Raises InputError if there is none.
    """
    if given is not None and not Path(given).is_dir():
        must_exist(given, f"weights of {name} (.safetensors or .pth)")
        return Path(given)
    searched = folders() if given is None else [Path(given)]
    for folder in searched:
        inside = sorted((folder / name).iterdir()) if (folder / name).is_dir() else []
        for file in [*(folder / f"{name}{suffix}" for suffix in SUFFIXES), *inside]:
            if file.suffix in SUFFIXES and file.is_file():
                return file
    source = PUBLISHED[name]
    raise InputError(
        f"{name}: no weights in {' or '.join(str(p) for p in searched)}; download them from "
        f"https://huggingface.co/{source.repository} ({source.size}, licence {source.licence}) and save them as "
        f"{searched[0] / name}.safetensors, name the file with --weights, or add --download"
    )


def load(path: Path, name: str) -> nn.Module:
    """Load the network with the weights of a file, on the CPU, in 32 bit, for inference; sizes are inferred.

    Raises InputError for a file that is damaged, holds something else, or lacks tensors.
    """
    source = PUBLISHED[name]
    state = {k: v.float() if v.is_floating_point() else v for k, v in read_state(path).items()}
    try:
        config = Pi3Config.of({k.removeprefix(source.prefix): v for k, v in state.items()})
        if max(config.encoder_depth, config.decoder_depth, config.head_depth) > MAX_DEPTH:
            raise ValueError("a deeper network")
    except (KeyError, IndexError, TypeError, ValueError) as error:
        what = f"include no {error.args[0]}" if isinstance(error, KeyError) else "are those of another network"
        raise InputError(
            f"{path}: holds no weights of {name} (its {len(state)} tensors {what}); "
            f"download them from https://huggingface.co/{source.repository}"
        ) from error
    with torch.device("meta"):
        model = source.network(config)
    if complaint := differences(model.state_dict(), state):
        raise InputError(f"{path}: does not fit {name}: {complaint}")
    model.load_state_dict(state, assign=True)
    return model.requires_grad_(False).eval()


def read_state(path: Path) -> dict[str, Tensor]:
    """Read the tensors of a .safetensors file or of a PyTorch checkpoint, where they may be nested in a dictionary."""
    path = Path(path)
    must_exist(path, "weights (.safetensors or .pth)")
    try:
        if path.suffix == ".safetensors":
            return dense_tensors(path, load_file(path))
    except (SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(f"{path}: is not a complete safetensors file ({reason(error)}); download it again") from error
    data = read_checkpoint(path)
    for key in ("state_dict", "model_state_dict", "model", "module"):
        if isinstance(data, dict) and isinstance(data.get(key), dict):
            data = data[key]
    return dense_tensors(path, data if isinstance(data, dict) else {})


def differences(wanted: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> str:
    """Return a message that lists missing and unknown tensors, and those of another shape or type; empty if all fit."""
    other = [f"{k} {tuple(given[k].shape)} instead of {tuple(wanted[k].shape)}"
             for k in wanted if k in given and given[k].shape != wanted[k].shape]  # fmt: skip
    unreal = [k for k in wanted if k in given and wanted[k].is_floating_point() > given[k].is_floating_point()]
    groups = {"missing": [k for k in wanted if k not in given], "unknown": [k for k in given if k not in wanted],
              "of another shape": other, "that are no real numbers": unreal}  # fmt: skip
    return "; ".join(f"{len(names)} tensors {what}: {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}"
                     for what, names in groups.items() if names)  # fmt: skip
