"""Summary of cards of weights: a line about each training, and all training curves in one figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stages.core.errors import InputError
from stages.core.models.checkpoints import halve
from stages.core.scene.files import must_exist
from stages.core.scene.schema import read_json
from stages.lab.plot import Panel, draw_panels
from stages.lab.training.history import total_minutes

PANELS = {"loss": "loss", "RMSE": "RMSE [m] of validation scenes", "R": "correlation, of the same scenes"}
CARD = "the card of weights (.json), such as `ngff-lab train` writes"


def run(cards: Sequence[Path], out: Path, half: bool = False) -> list[str]:
    """Plot the training curves of cards; return a line about each.

    A curve is that of the last training run. `half` also rewrites the weights of each card in 16 bits, as for shipped
    weights. Raises InputError for files that are not cards, and for two cards with the same name.
    """
    rows = {Path(card).stem: _read(Path(card)) for card in cards}
    if len(rows) < len(cards):
        raise InputError("CARD.json: two of the cards have the same name; rename one of them")
    panels = [
        Panel(f"{title} by minute", curves={name: _curve(row, key) for name, row in rows.items()})
        for key, title in PANELS.items()
    ]
    draw_panels(out, panels)
    for card in cards if half else ():
        halve(Path(card).with_suffix(".safetensors"))
    return [_summary(name, row) for name, row in rows.items()]


def _read(card: Path) -> dict:
    """Read a card and check that the columns of its curve have equal length."""
    must_exist(card, CARD)
    try:
        row = read_json(card)
        curve = {key: list(row["curve"][key]) for key in ("minutes", *PANELS)}
        list(zip(*curve.values(), strict=True))
        return {**row, "curve": curve, "model": str(row["model"]), "runs": [dict(run) for run in row["runs"]]}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{card}: has no training curve ({error!r}); {CARD} is expected") from error


def _curve(row: dict, key: str) -> list[tuple[float, float]]:
    """Points (minutes, value), without missing values."""
    pairs = zip(row["curve"]["minutes"], row["curve"][key], strict=True)
    return [(float(minute), value) for minute, value in pairs if isinstance(value, (int, float))]


def _summary(name: str, row: dict) -> str:
    """A line with model, scenes of the last training run, minutes of all runs, device, and last validation score."""
    last = next((run for run in reversed(row["runs"]) if "minutes" in run), {})
    best, minutes = last.get("validation") or {}, total_minutes(row)
    score = "  ".join(f"{k} {best[k]:.4f}" for k in ("RMSE", "FPE", "R") if isinstance(best.get(k), (int, float)))
    scenes = f"{last['scenes']} scenes, " if "scenes" in last else ""
    time = "unknown time" if minutes is None else f"{minutes:.1f} min"
    return f"{name}: {row['model']}, {scenes}{time} on {row.get('device', 'unknown device')}: {score}"
