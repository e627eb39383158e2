"""The cards of weights: what each says about its training in a line, the curves of all of them in one picture.

Weights that ship are kept in 16 bits.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from stages.core.errors import InputError
from stages.core.models.checkpoints import halve, training_minutes
from stages.core.scene.files import must_exist
from stages.lab.plot import Panel, draw_panels

PANELS = {"loss": "loss", "RMSE": "RMSE [m] of scenes not learned from", "R": "correlation, of the same scenes"}
WHAT = "the card of weights (.json), such as `ngff-lab train` writes"


def run(cards: Sequence[Path], out: Path, half: bool = False) -> list[str]:
    """Plot the training of models over its minutes; a line about each. `half`: make their weights ready to ship."""
    rows = {Path(card).stem: _read(Path(card)) for card in cards}
    if len(rows) < len(cards):
        raise InputError("two of the cards have the same name, and could not be told apart; rename one")
    panels = [
        Panel(f"{title} by minute", curves={name: _curve(row, key) for name, row in rows.items()})
        for key, title in PANELS.items()
    ]
    draw_panels(out, panels)
    for card in cards if half else ():
        halve(Path(card).with_suffix(".safetensors"))
    return [_line(name, row) for name, row in rows.items()]


def _read(card: Path) -> dict:
    must_exist(card, WHAT)
    try:
        row = json.loads(card.read_text())
        curve = [{"minutes": float(r["minutes"]), **{k: r.get(k) for k in PANELS}} for r in row["curve"]]
        return {**row, "curve": curve, "model": str(row["model"]), "minutes": float(row["minutes"])}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{card}: has no curve of training ({error!r}); {WHAT} is expected") from error


def _curve(row: dict, key: str) -> list[tuple[float, float]]:
    return [(r["minutes"], r[key]) for r in row["curve"] if isinstance(r[key], (int, float))]


def _line(name: str, row: dict) -> str:
    best = row.get("validation") or {}
    score = "  ".join(f"{k} {best[k]:.4f}" for k in ("RMSE", "FPE", "R") if isinstance(best.get(k), (int, float)))
    known = f"{row['scenes']} scenes, " if "scenes" in row else ""
    spent = training_minutes(row)
    return f"{name}: {row['model']}, {known}{spent:.1f} min on {row.get('device', 'what was there')}: {score}"
