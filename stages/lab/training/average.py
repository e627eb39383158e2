"""Weighted averages of the weights of several trainings of one model, parameter by parameter.

Only weights with a common starting point have a meaningful average. Source: Wortsman et al. 2022, "Model soups"; for
an average with the initial weights, Wortsman et al. 2022, "Robust fine-tuning of zero-shot models".
"""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from stages.core.errors import InputError
from stages.core.models.checkpoints import load, save
from stages.lab.training.history import merge


@torch.no_grad()
def run(files: Sequence[Path], given: str, out: Path, half: bool = False) -> str:
    """Write the average of weights for ratios such as 0.7,0.3, and its card; return a line about it.

    The card lists the runs of all cards, followed by the average; device, options and curve are those of the first
    file. `half` stores 16-bit numbers. Raises InputError if the ratios do not add up to 1 or the models differ.
    """
    ratios = _numbers(given)
    if len(files) != len(ratios) or len(files) < 2 or min(ratios) < 0 or not math.isclose(sum(ratios), 1):
        raise InputError(f"--ratios {given}: give one number for each of at least two files, which add up to 1, "
                         "such as "
                         "0.7,0.3")  # fmt: skip
    models, cards = zip(*(load(file) for file in files), strict=True)
    for file, card in zip(files[1:], cards[1:], strict=True):
        kinds = [f"{c['model']} {c.get('config')}" for c in (cards[0], card)]
        if kinds[0] != kinds[1]:
            raise InputError(f"{file}: contains {kinds[1]}, but {files[0]} contains {kinds[0]}; only weights of "
                             "the same model can be "
                             "averaged")  # fmt: skip
    average = models[0]
    for parameters in zip(*(m.parameters() for m in models), strict=True):
        parameters[0].copy_(sum(ratio * p for ratio, p in zip(ratios, parameters, strict=True)))
    parts = [{"ratio": ratio, "sha256": card["sha256"]} for ratio, card in zip(ratios, cards, strict=True)]
    step = {"command": shlex.join(["ngff-lab", *sys.argv[1:]]), "average": parts}
    first = {k: v for k, v in cards[0].items() if k not in ("sha256", "runs", "note")}
    save(Path(out), cards[0]["model"], average, {**first, "runs": [*merge(cards), step]}, half=half)
    return f"{out}: " + ", ".join(f"{ratio:g} of {file}" for ratio, file in zip(ratios, files, strict=True))


def _numbers(given: str) -> list[float]:
    try:
        return [float(word) for word in given.split(",")]
    except ValueError:
        return []
