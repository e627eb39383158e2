"""Weights between those of several trainings, number by number: often better than each, and calmer.

Source: Wortsman et al. 2022, "Model soups"; and, with the weights that a training began with, "Robust fine-tuning of
zero-shot models". Trainings must have begun with the same weights, or one with those of the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch

from stages.core.errors import InputError
from stages.core.models.checkpoints import load, save

APART = {"model", "config", "before", "data"}  # of a card, what need not be said twice
SAID = {"sha256", "note", "validation", "averaged"}  # what of it is not true of a mean


@torch.no_grad()
def run(files: Sequence[Path], given: str, out: Path, half: bool = False) -> str:
    """Write the mean of the weights, by shares such as 0.7,0.3, and a card that goes on from that of the first.

    Raises InputError for shares that make no mean, and weights of unlike models.
    """
    shares = _numbers(given)
    if len(files) != len(shares) or len(files) < 2 or min(shares) < 0 or not math.isclose(sum(shares), 1):
        raise InputError(f"--shares {given}: takes a number for each of at least two files; they add up to 1, such as "
                         "0.7,0.3")  # fmt: skip
    models, cards = zip(*(load(file) for file in files), strict=True)
    for file, card in zip(files[1:], cards[1:], strict=True):
        kinds = [f"{c['model']} {c.get('config')}" for c in (cards[0], card)]
        if kinds[0] != kinds[1]:
            raise InputError(f"{file}: holds {kinds[1]} and {files[0]} {kinds[0]}; only weights of one model have a "
                             "mean")  # fmt: skip
    mean = models[0]
    for parts in zip(*(m.parameters() for m in models), strict=True):
        parts[0].copy_(sum(share * p for share, p in zip(shares, parts, strict=True)))
    known = _ancestors(cards[0])
    told = [SAID if c["sha256"] in known else c.keys() - APART for c in cards]
    averaged = [{"share": s, **{k: v for k, v in c.items() if k in keys}}
                for s, c, keys in zip(shares, cards, told, strict=True)]  # fmt: skip
    first = {k: v for k, v in cards[0].items() if k not in SAID}
    save(Path(out), cards[0]["model"], mean, {**first, "averaged": averaged}, half=half)
    return f"{out}: " + ", ".join(f"{s:g} of {file}" for s, file in zip(shares, files, strict=True))


def _numbers(given: str) -> list[float]:
    try:
        return [float(word) for word in given.split(",")]
    except ValueError:
        return []


def _ancestors(card: dict) -> set[str]:
    """Of the weights themselves, and of all that they began with or are a mean of."""
    more = [*card.get("averaged", ()), *([card["before"]] if "before" in card else ())]
    return {card["sha256"]}.union(*map(_ancestors, more))
