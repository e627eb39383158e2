"""Find, verify, load and save the weights of models: NAME.safetensors, with a metadata card NAME.json."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Collection, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from safetensors.torch import save as to_bytes
from torch import Tensor

from stages.core.backends import choose
from stages.core.errors import InputError
from stages.core.models.dynamics import Dynamics
from stages.core.models.torch_files import dense_tensors, read_checkpoint
from stages.core.scene.files import must_exist, replacing, sha256
from stages.core.scene.schema import number, quote, read_json, reason, whole

MODELS = {
    "ngff-paper": "stages.core.models.baselines.ngff_paper:PaperForceField",
    "ngff-paper-rigid": "stages.core.models.baselines.ngff_paper:rigid",
    "ngff": "stages.core.models.field.force_field:ForceField",
    "gcn": "stages.core.models.baselines.gcn:GCN",
    "pointformer": "stages.core.models.baselines.pointformer:Pointformer",
    "transformer": "stages.core.models.baselines.transformer:Transformer",
}
MAX_CONFIG = 4096  # largest width or number of layers in a card
SHIPPED = Path(__file__).parent / "weights"  # weights shipped in the package


def build(name: str, **config) -> Dynamics:
    """Build an untrained model by its name in MODELS; `config` are the arguments of its class.

    Raises InputError for an unknown name.
    """
    return choose(MODELS, "MODEL", name)(**config)


def find(name: str, given: Path | None = None) -> Path:
    """Return the path of a model's weights: `given` (file or folder), else in $NGFF_WEIGHTS, else as shipped.

    Raises InputError if there are none.
    """
    folders = [SHIPPED]
    if os.environ.get("NGFF_WEIGHTS"):
        folders.insert(0, Path(os.environ["NGFF_WEIGHTS"]))
    if given is not None and not Path(given).is_dir():
        return Path(given)
    if given is not None:
        folders = [Path(given)]
    for folder in folders:
        if (folder / f"{name}.safetensors").is_file():
            return folder / f"{name}.safetensors"
    looked = " or ".join(str(folder) for folder in folders)
    raise InputError(f"{name}: no weights {name}.safetensors in {looked}; train them with `ngff-lab "
                     f"train {name}`, "
                     "or name their file with --weights")  # fmt: skip


def save(path: Path, name: str, model: Dynamics, card: Mapping | None = None, half: bool = False) -> None:
    """Write PATH.safetensors and its card PATH.json; with `half` in 16 bits where the range of values allows it."""
    path = Path(path)
    state = {k: v.detach().cpu().contiguous() for k, v in model.state_dict().items()}
    if half:
        state = {k: v.half() if v.is_floating_point() and v.half().isfinite().all() else v for k, v in state.items()}
    with replacing(path) as part:
        part.write_bytes(to_bytes(state))  # save_file would create files that only their owner can read
    write_card(path.with_suffix(".json"), {**(card or {}), "model": name, "config": model.config,
                                           "sha256": sha256(path)})  # fmt: skip


def halve(path: Path) -> None:
    """Rewrite a weight file in 16 bits, without measurable loss of accuracy (tests/core/models/test_shipped.py)."""
    model, card = load(path)
    save(path, card["model"], model, card, half=True)


def write_card(path: Path, card: Mapping) -> None:
    """Write a card as JSON: one line per entry and per row of a table, numbers with eight digits."""
    lines = []
    for key, value in _rounded(card).items():
        table = isinstance(value, list) and value and isinstance(value[0], dict)
        rows = ",\n  ".join(map(json.dumps, value)) if table else ""
        lines.append(f" {json.dumps(key)}: " + (f"[\n  {rows}\n ]" if table else json.dumps(value)))
    with replacing(path) as part:
        part.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def _rounded(value: object) -> object:
    """Round floats in nested values to eight significant digits; infinities and nan become None."""
    if isinstance(value, float):
        return float(f"{value:.8g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {k: _rounded(v) for k, v in value.items()}
    return [_rounded(v) for v in value] if isinstance(value, (list, tuple)) else value


def load(path: Path, device: torch.device | str = "cpu") -> tuple[Dynamics, dict]:
    """Load a model in 32 bits and evaluation mode, and its card.

    The card's `model` and `config` define the model. A .pt or .pth file is read as a checkpoint of the public NGFF
    code, which has no card. Raises InputError for files that are missing, damaged or do not fit.
    """
    path = Path(path)
    must_exist(path, "weights (.safetensors) such as `ngff-lab train` writes")
    if path.suffix in (".pt", ".pth"):
        return _public(path).to(device).eval(), {"model": "ngff-paper", "sha256": sha256(path)}
    card = read_card(path, MODELS)
    state = read_state(path, card)
    try:
        model = _filled(card["model"], card["config"], state)
    except (TypeError, RuntimeError, ValueError) as error:
        raise unfit(path, f"the model {card['model']!r} of its card", error) from error
    return model.to(device).eval(), card


def _filled(name: str, config: Mapping, state: Mapping[str, Tensor]) -> Dynamics:
    """Build a model with these weights. Raises TypeError, RuntimeError or ValueError if they do not fit."""
    _check_config(config)
    with torch.device("meta"):  # check shapes first, without memory: a wrong card could demand any amount
        build(name, **config).load_state_dict(state, assign=True)
    model = build(name, **config)
    model.load_state_dict(state)
    return model


def read_state(path: Path, card: Mapping) -> dict[str, Tensor]:
    """Read the tensors of a .safetensors file in 32 bits; InputError if it is damaged or does not match its card."""
    if sha256(path) != card["sha256"]:
        raise InputError(f"{path}: does not have the sha256 that {path.with_suffix('.json').name} states; the file is "
                         "damaged or comes from a different training run; download or train both files "
                         "again")  # fmt: skip
    try:
        state = dense_tensors(path, load_file(path))
    except (SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(f"{path}: is not a safetensors file ({reason(error)}); download or train it again") from error
    return {k: v.float() if v.is_floating_point() else v for k, v in state.items()}


def _check_config(config: Mapping) -> None:
    """Raise ValueError for values that no model accepts, so that a huge number of layers is not built."""
    for name, value in config.items():
        if isinstance(value, float):  # dropout
            number(value, quote(name, 40), 0, 1)
        elif not isinstance(value, bool):
            whole(value, quote(name, 40), 1, MAX_CONFIG)


def read_card(path: Path, models: Collection[str]) -> dict:
    """Read the card (model, config, sha256) of weights of one of `models`. Raises InputError if it is damaged."""
    file = path.with_suffix(".json")
    must_exist(file, f"the card of {path.name}")
    try:
        card = read_json(file)
        wrong = not (isinstance(card["model"], str) and isinstance(card["sha256"], str))
        wrong |= not isinstance(card["config"], dict)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file}: is not the card of weights ({reason(error)}); download or train it again") from error
    if wrong or card["model"] not in models:
        raise InputError(
            f"{file}: needs model (one of {', '.join(models)}), config and sha256; download or train it again"
        )
    return card


def _public(path: Path) -> Dynamics:
    """Load a model from a checkpoint of the public code; sizes are inferred from the tensor shapes."""
    state = _tensors(path, read_checkpoint(path))
    try:
        hidden = state["predictor.state_embedding.0.weight"].shape[0]
        layers = sum(k.startswith("predictor.pointnet.extraction_blocks.") and k.endswith("0.weight") for k in state)
        deform = any(k.startswith("predictor.stress_net.") for k in state)
        return _filled("ngff-paper", {"hidden": hidden, "layers": layers, "deform": deform}, state)
    except (KeyError, IndexError, RuntimeError, ValueError) as error:
        raise unfit(path, "the published NGFF model", error) from error


def _tensors(path: Path, data: object) -> dict[str, Tensor]:
    """Find the state dict in a checkpoint, up to three levels down; removes the prefix of data-parallel training."""
    for _ in range(3):
        if isinstance(data, dict) and not any(isinstance(v, Tensor) for v in data.values()):
            data = next((data[k] for k in ("model_state_dict", "state_dict", "model") if k in data), None)
    state = dense_tensors(path, data if isinstance(data, dict) else {})
    return {k.removeprefix("module."): v for k, v in state.items()}


def unfit(path: Path, what: str, error: Exception) -> InputError:
    """Return the error for weights that do not fit `what`."""
    return InputError(f"{path}: does not fit {what} ({_line(error)})")


def _line(error: Exception) -> str:
    """An error message on one line, at most 200 characters."""
    return quote(" ".join(str(error).split()), 200)
